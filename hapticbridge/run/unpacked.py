"""Scene of a recording, from its attached files, as the audit compiles it."""

from __future__ import annotations

import errno
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory

from hapticbridge.confinement import MEMORY
from hapticbridge.errors import HapticBridgeError, RecordingError, SceneWarning
from hapticbridge.files import encoding_words
from hapticbridge.run.description import SOURCE_PREFIX, attachments, model_digest
from hapticbridge.run.request import RunRequest
from hapticbridge.scene import Scene, load_scene, scene_parameters
from hapticbridge.scene.source import refuse_outside
from hapticbridge.units import format_si

MAX_STEPS = 4
"""Names that one path is joined from: asset folder, name in an include, in a model, in a file."""

LARGE = 0.4 * MEMORY
"""Size of a compiled scene in bytes above which a confined audit may refuse it: with 0.4 and 0.6 of
its memory in textures, one was compiled and one refused."""


_OF_MACHINE = {
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOMEM,
    errno.EIO,
}
"""Numbers of errors for which no file name is the reason."""


class NoRoomError(RecordingError):
    """This machine cannot hold a recording's scene files, which says nothing of the recording."""


def unpack_scene(recording: Path, files: Mapping[str, bytes], folder: Path) -> Path:
    """Writes a recording's scene files to a folder; returns the main file.

    The folder is created if missing; nothing is written outside it.

    Args:
        recording: The recording, for messages.
        files: Its attachments by name.
        folder: Where the files are written.

    Raises:
        NoRoomError: The folder has no room for them, or cannot have their names here.
        RecordingError: The recording carries no scene, or files that cannot be written anywhere.
    """
    main: Path | None = None
    sources = {
        name: (PurePath(name.removeprefix(SOURCE_PREFIX)), data)
        for name, data in files.items()
        if name.startswith(SOURCE_PREFIX)
    }
    climbs = [
        refuse_outside(data, inner.as_posix())
        for inner, data in sources.values()
        if inner.suffix != ".toml"
    ]
    # a name may be taken relative to another file and to an asset folder that climbs, too
    folder = folder.joinpath(*MAX_STEPS * max(climbs, default=0) * ["inner"])
    for name, (inner, data) in sources.items():
        # a foreign recording must not write outside the folder
        if inner.anchor or ".." in inner.parts:
            raise RecordingError(
                f"the attachment {name!r:.80} would lie outside the scene's folder"
            )
        path = folder / inner
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except (OSError, ValueError, RecursionError) as error:
            reason = getattr(error, "strerror", None) or error
            is_of_machine = getattr(error, "errno", None) in _OF_MACHINE
            if isinstance(error, UnicodeEncodeError):
                reason, is_of_machine = encoding_words(), True
            words = f"the attachment {name!r:.80} cannot be unpacked: {reason}"
            raise (NoRoomError if is_of_machine else RecordingError)(words) from None
        main = main or path
    if main is None:
        raise RecordingError(f"{recording} carries no scene, so it cannot be simulated again")
    return main


def load_unpacked(main: Path, request: RunRequest, *, is_carried: bool) -> Scene:
    """Loads an unpacked scene as requested, with its tool carried or felt.

    Raises:
        SceneError: A parameter is out of range, or the scene cannot be loaded.
    """
    defaults = {each.name: each.default for each in scene_parameters(main)}
    # a default that is set may differ from the file's number in its last digit
    values = request.parameters.items()
    changed = {name: value for name, value in values if defaults.get(name) != value}
    grips = request.grips if len(request.grips) > 1 else request.grips[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # reported during the recorded run
        scene = load_scene(main, grips, as_is=request.as_is, **changed)
    if is_carried:
        scene.carry_tool("as recorded")
    return scene


def _determined(scene: Scene) -> tuple[str, list[str]]:
    """Returns the digest of the model, and the changes to its file that no run has a reason for."""
    return model_digest(scene.model), [str(each) for each in scene.differences if not each.reason]


def warn_of_other_scene(
    scene: Scene, request: RunRequest, recording: Path, prepare: Callable[[Scene], object]
) -> None:
    """Compiles a prepared scene again from what its recording will carry, and compares.

    Args:
        scene: The scene, before its run.
        request: What the recording says was asked for.
        recording: The file.
        prepare: Prepares a loaded scene as this one was prepared.

    Warns:
        UserWarning: The audit of the recording would refuse its scene, and why, or this could not
            be tried.
    """
    files = {each.name: each.data for each in attachments(scene)}
    try:
        with TemporaryDirectory(prefix="hapticbridge-") as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            main = unpack_scene(recording, files, Path(folder))
            again = load_unpacked(main, request, is_carried=scene.is_carried)
            prepare(again)
            is_equal = _determined(again) == _determined(scene)
        reason = "its files compile to another model; was it changed after it was loaded?"
        concern = "" if is_equal else f"the recording could not be audited: {reason}"
        if is_equal and (size := scene.model.nbuffer) > LARGE:
            concern = (
                f"it takes {format_si(size, 'B')}, more than an audit allows a foreign scene: "
                "audit the recording with --in-process, or make textures and meshes smaller"
            )
    except (OSError, NoRoomError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        concern = f"whether the recording can be audited was not tried: {reason}"
    except HapticBridgeError as error:
        concern = f"the recording could not be audited: {error}"
    if concern:
        warnings.warn(SceneWarning(scene.path, concern), stacklevel=2)
