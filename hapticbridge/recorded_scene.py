"""Scene of a recording, compiled again from its attached sources.

A recording may come from anyone. MuJoCo's compiler trusts its input: a scene can crash it, or make
it take all memory. Such work is therefore done in a child process with limits on memory, time and
files (``in_bounds``), or tried there first (``compile_recorded``).
"""

from __future__ import annotations

import faulthandler
import json
import os
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import read_json
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.recording import RecordingFile
from hapticbridge.rendering import check_prepared, prepare
from hapticbridge.run_description import (
    CARRIED,
    SOURCE_PREFIX,
    method_of,
    model_digest,
    requested_of,
)
from hapticbridge.scene import Scene, load_scene, scene_parameters
from hapticbridge.scene.source import refuse_outside

if sys.platform != "win32":
    import resource

# Child process with limits

MEMORY = 700 << 20
"""Memory in bytes that foreign work may take beyond the present process. A scene with large meshes
compiles in half of it; with more, a hostile scene could take a small machine's memory."""

COMPILE_TIME = 4
"""Processor time in s in which a foreign scene must compile. The shipped scenes take 0.1 s."""

SIMULATION_TIME, SLOWEST = 60, 20
"""Processor time in s that a simulation may take, and beyond it per second of the run. A first
simulation on a machine compiles its functions for 35 s; a scene at its limit takes its run time."""

_LARGEST_FILE = 256 << 20
_DONE, _REFUSED, _NO_MEMORY, _FAILED = 0, 3, 4, 5


Work = Callable[[Callable[[float], None]], object]


def in_bounds(work: Work, what: str) -> object:
    """Does foreign work in a child process; returns its result, which must fit into JSON.

    The child is a fork of this process: nothing is imported or read again. It ends with it.

    Args:
        work: Function to call. Its argument is a function that gives the child so many seconds of
            processor time from then on; at first it has ``COMPILE_TIME``.
        what: Name of what is worked on, for the message.

    Raises:
        RecordingError: The work raised it.
        ForeignSceneError: The child crashed, or exceeded memory or time.
    """
    if sys.platform == "win32":
        return work(unlimited)
    with TemporaryDirectory(prefix="hapticbridge-") as folder:
        reading, writing = os.pipe()
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            os.close(reading)
            _work_and_exit(work, folder, writing)
        os.close(writing)
        try:
            with open(reading, "rb") as answer:  # noqa: PTH123 - a pipe
                text = answer.read()
        except BaseException:
            os.kill(child, signal.SIGKILL)
            raise
        finally:
            _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code in (_DONE, _REFUSED):
        found = json.loads(text)
        if code == _REFUSED:
            raise RecordingError(str(found))
        return found
    death = f"made MuJoCo fail: {json.loads(text)}" if code == _FAILED else _death(code)
    raise ForeignSceneError(f"{what} {death}")


class ForeignSceneError(HapticBridgeError):
    """A foreign scene crashed MuJoCo, or needs more than its share of memory or time."""


def unlimited(_seconds: float) -> None:
    """Stands for the function that extends the time, where time is not limited."""


def _work_and_exit(work: Work, folder: str, answer: int) -> None:
    code, found = 1, b""
    try:
        faulthandler.disable()
        tempfile.tempdir = folder
        _limit_this_process()
        found, code = json.dumps(work(_allow)).encode(), _DONE
    except MemoryError:
        code = _NO_MEMORY
    except BaseException as error:
        is_refusal = isinstance(error, RecordingError)
        words = str(error)
        if not is_refusal:
            words = " ".join(f"{type(error).__name__}: {words}".split())[:200]
        found, code = json.dumps(words).encode(), _REFUSED if is_refusal else _FAILED
        if "allocate memory" in words:  # MuJoCo's
            found, code = b"", _NO_MEMORY
    finally:
        while found:
            found = found[os.write(answer, found) :]
        os._exit(code)


def _limit_this_process() -> None:
    with open("/proc/self/statm", encoding="ascii") as pages:  # noqa: PTH123 - not a file to keep
        present = int(pages.read().split()[0]) * resource.getpagesize()
    _lower(resource.RLIMIT_AS, present + MEMORY)
    _lower(resource.RLIMIT_FSIZE, _LARGEST_FILE)
    _lower(resource.RLIMIT_CORE, 0)
    _allow(COMPILE_TIME)


def _lower(kind: int, most: int) -> None:
    soft, hard = resource.getrlimit(kind)
    known = [each for each in (soft, most) if each != resource.RLIM_INFINITY]
    resource.setrlimit(kind, (min(known), hard))


def _allow(seconds: float) -> None:
    if sys.platform != "win32":
        used = resource.getrusage(resource.RUSAGE_SELF)
        until = int(used.ru_utime + used.ru_stime + seconds) + 1
        _, hard = resource.getrlimit(resource.RLIMIT_CPU)
        if hard != resource.RLIM_INFINITY:
            until = min(until, hard)
        resource.setrlimit(resource.RLIMIT_CPU, (until, hard))


def _death(code: int) -> str:
    if code == _NO_MEMORY:
        return (
            f"needs more than {MEMORY >> 20} MB of memory; audit --in-process sets no limit, for a "
            "scene that you trust"
        )
    if sys.platform != "win32" and code == -signal.SIGXCPU:
        return "needs too much processor time"
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"crashed MuJoCo ({name})"


# Scene from its sources


def unpack_scene(recording: RecordingFile, folder: Path) -> Path:
    """Writes a recording's scene files to a folder; returns the main file.

    The folder is created if missing; nothing is written outside it.

    Raises:
        RecordingError: The recording carries no scene, or files that cannot be written there.
    """
    main: Path | None = None
    for name, data in recording.attachments.items():
        if not name.startswith(SOURCE_PREFIX):
            continue
        inner = PurePosixPath(name.removeprefix(SOURCE_PREFIX))
        # a foreign recording must not write outside the folder
        if inner.is_absolute() or ".." in inner.parts or "\\" in name or ":" in name:
            raise RecordingError(
                f"the attachment {name!r:.80} would lie outside the scene's folder"
            )
        path = folder / inner
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except (OSError, ValueError) as error:
            raise RecordingError(
                f"the attachment {name!r:.80} cannot be unpacked: {error}"
            ) from None
        main = main or path
        if inner.suffix != ".toml":
            refuse_outside(data, inner.as_posix())
    if main is None:
        raise RecordingError(f"{recording.path} carries no scene, so it cannot be simulated again")
    return main


def recorded_values(meta: Mapping[str, str]) -> dict[str, float]:
    """Returns the values of the scene's parameters in a recorded run.

    Raises:
        RecordingError: They are not numbers by name.
    """
    try:
        values = dict(read_json(meta.get("scene_parameters", "{}")))
        return {str(name): float(value) for name, value in values.items()}
    except (ValueError, TypeError, OverflowError) as error:
        raise RecordingError(f"metadata 'scene_parameters' are not numbers: {error}") from None


def load_unpacked(
    main: Path, grip: str, values: Mapping[str, float], meta: Mapping[str, str]
) -> Scene:
    """Loads an unpacked scene with these values of its parameters, its tool carried as recorded.

    Raises:
        SceneError: A value is out of range, or the scene cannot be loaded.
    """
    defaults = {each.name: each.default for each in scene_parameters(main)}
    # a default that is set may differ from the file's number in its last digit
    changed = {name: value for name, value in values.items() if defaults.get(name) != value}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # reported during the recorded run
        scene = load_scene(main, grip, as_is=False, **changed)
    if meta.get("tool_weight") == CARRIED:
        scene.carry_tool("as recorded")
    return scene


def compile_recorded(
    recording: RecordingFile, parameters: RunParameters, *, is_trusted: bool = False
) -> Scene:
    """Compiles the attached sources, and prepares the scene for the recorded method.

    Args:
        recording: The recording.
        parameters: Parameters of its run.
        is_trusted: True compiles in this process at once. False tries it in a child process first:
            the compiler is deterministic, so that what neither crashed there nor took more than its
            share does not do so here.

    Raises:
        RecordingError: The recording carries no scene, or it cannot be compiled or prepared.
        ForeignSceneError: It crashed the compiler, or takes too much memory or time.
    """
    if not is_trusted:
        in_bounds(lambda _: _try(recording, parameters), f"the scene of '{recording.path}'")
    folder = ""
    try:
        with TemporaryDirectory(prefix="hapticbridge-") as folder:
            main = unpack_scene(recording, Path(folder))
            meta = recording.meta
            scene = load_unpacked(main, parameters.grip, recorded_values(meta), meta)
            requested, method = requested_of(meta), method_of(meta)
            steps = parameters.period, parameters.substeps
            prepare(scene, requested, *steps, method, warns=False)
            check_prepared(scene.model, parameters, method)
    except RecordingError:
        raise
    except HapticBridgeError as error:
        reason = str(error).replace(f"{folder}/", "")
        raise RecordingError(f"the attached scene does not fit the metadata: {reason}") from None
    return scene


def _try(recording: RecordingFile, parameters: RunParameters) -> None:
    scene = compile_recorded(recording, parameters, is_trusted=True)
    method_of(recording.meta).step(scene.model, scene.data)


def is_as_recorded(scene: Scene, recording: RecordingFile) -> bool:
    """Returns True if a prepared scene is the recorded one in every bit."""
    return model_digest(scene.model) == recording.meta.get("scene_sha256")
