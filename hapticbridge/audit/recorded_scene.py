"""Scene of a recording, compiled again from its attached sources.

A recording may come from anyone. MuJoCo's compiler trusts its input: a scene can crash it, or make
it take all memory. Such work is therefore done in a child process (``confinement``),
which hands over numbers and texts.
"""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import (
    check_prepared,
    method_named,
    prepare,
    prepare_hands,
    unguarded_parameters,
)
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel import jit
from hapticbridge.kernel.handle import stretch_at
from hapticbridge.kernel.mujoco_c import library_path
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate_recorded
from hapticbridge.recording import RecordingFile
from hapticbridge.run.description import (
    CARRIED,
    metas_of,
    method_of,
    model_digest,
    parameters_of,
    requested_of,
)
from hapticbridge.run.posted_scene import PostedScene
from hapticbridge.run.request import request_of
from hapticbridge.run.slow_scene import SlowScene
from hapticbridge.run.unpacked import load_unpacked, unpack_scene
from hapticbridge.scene import Scene, load_scene
from hapticbridge.scene.rehearsal import static_load

SIMULATION_TIME, SLOWEST = 15, 20
"""Processor time in s that a simulation may take, and beyond it per second of the run. Machine code
is loaded before; a scene at its limit takes its run time."""


def seconds_for(recording: RecordingFile, parameters: RunParameters) -> float:
    """Returns the processor time in s that a simulation of the run may take."""
    seconds = SIMULATION_TIME + SLOWEST * recording.count * parameters.period
    return seconds if SIMULATION_TIME <= seconds < 86400.0 else 86400.0  # numbers of any file


def bounds_for(recording: RecordingFile, parameters: RunParameters) -> dict[str, Any]:
    """Returns the bounds of a child process that simulates a run, as for ``Confined``.

    The machine code of its method is loaded here first: the child inherits it.
    """
    load_machine_code(*machine_code_for(recording, parameters))
    return {
        "seconds": seconds_for(recording, parameters),
        "reads": (Path(recording.path).absolute(), jit.cache_folder()),
        "on_error": report_errors,
    }


_HANDLERS: list[Any] = []  # C has their addresses


def report_errors(report: Callable[[str], None]) -> None:
    """Lets MuJoCo call a function with the message of an error that would end the process.

    Such an error occurs in compiled code; in the Python bindings it raises as before. The function
    must end the process.
    """
    kind = ctypes.CFUNCTYPE(None, ctypes.c_char_p)
    _HANDLERS.append(kind(lambda message: report(message.decode(errors="replace"))))
    pointer = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library_path())), "mju_user_error")
    pointer.value = ctypes.cast(_HANDLERS[-1], ctypes.c_void_p).value


def machine_code_for(recording: RecordingFile, parameters: RunParameters) -> tuple[str, str, str]:
    """Returns the arguments of ``load_machine_code`` for a run."""
    method = method_of(recording.meta)
    kind = "posted" if parameters.credit > 0.0 else "slow" if parameters.scene_ticks else ""
    return method.name, method.contact, kind


@cache
def load_machine_code(name: str, contact: str, kind: str = "") -> None:
    """Loads the machine code of a method, which is first compiled and kept on disk if missing.

    A child process may not write it, and each would load it again. ``kind`` is "slow" for a scene
    slower than the loop, "posted" for that of another program.
    """
    method = method_named(name).with_contact(contact)
    coupling, period = Coupling(1000.0, 1.0, 1.0, 1e-3), 1e-3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = load_scene("point_mass")
    try:
        parameters = unguarded_parameters(scene, coupling, period, 1, method)
        if method.has_law:
            static_load(scene, parameters)
        parameters = replace(
            parameters, scene_ticks=2 * bool(kind), credit=1.0 * (kind == "posted")
        )
        kernel = BoundKernel(scene.model, scene.data, parameters)
        sample, nothing = np.zeros(1, SAMPLE_DTYPE), np.zeros(1)
        rows, flags = np.zeros(1, TICK_DTYPE), np.zeros(1, np.int64)
        sample["quaternion"][:, 0] = 1.0
        jit.direct(stretch_at, kernel.state[0], sample)  # of a run with absolute poses
        if kind:
            slow: SlowScene | PostedScene = PostedScene(kernel, scene.data, parameters)
            if kind == "slow":
                slow = SlowScene(kernel, scene.model, scene.data, parameters)
            slow.simulate(sample, flags, nothing, flags, rows)
            slow.close()
        else:
            recorded = flags[:, None], nothing, rows["wrench_on_device"][:, None].copy()
            by_hand = sample[:, None], recorded, kernel.row, rows[:, None]
            simulate_recorded(kernel.state, *by_hand)
        kernel.release()
    finally:
        scene.release()


# Scene from its sources


def compile_recorded(recording: RecordingFile) -> Scene:
    """Compiles the attached sources, and prepares the scene for the recorded method.

    It belongs into a child process with limits (``confinement``), unless the recording is trusted.

    Raises:
        RecordingError: The recording carries no scene, or it cannot be compiled or prepared.
    """
    home, meta = "", recording.meta
    try:
        with TemporaryDirectory(prefix="hapticbridge-") as folder:
            main = unpack_scene(recording.path, recording.attachments, Path(folder))
            home = f"{main.parent}/"
            is_carried = meta.get("tool_weight") == CARRIED
            scene = load_unpacked(main, request_of(meta), is_carried=is_carried)
            parameters, method = parameters_of(meta), method_of(meta)
            couplings = [requested_of(own) for own in metas_of(meta)]
            if scene.has_several_hands:
                prepare_hands(scene, couplings, parameters.period, method, warns=False)
            else:
                steps = parameters.scene_period, parameters.substeps
                prepare(scene, couplings[0], *steps, method, warns=False)
            check_prepared(scene.model, parameters, method)
    except RecordingError:
        raise
    except HapticBridgeError as error:
        reason = str(error).replace(home, "") if home else str(error)
        raise RecordingError(f"the attached scene does not fit the metadata: {reason}") from None
    return scene


def is_as_recorded(scene: Scene, recording: RecordingFile) -> bool:
    """Returns True if a prepared scene is the recorded one in every bit."""
    return model_digest(scene.model) == recording.meta.get("scene_sha256")
