"""Parameters and external actions of a recorded run, from metadata and events.

This is the second reading of the events. ``commands`` applies them one by one to the
kernel; here they become arrays over ticks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import is_number, shown
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import conditions_of
from hapticbridge.demand.loop_setting import LoopSetting, delay_ticks
from hapticbridge.demand.methods import Method, RunCoupling
from hapticbridge.demand.own_loop import EVENT as OWN_LOOP_EVENT
from hapticbridge.demand.own_loop import OwnLoopAccount, OwnLoopTally
from hapticbridge.demand.probe import EVENT as PROBE_EVENT
from hapticbridge.demand.probe import MAX_DELAY, Direction
from hapticbridge.device import AXES, DeviceInfo
from hapticbridge.errors import HapticBridgeError, RecordingError, choices
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.recording import RecordingFile
from hapticbridge.run.commands import bits_in, concerns, coupling_in, pose_in, tuning_ticks
from hapticbridge.run.description import STARTS, meta_start, method_of, parameters_of
from hapticbridge.units import format_count

Array = NDArray[np.float64]

_LATEST = 2**62


@dataclass(frozen=True, slots=True)
class RunEvents:
    """Pauses, resets, switches and couplings of a run.

    Attributes:
        parameters: Run parameters at the start.
        resumed: Ticks at which the run resumed after a pause without force.
        resets: Ticks before which the scene was reset.
        couplings: Couplings of the law (K and B') in order, the initial one first.
        added_delay: Delay in s that the probe found beyond the stated one.
        unanswered: Axes of which the probe could not tell the direction, by name.
        reports: Events with what a loop of the device's own has reported.
    """

    parameters: RunParameters
    resumed: Array
    resets: Array
    couplings: tuple[Coupling, ...]
    added_delay: float
    unanswered: str
    reports: tuple[Mapping[str, Any], ...]
    _began: Array
    _switched: tuple[Array, NDArray[np.int64]]
    _homes: tuple[Array, Array]

    @classmethod
    def from_recording(cls, recording: RecordingFile, parameters: RunParameters) -> RunEvents:
        """Reads the events of a recording.

        Raises:
            RecordingError: An event is damaged, or the metadata lack the tool's start.
        """
        names = "resume", "reset", "coupling", "switch", PROBE_EVENT, OWN_LOOP_EVENT
        by_name: dict[str, list[Mapping[str, Any]]] = {name: [] for name in names}
        for event in recording.events:
            if event.get("event") in by_name and concerns(event, parameters):
                by_name[str(event["event"])].append(event)
        ticks = {
            name: np.array([_tick(event) for event in events], float)
            for name, events in by_name.items()
        }
        return cls(
            parameters=parameters,
            resumed=ticks["resume"],
            resets=ticks["reset"],
            couplings=(
                parameters.coupling,
                *(coupling_in(event, parameters) for event in by_name["coupling"]),
            ),
            added_delay=max(map(_added_delay, by_name[PROBE_EVENT]), default=0.0),
            unanswered=", ".join(filter(None, map(_unanswered, by_name[PROBE_EVENT]))),
            reports=tuple(by_name[OWN_LOOP_EVENT]),
            _began=ticks["coupling"],
            _switched=(
                ticks["switch"],
                np.array([bits_in(e) for e in by_name["switch"]], np.int64),
            ),
            _homes=_homes(recording.meta, by_name["reset"]),
        )

    def gains(self, numbers: NDArray[np.int64]) -> Array:
        """Returns K, B', K_r and B'_r in some ticks, (n, 4); a command changes them linearly."""
        goals = np.array([_gains(coupling) for coupling in self.couplings])
        length = tuning_ticks(self.parameters.period)
        value, start = np.tile(goals[0], (len(numbers), 1)), goals[0]
        for index, (begin, goal) in enumerate(zip(self._began, goals[1:], strict=True)):
            later = self._began[index + 1] if index + 1 < len(self._began) else _LATEST
            share = np.clip((numbers - begin + 1.0) / length, 0.0, 1.0)[:, None]
            value = np.where(share > 0, start + share * (goal - start), value)
            start = start + min(max((later - begin) / length, 0.0), 1.0) * (goal - start)
        return value

    @property
    def first_change(self) -> float:
        """Tick of the first change of the coupling; inf without one."""
        return float(self._began[0]) if len(self._began) else math.inf

    def buttons(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Returns the bits of ``buttons`` that commands set in some ticks."""
        ticks, bits = self._switched
        return np.concatenate([[0], bits])[np.searchsorted(ticks, numbers, side="right")]

    def is_first(self, ticks: NDArray[np.void]) -> NDArray[np.bool_]:
        """Returns True for each record at a start or after a pause without force."""
        return np.asarray((ticks["tick"] == 0) | np.isin(ticks["tick"], self.resumed))

    def is_reset(self, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Returns True for each tick that began with a reset."""
        return np.isin(numbers, self.resets)

    def homes(self, numbers: NDArray[np.int64]) -> tuple[Array, Array]:
        """Returns the poses of handle and tool after the newest reset until each tick, (n, 7)."""
        newest = np.searchsorted(self.resets, numbers, side="right") - 1
        handles, tools = self._homes
        return handles[np.maximum(newest, 0)], tools[np.maximum(newest, 0)]

    def changes_of_coupling(self, method: Method) -> tuple[str, ...]:
        """Returns sentences about changes of the coupling; empty without any."""
        first, last = self.couplings[0], self.couplings[-1]
        if last is first:
            return ()
        run = self.parameters
        coupling = RunCoupling.of(method, run.timestep, law=last)
        translation, *rotation = coupling.sentences()
        if last.rotational_stiffness == first.rotational_stiffness:
            rotation = []
        return (
            f"so it began; commands changed the coupling "
            f"{format_count(len(self.couplings) - 1, 'time')}, last to "
            f"{'; '.join([translation, *rotation])}",
        )


@dataclass(frozen=True, slots=True)
class AuditedRun:
    """Device, method, parameters and events of a recorded run.

    Attributes:
        info: The device.
        method: The rendering method.
        parameters: Run parameters, with the device's damping.
        events: External actions.
    """

    info: DeviceInfo
    method: Method
    parameters: RunParameters
    events: RunEvents

    @classmethod
    def of(cls, recording: RecordingFile) -> AuditedRun:
        """Reads metadata and events.

        Raises:
            RecordingError: They are damaged or do not describe a run.
        """
        meta, parameters = recording.meta, parameters_of(recording.meta)
        try:
            info = DeviceInfo.from_json(meta.get("device", ""))
            method = method_of(meta)
        except HapticBridgeError as error:
            raise RecordingError(f"the metadata do not describe a run: {error}") from None
        linear, angular = info.dissipating_damping
        parameters = replace(parameters, device_damping=linear, device_rotational_damping=angular)
        return cls(info, method, parameters, RunEvents.from_recording(recording, parameters))

    @property
    def own_loop(self) -> OwnLoopAccount | None:
        """Account of a loop of the device's own; None without one.

        Raises:
            RecordingError: An event with its reports is damaged.
        """
        if not self.parameters.is_apart:
            return None
        tally = OwnLoopTally.begin(self.parameters.loop_period, self.info.resolution or 0.0)
        return tally.of_events(self.events.reports)

    @property
    def worst(self) -> RunParameters:
        """Run parameters with the most demanding coupling, per kind of axis.

        It leaves the smallest share of damping or of friction. Both requirements are convex in the
        coupling, so no intermediate coupling needs more.
        """
        run, couplings = self.parameters, self.events.couplings
        if len(couplings) == 1:
            return run
        loop = LoopSetting.of_run(self.info, run, self.method)

        def demand(coupling: Coupling, axis: str) -> tuple[float, float]:
            conditions = conditions_of(replace(loop, law=coupling))
            own = [(-each.margin, each.needed) for each in conditions if each.axis == axis]
            return max(own, default=(0.0, 0.0))

        linear, angular = (
            max(couplings, key=partial(demand, axis=axis)) for axis in ("translation", "rotation")
        )
        return replace(run, coupling=linear.with_axis("rotation", *angular.gains("rotation")))

    @property
    def delay(self) -> int:
        """Delay in ticks from a sample to the wrench that answers it; 0 if unknown.

        It is 0 too for a wrench that the device reports with its sample.
        """
        if self.parameters.is_apart:
            return 0
        return delay_ticks(self.info, self.parameters.period) or 0


def _tick(event: Mapping[str, Any]) -> int:
    tick = event.get("tick")
    if not isinstance(tick, int) or isinstance(tick, bool) or not 0 <= tick < _LATEST:
        raise RecordingError(
            f"event '{event.get('event')}' has tick {tick!r}; it must be a whole number >= 0"
        )
    return tick


def _homes(meta: Mapping[str, str], resets: Sequence[Mapping[str, Any]]) -> tuple[Array, Array]:
    """Returns the poses of handle and tool after each reset, (m, 7); at the start without one."""
    starts = [tuple(meta_start(meta, f"{body}_start")) for body in ("handle", "tool")]
    placed = [pose_in(event) for event in resets]
    handles, tools = (
        np.array([pose or start for pose in placed] or [start], float) for start in starts
    )
    return handles, tools


def _added_delay(event: Mapping[str, Any]) -> float:
    delay = event.get("added_delay")
    if not is_number(delay) or not 0.0 <= float(delay) <= MAX_DELAY:
        raise RecordingError(
            f"event '{PROBE_EVENT}' has added_delay {shown(delay)}; it must be 0 to {MAX_DELAY} s"
        )
    return float(delay)


def _unanswered(event: Mapping[str, Any]) -> str:
    axes, known = event.get("axes"), [each.value for each in Direction]
    if (
        not isinstance(axes, dict)
        or not axes.keys() <= set(AXES)
        or not all(each in known for each in axes.values())
    ):
        raise RecordingError(
            f"event '{PROBE_EVENT}' has axes {shown(axes)}; it must give the direction of each "
            f"axis: {choices(known)}"
        )
    return ", ".join(name for name, each in axes.items() if each == Direction.UNKNOWN)


def _gains(coupling: Coupling) -> tuple[float, ...]:
    return (
        coupling.stiffness,
        coupling.damping,
        coupling.rotational_stiffness,
        coupling.rotational_damping,
    )


# State carried from block to block

SUMS = (
    "coupling_work",
    "throughput",
    "device_energy",
    "device_throughput",
    "slack",
    "delayed_device_energy",
    "device_dissipation",
    "unfelt_work",
    "tank_ceiling",
    "discarded",
    "start_springs",
    "hand_energy",
    "guarded_energy",
    "hidden_energy",
    "created",
    "motors",
    "external",
    "inputs",
    "pushed",
    "work_at_reset",
    "released",
    "taken",
    "forgotten",
    "most_released",
    "sent_x",
    "sent_y",
    "sent_z",
    "pulse_account",
    "pulse_work",
    "pulse_taken",
    "pulse_size",
    "pulse_held",
)
"""Names of the cumulative energies, and of the force in N that the device held last."""


@dataclass(frozen=True, slots=True)
class AuditState:
    """State of the audit after the previous tick.

    Attributes:
        row: Record of the previous tick, (1,). Before the first tick it holds the poses at the
            start and zeros.
        since_sample: Time in s that the device has been without a new sample.
        rise_ticks: Ticks in which the share of the wrench rises from 0 to 1.
        start_energy: Kinetic plus potential energy before the first tick, in J.
        pulses: Pulses on the device in the last ticks, as many as may still act, (d + 1, 3) in N.
        sums: Cumulative energies in J, by the names of ``SUMS``.
    """

    row: NDArray[np.void]
    since_sample: float
    rise_ticks: float
    start_energy: float
    pulses: Array
    sums: dict[str, float]

    @classmethod
    def at_start(cls, recording: RecordingFile, parameters: RunParameters) -> AuditState:
        """Returns the state before the first tick.

        Raises:
            RecordingError: The metadata lack the start of the energy balance.
        """
        starts = {name: np.array(meta_start(recording.meta, name)) for name in STARTS}
        row = np.zeros(1, TICK_DTYPE)
        poses = {
            "device": np.array(parameters.device_start),
            "handle": starts["handle_start"],
            "tool": starts["tool_start"],
        }
        row["scene_tank"] = parameters.tank_at_start
        for body, pose in poses.items():
            row[f"{body}_position"], row[f"{body}_quaternion"] = pose[:3], pose[3:]
        return cls(
            row=row,
            since_sample=0.0,
            rise_ticks=float(parameters.ramp_ticks),
            start_energy=float(starts["start_kinetic"][0] + starts["start_potential"][0]),
            pulses=np.zeros((parameters.pulse_ticks + 1, 3)),
            sums=dict.fromkeys(SUMS, 0.0),
        )
