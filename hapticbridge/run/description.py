"""Run description in a recording, and run parameters read back from it.

Metadata are strings; their numbers read back to the same double.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import types_of
from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import RIGID, SCENE, Method, method_named
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import CouplingError, HapticBridgeError, RecordingError
from hapticbridge.files import read_json
from hapticbridge.kernel.codes import added_actuators, handle_ids
from hapticbridge.kernel.parameters import GuardParameters, RunParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.rigid_contact import WRITTEN
from hapticbridge.recording import Attachment
from hapticbridge.recording.format import HANDS_KEY, further_hands
from hapticbridge.scene import Scene

# Start of a run: MuJoCo's state, compiled model, and energies

STATE_ATTACHMENT = "start_state.f64"

STARTS = {"handle_start": 7, "tool_start": 7, "start_kinetic": 1, "start_potential": 1}
"""Start values of the energy balance, with their number of elements: poses in m, energies in J."""

_STORED = {"start_kinetic": "kinetic", "start_potential": "potential"}
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def model_digest(model: mujoco.MjModel) -> str:
    """Returns the SHA-256 of every number and name that a compiled model computes with.

    The names of its files and what follows from their length are left out: a mesh is its vertices,
    whatever it was called. So is ``vis``, by which it is drawn.
    """
    digest = hashlib.sha256()
    for part in (model, model.opt, model.stat):
        for name in sorted(dir(part)):
            if not name.startswith("_") and not _OF_FILES.fullmatch(name):
                value = getattr(part, name)
                if isinstance(value, np.ndarray):
                    digest.update(f"{name} {value.dtype} {value.shape} ".encode())
                    digest.update(np.ascontiguousarray(value).tobytes())
                elif isinstance(value, bytes | int | float):
                    digest.update(f"{name} {value!r} ".encode())
    return digest.hexdigest()


_OF_FILES = re.compile("n?paths|.*_pathadr|nbuffer")

CHANGED_EVENT = "scene_changed"
"""Event that names, as ``fields``, what a program changed in model or data during a run."""

_MAX_WATCHED = 1_000_000
"""Largest array in bytes that is compared at the end of a run. Larger ones are meshes and textures,
whose comparison would hold up short runs."""

_OF_A_RUN = ("enableflags", "solver", *WRITTEN)
"""Fields of the model that a run itself writes to."""

_OF_PICTURES = re.compile(r"(light|mat|tex|skin)_.*|.*_(rgba|matid)")
"""Fields of the model that are drawn alone."""

_OF_STATE = (
    *("qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied"),
    *("eq_active", "mocap_pos", "mocap_quat"),
)
"""Fields of the data from which MuJoCo steps, and which a program may write to."""


def watched_fields(model: mujoco.MjModel) -> dict[str, bytes]:
    """Returns the numbers of a compiled model by name, without those that a run itself writes to.

    Arrays above ``_MAX_WATCHED``, the gains of the coupling's actuators and what is drawn alone are
    left out.
    """
    added, watched = list(added_actuators(model)), {}
    for prefix, part in (("", model), ("opt.", model.opt)):
        for name in dir(part):
            is_left_out = name.startswith("_") or name in _OF_A_RUN
            if is_left_out or _OF_PICTURES.fullmatch(name):
                continue
            value = getattr(part, name)
            if isinstance(value, int | float):
                watched[prefix + name] = repr(value).encode()
            elif isinstance(value, np.ndarray) and value.nbytes <= _MAX_WATCHED:
                if name in ("actuator_gainprm", "actuator_biasprm"):
                    value = np.delete(value, added, axis=0)
                watched[prefix + name] = value.tobytes()
    return watched


def state_of_scene(model: mujoco.MjModel) -> dict[str, Any]:
    """Returns which numbers of a state are the scene's own, by field of the data.

    The bridge writes to its handles and their couplings, so nothing that is written there stays.
    """
    handles = list(handle_ids(model).values())
    mocaps = model.body_mocapid[handles]
    controls = model.actuator_ctrladr[list(added_actuators(model))]
    own = {"ctrl": (model.nu, controls), "xfrc_applied": (model.nbody, handles)}
    own |= dict.fromkeys(("mocap_pos", "mocap_quat"), (model.nmocap, mocaps))
    rest = {name: np.setdiff1d(np.arange(count), ids) for name, (count, ids) in own.items()}
    return {name: rest.get(name, ...) for name in _OF_STATE}


def watched_state(data: mujoco.MjData, parts: Mapping[str, Any]) -> dict[str, bytes]:
    """Returns the ``state_of_scene``, which nothing but a program writes to between two ticks."""
    return {f"data.{name}": getattr(data, name)[part].tobytes() for name, part in parts.items()}


def changed_words(fields: str) -> str:
    """Returns a clause on a change of the scene that no recording holds; ``fields`` or empty."""
    what = f"{fields} of the scene" if fields else "the scene"
    return f"{what} was changed during the run other than by set_input"


MAX_WORDS = 500
"""Largest number of characters of a text that is read from a foreign file."""


def change_in(events: Iterable[Mapping[str, Any]]) -> str:
    """Returns the fields that a program changed as the events tell; empty if none does."""
    found = (each.get("fields") for each in events if each.get("event") == CHANGED_EVENT)
    return str(next(found, "") or "")[:MAX_WORDS]


def change_remedy(fields: str) -> str:
    """Returns what to do in place of a change of the scene that nothing metered."""
    return (
        f"{changed_words(fields)}, and no meter sees that: give controls, forces and moved mocap "
        "bodies by set_input, and start a new run for another model or state"
    )


def start_state(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Returns the full state on which MuJoCo's next step depends."""
    state = np.zeros(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, state, _STATE)
    return state


def restore_state(model: mujoco.MjModel, data: mujoco.MjData, state: bytes) -> None:
    """Sets data to a state from ``start_state``.

    Raises:
        RecordingError: The bytes are not a state of this model.
    """
    expected = 8 * mujoco.mj_stateSize(model, _STATE)
    if len(state) != expected:
        raise RecordingError(
            f"attachment '{STATE_ATTACHMENT}' has {len(state)} bytes; the attached scene needs "
            f"{expected}"
        )
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, np.frombuffer(state, dtype="<f8").astype(np.float64), _STATE)
    mujoco.mj_forward(model, data)
    # mj_forward runs the solver and changes the warm start, so the state is set again
    mujoco.mj_setState(model, data, np.frombuffer(state, dtype="<f8").astype(np.float64), _STATE)


def sample_at(pose: tuple[float, ...]) -> NDArray[np.void]:
    """Returns a device's sample at a pose (x, y, z, qw, qx, qy, qz), without buttons."""
    sample = np.zeros(1, SAMPLE_DTYPE)
    sample["position"][0], sample["quaternion"][0] = pose[:3], pose[3:]
    return sample


def start_of(state: NDArray[np.void], name: str) -> list[float]:
    """Returns one of ``STARTS`` from the kernel's state before the first tick."""
    if name in _STORED:
        return [float(state["energy"][_STORED[name]][0])]
    body = name.removesuffix("_start")
    pose = state["pose"][0]
    numbers = (*pose[f"{body}_position"], *pose[f"{body}_quaternion"])
    return [float(value) for value in numbers]


# Numbers of a recording's metadata

_MAX_TICKS = 2**31


def _meta_text(meta: Mapping[str, str], name: str) -> str:
    try:
        return meta[name]
    except KeyError:
        raise RecordingError(f"the recording's metadata lack '{name}'") from None


def meta_float(meta: Mapping[str, str], name: str) -> float:
    """Returns a number of the metadata, equal to the last bit.

    Raises:
        RecordingError: It is missing, not a number or not finite.
    """
    text = _meta_text(meta, name)
    try:
        value = float(text)
    except ValueError:
        raise RecordingError(f"metadata '{name}' is {text!r:.80}, not a number") from None
    if not math.isfinite(value):
        raise RecordingError(f"metadata '{name}' is {value}; it must be finite")
    return value


def meta_numbers(meta: Mapping[str, str], name: str, count: int) -> tuple[float, ...]:
    """Returns a list of numbers of the metadata.

    Raises:
        RecordingError: It is missing, or not ``count`` finite numbers.
    """
    text = _meta_text(meta, name)
    try:
        values = tuple(float(value) for value in read_json(text))
    except (ValueError, TypeError, OverflowError):
        values = ()
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise RecordingError(
            f"metadata '{name}' is {text!r:.80}; it must be {count} finite numbers"
        )
    return values


def meta_start(meta: Mapping[str, str], name: str) -> list[float]:
    """Returns one of ``STARTS`` from the metadata.

    Raises:
        RecordingError: It is missing, or has a wrong number of values.
    """
    if STARTS[name] == 1:
        return [meta_float(meta, name)]
    return list(meta_numbers(meta, name, STARTS[name]))


def meta_count(meta: Mapping[str, str], name: str) -> int:
    """Returns a count of the metadata.

    Raises:
        RecordingError: It is missing, not a whole number, or out of range.
    """
    value = meta_float(meta, name)
    if not value.is_integer() or not 0 <= value < _MAX_TICKS:
        raise RecordingError(f"metadata '{name}' is {value:g}; it must be a whole number >= 0")
    return int(value)


# Software versions and processor of a run


def versions() -> dict[str, str]:
    """Returns the versions on which a bit-exact repetition depends."""
    packages = ("hapticbridge", "mujoco", "numba", "numpy", "scipy", "mcap")
    versions = {name: _version_of(name) for name in packages}
    return versions | {"python": platform.python_version()}


_version_of = cache(version)  # parses the package's metadata: 2 ms each


def processor() -> str:
    """Returns the processor's model, or its architecture if the system does not report it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:  # noqa: PTH123 - not a file to keep
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


SOURCE_PREFIX = "scene/"

FELT, CARRIED = "felt", "carried"
"""Values of ``tool_weight`` in the metadata; it is carried if the scene compensates the weight."""

_FLOATS = tuple(
    name for name, kind in types_of(RunParameters).items() if kind is float and name != "period"
)
_POSES = ("device_origin", "handle_origin", "device_start")
_GAINS = tuple(field.name for field in fields(Coupling))


def attachments(scene: Scene) -> list[Attachment]:
    """Returns the scene's sources and start state as attachments.

    Call it after the scene was prepared and reset. The compiled model is not attached: MuJoCo's
    loader of models is unsafe on foreign bytes, and the sources compile to it
    (``recorded_scene``).
    """
    kept = [
        Attachment(SOURCE_PREFIX + source.name, "application/octet-stream", source.data)
        for source in scene.sources
    ]
    state = start_state(scene.model, scene.data).astype("<f8").tobytes()
    kept.append(Attachment(STATE_ATTACHMENT, "application/octet-stream", state))
    return kept


def describe_parameters(parameters: RunParameters) -> dict[str, str]:
    """Returns the parameters of a hand's run as metadata; ``parameters_of`` is the inverse."""
    coupling = parameters.coupling
    effective = parameters.effective
    meta = {
        "grip": parameters.grip,
        "period_s": repr(parameters.period),
        "substeps": str(parameters.substeps),
        "scene_ticks": str(parameters.scene_ticks),
        "ramp_ticks": str(parameters.ramp_ticks),
        "contact": RIGID if parameters.is_rigid else SCENE,
    }
    meta |= {name: repr(float(getattr(parameters, name))) for name in _FLOATS}
    meta |= {name: json.dumps(getattr(parameters, name)) for name in (*_POSES, "axes")}
    return meta | {
        "guard": parameters.guarding.to_json(),
        **{name: repr(float(getattr(coupling, name))) for name in _GAINS},
        "effective": json.dumps(effective and [getattr(effective, name) for name in _GAINS]),
    }


def describe_scene(scene: Scene) -> dict[str, str]:
    """Returns the metadata of a prepared scene."""
    return {
        "tool_weight": CARRIED if scene.is_carried else FELT,
        "scene_changes": json.dumps(scene.changes, ensure_ascii=False),
        "scene_parameters": json.dumps(scene.parameters),
        "scene_sha256": model_digest(scene.model),
    }


def describe_start(state: NDArray[np.void]) -> dict[str, str]:
    """Returns the metadata of a hand's start, from the kernel's state before the first tick."""
    starts = {name: start_of(state, name) for name in STARTS}
    return {
        name: json.dumps(start if STARTS[name] > 1 else start[0]) for name, start in starts.items()
    }


def describe_machine() -> dict[str, str]:
    """Returns the metadata of program, machine and time."""
    return {
        "versions": json.dumps(versions(), sort_keys=True),
        "host": json.dumps(
            {"system": platform.system(), "machine": platform.machine(), "processor": processor()}
        ),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def describe_hands(metas: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Returns the recording's metadata from those of each hand; of one hand, just its own.

    The first hand's are those of the run; ``hands`` holds what differs in each other hand.
    """
    first, *others = metas
    if not others:
        return dict(first)
    differing = [
        {name: text for name, text in each.items() if text != first.get(name)} for each in others
    ]
    return {**first, HANDS_KEY: json.dumps(differing)}


def metas_of(meta: Mapping[str, str]) -> list[Mapping[str, str]]:
    """Returns the metadata of every hand, from those of the first.

    Raises:
        RecordingError: Those of further hands are damaged.
    """
    return [meta, *({**meta, **own} for own in further_hands(meta))]


def method_of(meta: Mapping[str, str]) -> Method:
    """Returns the method of a recorded run, with its contact.

    Raises:
        SceneError: Method or contact is unknown, or they exclude each other.
        RecordingError: The method is missing.
    """
    return method_named(_meta_text(meta, "method")).with_contact(meta.get("contact", ""))


def _effective(meta: Mapping[str, str], method: Method) -> Coupling | None:
    """Returns a weld's measured coupling; None for other methods."""
    if not method.is_weld:
        return None
    return Coupling(*meta_numbers(meta, "effective", len(_GAINS)))


def requested_of(meta: Mapping[str, str]) -> Coupling:
    """Returns the requested coupling of a recorded run.

    Raises:
        RecordingError: It is missing or out of range.
    """
    try:
        return Coupling(*meta_numbers(meta, "requested", len(_GAINS)))
    except CouplingError as error:
        raise RecordingError(f"metadata 'requested' is out of range: {error}") from None


def parameters_of(meta: Mapping[str, str]) -> RunParameters:
    """Returns the parameters of a recorded run.

    Raises:
        RecordingError: A value is missing or out of range.
    """
    try:
        method = method_of(meta)
        device = None if method.has_law else DeviceInfo.from_json(meta.get("device", ""))
        damping, rotational = (None, None) if device is None else device.dissipating_damping
        numbers: dict[str, Any] = {name: meta_float(meta, name) for name in _FLOATS}
        numbers |= {name: meta_numbers(meta, name, 7) for name in _POSES}
        return RunParameters(
            grip=meta.get("grip", ""),
            period=meta_float(meta, "period_s"),
            substeps=meta_count(meta, "substeps"),
            scene_ticks=meta_count(meta, "scene_ticks"),
            coupling=Coupling(**{name: meta_float(meta, name) for name in _GAINS}),
            ramp_ticks=meta_count(meta, "ramp_ticks"),
            axes=meta_numbers(meta, "axes", 9),
            scheme=method.scheme,
            is_rigid=method.is_rigid,
            effective=_effective(meta, method),
            **numbers,
            device_damping=damping,
            device_rotational_damping=rotational,
            guarding=GuardParameters.from_json(meta.get("guard", "")),
        )
    except RecordingError:
        raise
    except HapticBridgeError as error:
        raise RecordingError(f"the recording's metadata are out of range: {error}") from None
