"""Simulates a recorded run again from what its recording holds, and compares every number."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.inputs import apply_writes
from hapticbridge.kernel.state import COUPLING_ACTUATORS, Binding, RunParameters
from hapticbridge.kernel.step import simulate_recorded
from hapticbridge.provenance import (
    MODEL_ATTACHMENT,
    STARTS,
    STATE_ATTACHMENT,
    meta_start,
    processor,
    restore_state,
    start_of,
    versions,
)
from hapticbridge.recording import Recording
from hapticbridge.rendering import check_prepared, method_named
from hapticbridge.tick import CLOCK_FIELDS, SAMPLE_DTYPE, TICK_DTYPE, TickFlag

DECISIVE = ("hapticbridge", "mujoco", "numba")
"""Packages whose versions must match for a run to be repeated to the bit."""

FOREIGN_TOLERANCE = 1e-9
"""Allowed difference, relative to a field's largest value, where the processor differs: other
vector instructions round differently. Larger would hide tampering, smaller would refuse honest
recordings."""

NOT_RUN = "not re-simulated"

_OUTSIDE = int(TickFlag.OVERRUN | TickFlag.DROPPED_BEFORE | TickFlag.STALE_SAMPLE)
"""Flags that the clock, the recorder and the device set, not the simulation."""


@dataclass(frozen=True, slots=True)
class Replay:
    """Outcome of a re-simulation.

    Attributes:
        agreement: ``bit for bit``, ``within 1e-9 (other processor)``, ``disagrees``, or ``not
            re-simulated: …`` with the reason.
        tick: First tick at which it disagrees, or None.
        field: The first field of that tick that disagrees.
        difference: By how much.
    """

    agreement: str
    tick: int | None = None
    field: str = ""
    difference: float = 0.0

    @property
    def has_run(self) -> bool:
        """Whether there was a re-simulation."""
        return not self.agreement.startswith(NOT_RUN)

    @property
    def disagrees(self) -> bool:
        """Whether the recording is not what the scene does under the recorded motion."""
        return self.tick is not None


def replay(recording: Recording, parameters: RunParameters) -> Replay:
    """Simulates the recorded device motion again and compares all fields but the clock's.

    Raises:
        RecordingError: The attachments contradict the metadata, so the file was changed.
    """
    reason = _obstacle(recording)
    if reason:
        return Replay(f"{NOT_RUN}: {reason}")
    model = _model(recording, parameters)
    data = mujoco.MjData(model)
    # an error inside the C symbol would end the process, so MuJoCo takes its first step in Python
    restore_state(model, data, recording.attachments[STATE_ATTACHMENT])
    method_named(recording.meta.get("method", "")).step(model, data)
    restore_state(model, data, recording.attachments[STATE_ATTACHMENT])
    binding = Binding(model, data, parameters)
    _check_start(recording, binding.state)
    return _compared(recording, _simulated(recording, binding, data))


def _obstacle(recording: Recording) -> str:
    try:
        recorded = dict(json.loads(recording.meta.get("versions", "")))
    except (ValueError, TypeError, RecursionError):
        return "the metadata name no versions"
    present = versions()
    for name in DECISIVE:
        if recorded.get(name) != present[name]:
            return f"recorded with {name} {recorded.get(name, 'unknown')}, here is {present[name]}"
    missing = [n for n in (MODEL_ATTACHMENT, STATE_ATTACHMENT) if n not in recording.attachments]
    return f"the file has no attachment '{missing[0]}'" if missing else ""


def _model(recording: Recording, parameters: RunParameters) -> mujoco.MjModel:
    content = recording.attachments[MODEL_ATTACHMENT]
    if hashlib.sha256(content).hexdigest() != recording.meta.get("scene_sha256"):
        raise RecordingError("the attached model is not the one of scene_sha256")
    try:
        model = mujoco.MjModel.from_binary_path(
            MODEL_ATTACHMENT, assets={MODEL_ATTACHMENT: content}
        )
    except ValueError as error:
        raise RecordingError(f"the attached model cannot be loaded: {error}") from None
    for name in (*COUPLING_ACTUATORS, parameters.grip):
        kind = mujoco.mjtObj.mjOBJ_SITE if name == parameters.grip else mujoco.mjtObj.mjOBJ_ACTUATOR
        if mujoco.mj_name2id(model, kind, name) < 0:
            raise RecordingError(f"the attached model has no '{name}'")
    method = method_named(recording.meta.get("method", ""))
    step = parameters.period / parameters.substeps
    forces, torques = method.gains(parameters.coupling, step)
    for axis, name in enumerate(COUPLING_ACTUATORS):
        actuator_id = model.actuator(name).id
        factor, stiffness, damping = forces if axis < 3 else torques
        bias = model.actuator_biasprm[actuator_id].tolist()
        gain = float(model.actuator_gainprm[actuator_id, 0])
        if (bias[1], bias[2], gain) != (-stiffness, -damping, factor):
            raise RecordingError(
                f"the attached model's coupling has K = {-bias[1]!r}, B = {gain!r} in {name}, "
                f"the metadata say {stiffness!r}, {factor!r}"
            )
    try:
        check_prepared(model, parameters, method)
    except HapticBridgeError as error:
        raise RecordingError(f"the attached model does not fit the metadata: {error}") from None
    if model.opt.timestep != parameters.period / parameters.substeps:
        raise RecordingError(
            f"the attached model's timestep is {model.opt.timestep!r} s, the metadata's period "
            f"{parameters.period!r} s with {parameters.substeps} substeps"
        )
    return model


def _check_start(recording: Recording, state: NDArray[np.void]) -> None:
    """Refuses metadata that do not repeat the start of the attached scene."""
    for name in STARTS:
        recorded = meta_start(recording.meta, name)
        present = start_of(state, name)
        if not np.allclose(recorded, present, rtol=FOREIGN_TOLERANCE, atol=FOREIGN_TOLERANCE) or (
            _is_same_processor(recording) and recorded != present
        ):
            raise RecordingError(
                f"metadata '{name}' is {recorded}, the attached scene starts with {present}"
            )


def _is_same_processor(recording: Recording) -> bool:
    try:
        return bool(json.loads(recording.meta["host"])["processor"] == processor())
    except (KeyError, TypeError, ValueError, RecursionError):
        return True


def _simulated(recording: Recording, binding: Binding, data: mujoco.MjData) -> NDArray[np.void]:
    ticks = recording.ticks
    samples = np.zeros(len(ticks), SAMPLE_DTYPE)
    samples["position"], samples["quaternion"] = (
        ticks["device_position"],
        ticks["device_quaternion"],
    )
    samples["buttons"] = ticks["buttons"]
    rows = np.zeros(len(ticks), TICK_DTYPE)
    outside = ticks["flags"] & int(TickFlag.STALE_SAMPLE | TickFlag.RESEATED)
    elapsed = _elapsed(ticks, recording.events)
    changes = [event for event in recording.events if event.get("event") in ("input", "resume")]
    done = 0
    for event in [*changes, None]:
        end = len(ticks) if event is None else _tick_of(event, done, len(ticks))
        part = slice(done, end)
        count = simulate_recorded(
            binding.state, samples[part], outside[part], elapsed[part], binding.row, rows[part]
        )
        done += count
        if done < end:
            return rows[:done]
        if event is not None:
            _apply(event, binding, data)
    return rows


def _elapsed(ticks: NDArray[np.void], events: list[dict[str, Any]]) -> NDArray[np.float64]:
    """Returns the times between two readings in s, as the live loop counted them."""
    resumed: list[Any] = [e.get("tick") for e in events if e.get("event") == "resume"]
    read = ticks["read_ns"]
    before = np.concatenate([np.zeros(1, np.int64), read[:-1]])
    before[np.isin(ticks["tick"], resumed)] = 0
    return np.asarray(1e-9 * (read - before))


def _tick_of(event: dict[str, Any], done: int, count: int) -> int:
    tick = event.get("tick")
    if not isinstance(tick, int) or tick < done:
        raise RecordingError(f"event '{event['event']}' names tick {tick!r}, out of order")
    return min(tick, count)


def _apply(event: dict[str, Any], binding: Binding, data: mujoco.MjData) -> None:
    if event["event"] == "resume":
        binding.resume()
        return
    try:
        apply_writes(data, event.get("writes", []))
    except (HapticBridgeError, TypeError, ValueError) as error:
        raise RecordingError(
            f"event 'input' at tick {event.get('tick')} is damaged: {error}"
        ) from None


def _compared(recording: Recording, again: NDArray[np.void]) -> Replay:
    ticks = recording.ticks[: len(again)]
    first: tuple[int, str, float] | None = None
    largest = 0.0
    for name in TICK_DTYPE.names or ():
        if name in CLOCK_FIELDS:
            continue
        recorded, simulated = ticks[name], again[name]
        if name == "flags":
            recorded, simulated = recorded & ~_OUTSIDE, simulated & ~_OUTSIDE
        unequal = (recorded != simulated).reshape(len(again), -1).any(axis=1)
        if not unequal.any():
            continue
        difference = np.abs(recorded - simulated).reshape(len(again), -1).max(axis=1)
        largest = max(largest, float(difference.max() / max(np.abs(simulated).max(), 1.0)))
        tick = int(np.argmax(unequal))
        if first is None or tick < first[0]:
            first = (tick, name, float(difference[tick]))
    if len(again) < len(recording.ticks) and first is None:
        first = (len(again), "tool_position", float("nan"))
        largest = float("inf")
    if first is None:
        return Replay("bit for bit")
    if not _is_same_processor(recording) and largest <= FOREIGN_TOLERANCE:
        return Replay("within 1e-9 (other processor)")
    return Replay("disagrees", *first)
