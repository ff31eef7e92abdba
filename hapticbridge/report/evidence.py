"""Records and energies of a run, prepared for plots and rules."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.energy import energy_balances
from hapticbridge.audit.events import AuditedRun, AuditState
from hapticbridge.demand.methods import Method, RunCoupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.codes import RAMPING
from hapticbridge.kernel.impact_pulse import ENDS, FADED
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import due_times
from hapticbridge.kernel.restitution import MAX_RESTITUTION
from hapticbridge.recording import Recording
from hapticbridge.recording.reader import BLOCK
from hapticbridge.run.description import method_of, parameters_of, requested_of
from hapticbridge.run.summary import was_never_lossless

DRAWABLE = 1e9
"""Largest magnitude in N, m or J that is drawn; a larger one is not physical and breaks the plot's
axes."""


def is_motion_prescribed(meta: Mapping[str, str]) -> bool:
    """Returns True if no hand felt the recorded forces, or if the data sheet is damaged."""
    try:
        return DeviceInfo.from_json(meta.get("device", "")).is_prescribed
    except HapticBridgeError:
        return True


def recorded_coupling(recording: Recording) -> RunCoupling:
    """Returns the coupling of a run at its start; for a joint, at the fingers.

    Raises:
        RecordingError: The recording does not describe it.
    """
    meta = recording.meta
    return RunCoupling.of_run(
        method_of(meta),
        requested_of(meta),
        parameters_of(meta),
        was_never_lossless=was_never_lossless(recording.count, recording.flags),
    )


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Evidence:
    """A run of n ticks that can be drawn.

    Attributes:
        recording: The recording, with n >= 1 ticks.
        parameters: Run parameters.
        worst: Run parameters with the most demanding coupling that commands selected.
        info: The device.
        method: The rendering method.
        time: Due time of each tick in s on the clock of the events, (n,).
        created: Energy that the environment has created so far, (n,) in J.
        allowed: Slack: energy that the environment may have created so far, (n,) in J.
        excess: Energy given to the device beyond its dissipation and what scene and coupling
            released, so far, (n,) in J; zeros if it cannot be computed
            (``EnergyBalance.excess_device_energy``).
        taken: Energy of the scene that blows have paid for pulses so far, (n,) in J.
        model: The compiled scene, in the process that may compile it; else None.
    """

    recording: Recording
    parameters: RunParameters
    worst: RunParameters
    info: DeviceInfo
    method: Method
    time: Array
    created: Array
    allowed: Array
    excess: Array
    taken: Array
    model: mujoco.MjModel | None = None

    @property
    def ticks(self) -> NDArray[np.void]:
        """Records, ``TICK_DTYPE``, (n,)."""
        return self.recording.ticks

    @property
    def events(self) -> list[dict[str, Any]]:
        """Recorded events."""
        return self.recording.events

    @property
    def lateness(self) -> Array:
        """Delay of each tick's start after its deadline, (n,) in s."""
        return np.asarray(1e-9 * (self.ticks["wake_ns"] - self.ticks["deadline_ns"]))

    def judged(self, report: AuditReport) -> tuple[Array, Array]:
        """Returns the energy of the port at fault and its bound, (n,) in J each.

        The verdict must be ``active``.
        """
        if report.port == "device":
            return self.excess, np.zeros_like(self.excess)
        # a strict audit grants no slack
        is_slack_used_up = report.environment == "active"
        return self.created, self.allowed if is_slack_used_up else np.zeros_like(self.allowed)

    @classmethod
    def of_hands(cls, hands: Sequence[Recording]) -> tuple[Evidence, ...]:
        """Computes the evidence of every hand; empty if one is damaged or has no ticks.

        The slack of the scene is that of all hands together.
        """
        found = []
        for hand in hands:
            others = [other for other in hands if other is not hand]
            evidence = cls.of(hand, others)
            if evidence is None:
                return ()
            found.append(evidence)
        allowed = np.sum([each.allowed for each in found], axis=0)
        return tuple(replace(each, allowed=allowed) for each in found)

    @classmethod
    def of(cls, recording: Recording, others: Sequence[Recording] = ()) -> Evidence | None:
        """Computes the evidence of a recording; None if it is damaged or has no ticks.

        The recording need not have passed an audit. ``others`` are those of the other hands, whose
        work on the scene counts.
        """
        ticks = recording.ticks
        fields = (name for name in ticks.dtype.names or () if ticks.dtype[name].base.kind == "f")
        if not len(ticks) or not all((np.abs(ticks[name]) < DRAWABLE).all() for name in fields):
            return None
        try:
            run = AuditedRun.of(recording)
            worst = run.worst
            state = AuditState.at_start(recording, run.parameters)
            # by blocks, because the whole run at once would need much more memory
            begins = range(0, len(ticks), BLOCK)
            blocks = (ticks[begin : begin + BLOCK] for begin in begins)
            work = None
            if others:
                total = np.sum([other.ticks["coupling_work"] for other in others], axis=0)
                work = (total[begin : begin + BLOCK] for begin in begins)
            balances = energy_balances(blocks, state, run.events, run.delay, work)
            energies = np.concatenate(
                [
                    (
                        each.environment_energy,
                        each.slack,
                        each.excess_device_energy,
                        each.pulses.taken,
                    )
                    for _, each in balances
                ],
                axis=1,
            )
        except HapticBridgeError:
            return None
        return cls(
            recording=recording,
            parameters=run.parameters,
            worst=worst,
            info=run.info,
            method=run.method,
            time=due_times(ticks, run.parameters.period),
            created=energies[0],
            allowed=energies[1],
            excess=energies[2],
            taken=energies[3],
        )


# Blows of the tool


@dataclass(frozen=True, slots=True)
class Blow:
    """One blow of the tool: ticks in a row in which a contact of it closes fast.

    Attributes:
        time: Due time of its first tick in s.
        tick: Number of this tick.
        speed: Largest normal speed of its contact at the start of a tick in m/s, of the largest
            blow if there are several.
        asked: Coefficient of restitution e that the contact asks for.
        had: e that it had.
        burned: Energy W in J that it took from the bodies.
        paid: Energy in J at the hand that it paid into the account of pulses.
        worked: Work Σ p·δp in J of the pulses until the next blow; negative if the hand did it.
        ended_by: Flags of the tick that ended its pulse early (``impact_pulse.ENDS``); 0 if none.
    """

    time: float
    tick: int
    speed: float
    asked: float
    had: float
    burned: float
    paid: float
    worked: float
    ended_by: int

    @property
    def returned(self) -> float:
        """Energy in J that it gave back, as one contact with its e does: W e²/(1 − e²)."""
        return self.burned * self.had**2 / (1.0 - min(self.had, MAX_RESTITUTION) ** 2)


def blows_of(evidence: Evidence) -> list[Blow]:
    """Returns the blows of the tool in order."""
    ticks, parameters = evidence.ticks, evidence.parameters
    struck = np.flatnonzero(ticks["blow_energy"] > 0.0)
    if not struck.size:
        return []
    groups = np.split(struck, np.flatnonzero(np.diff(struck) > 1) + 1)
    ratio = parameters.force_scale / parameters.scale
    paid = ratio * np.diff(evidence.taken, prepend=0.0)
    moved = np.diff(ticks["device_position"], axis=0, append=ticks["device_position"][-1:])
    work = np.sum(ticks["pulse"] * moved, axis=1)
    stops = (ticks["flags"] & ENDS) | np.where(ticks["lever"] == 0.0, RAMPING, 0)
    life = math.ceil(-math.log(FADED) * parameters.pulse_decay / parameters.period) + 1
    ends = [group[0] + 1 for group in groups[1:]] + [len(ticks)]
    found = []
    for group, end in zip(groups, ends, strict=True):
        rows, last = ticks[group], ticks[group[-1]]
        speed, given = float(rows["blow_speed"].max()), float(paid[group].sum())
        after = stops[group[-1] + 1 : min(group[-1] + 1 + life, end)]
        found.append(
            Blow(
                time=float(evidence.time[group[0]]),
                tick=int(rows["tick"][0]),
                speed=speed,
                asked=float(rows["blow_restitution"].max()),
                had=float(last["blow_rebound"] * last["blow_speed"]) / speed,
                burned=float(rows["blow_energy"].sum()),
                paid=given,
                worked=float(work[group[0] + 1 : end].sum()),
                ended_by=int(after[np.argmax(after != 0)]) if given and after.size else 0,
            )
        )
    return found
