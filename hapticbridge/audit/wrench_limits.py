"""Second computation of the handle, the lever and the limited wrench of each tick.

Each tick follows from its record and the previous one:

    h_k = h_{k−1} + r_{k−1} scale A δp_k,    w_k = −r_k s Aᵀ f_k,    f_k = P_F(u_k)

r is the recorded lever, δp the device's motion, A the device's axes, f the wrench on the tool, u
the coupling's law at the recorded poses, F the force level, w the wrench on the device and s
``force_scale`` (divided by ``scale`` for torque). Where the record says so, the handle slipped
toward the tool, and its spring must not have gained. While the passivity controller acts, only the
norm is checked; the re-simulation checks the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import AuditState, RunEvents
from hapticbridge.audit.motion import (
    Array,
    Motion,
    quaternion_of,
    quaternion_product,
    turn_between,
    wrench_by_law,
)
from hapticbridge.audit.spring import levels_on_tool, shortened, springs
from hapticbridge.audit.structure import TOLERANCE, Deviation, is_let_go, may_fade
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import UNITS, TickFlag, has_flag

Flags = NDArray[np.bool_]

_FORCE, _TORQUE = slice(0, 3), slice(3, 6)

SINGLE = 1e-6
"""Largest share by which a device that computes in single precision may pass a limit."""

_ROUNDING = 16 * np.finfo(np.float64).eps
"""Rounding of a difference of poses, in rad, and as a share of the distance from the origin.
A coupling whose K + B/T is above 1e5 N/m makes more of it than ``TOLERANCE``."""


@dataclass(frozen=True, slots=True)
class AuditedBlock:
    """Consecutive records with the facts that both second computations need.

    Attributes:
        ticks: The records, at least one.
        following: The next records, as many as the device's delay in ticks, or fewer at the end.
        state: State before the records.
        motion: Motion of handle and tool.
        is_first: True for the first tick after a start or a pause without force, (n,).
        interval: Time in s since the device's last new sample, at least T between readings, (n,).
        lever_before: r_{k−1}, the part of the device's motion that the handle made, (n,).
        rise_ticks: Ticks in which r rises from 0 to 1, (n,).
        scene_ticks: Ticks between two results of a slower scene; 0 for another.
        is_posted: True if another program steps the scene.
    """

    ticks: NDArray[np.void]
    following: NDArray[np.void]
    state: AuditState
    motion: Motion
    is_first: Flags
    interval: Array
    lever_before: Array
    rise_ticks: Array
    scene_ticks: int
    is_posted: bool

    @classmethod
    def from_records(
        cls,
        ticks: NDArray[np.void],
        following: NDArray[np.void],
        state: AuditState,
        events: RunEvents,
    ) -> AuditedBlock:
        """Evaluates consecutive records, at least one."""
        parameters = events.parameters
        is_first, is_reset = events.is_first(ticks), events.is_reset(ticks["tick"])
        before = np.concatenate([state.row["lever"], ticks["lever"][:-1]])
        before[is_first] = first_lever(parameters)
        before[is_reset] = 0.0
        # a start rises slowly; after a reset, or once r has been 0, it rises within the fade
        is_short = is_reset | ((ticks["lever"] == 0.0) & may_fade(ticks))
        start, fade = newest(is_first), newest(is_short)
        rise = np.where(fade >= start, parameters.guarding.fade_ticks, parameters.ramp_ticks)
        rise = np.where((start < 0) & (fade < 0), state.rise_ticks, rise)
        return cls(
            ticks=ticks,
            following=following,
            state=state,
            motion=Motion.from_records(ticks, state, events, before),
            is_first=is_first,
            interval=_sample_intervals(ticks, state, parameters.period),
            lever_before=before,
            rise_ticks=rise,
            scene_ticks=parameters.scene_ticks,
            is_posted=parameters.credit > 0.0,
        )

    def state_after(self, sums: dict[str, float]) -> AuditState:
        """Returns the state after the records; ``sums`` are the cumulative energies."""
        row = self.ticks[-1:]
        return replace(
            self.state,
            row=row.copy(),
            since_sample=float(self.interval[-1] * has_flag(row, TickFlag.STALE_SAMPLE)[0]),
            rise_ticks=float(self.rise_ticks[-1]),
            pulses=np.concatenate([self.state.pulses, self.ticks["pulse"]])[
                -len(self.state.pulses) :
            ],
            sums=sums,
        )


def first_lever(parameters: RunParameters) -> float:
    """Returns r before the first tick and after a pause."""
    return 0.0 if parameters.guarding.has_hand or parameters.ramp_ticks > 0 else 1.0


def newest(is_on: Flags) -> NDArray[np.int64]:
    """Returns the newest row that is True up to each row; -1 before the first."""
    return np.maximum.accumulate(np.where(is_on, np.arange(len(is_on)), -1))


def _sample_intervals(ticks: NDArray[np.void], state: AuditState, period: float) -> Array:
    read_ns = np.concatenate([state.row["read_ns"], ticks["read_ns"]])
    interval = np.maximum(np.diff(read_ns) * 1e-9, period)
    interval[0] += state.since_sample
    # added one by one, so that the sums do not depend on the blocks
    for k in (1 + np.flatnonzero(has_flag(ticks[:-1], TickFlag.STALE_SAMPLE))).tolist():
        interval[k] += interval[k - 1]
    return np.asarray(interval)


def wrench_deviations(block: AuditedBlock, events: RunEvents) -> Iterator[Deviation]:
    """Yields the deviations of handle, wrench on the tool, lever, wrench and injected damping."""
    ticks, parameters = block.ticks, events.parameters
    yield from _handle_deviations(block, events)
    if parameters.has_law and parameters.law_evaluations == 1:
        gains = events.gains(ticks["tick"])
        law = wrench_by_law(ticks, gains, parameters, block.motion)
        for part, spring in zip((_FORCE, _TORQUE), springs(gains, parameters), strict=True):
            law[:, part] = spring.limited(law[:, part])
        deviation = Deviation.between(
            "wrench_on_tool", ticks["wrench_on_tool"], law, "N or N m", "coupling law and poses"
        )
        k, b, k_r, b_r = gains.T
        places = np.abs(ticks["handle_position"]).max(axis=1)
        rounded = places * (k + b / parameters.period) + k_r + b_r / parameters.period
        yield deviation._replace(allowed=deviation.allowed + _ROUNDING * rounded)
    lever, before, fade = ticks["lever"], block.lever_before, parameters.guarding.fade_ticks
    highest = np.minimum(before + 1 / (block.rise_ticks + 1), 1.0)
    lowest = np.maximum(before - 1 / fade, 0.0)
    risen, fallen = np.abs(lever - highest), np.abs(lever - lowest)
    off = np.where(is_let_go(ticks, parameters), fallen, risen)
    off = np.where(has_flag(ticks, TickFlag.STALE_SAMPLE), np.minimum(fallen, risen), off)
    # the watch's cap lies between the two, and the re-simulation checks it
    is_capped = has_flag(ticks, TickFlag.SWINGING | TickFlag.RUNS_AWAY | TickFlag.PROBED)
    is_probed = has_flag(ticks, TickFlag.PROBED)
    highest = np.where(is_probed, np.minimum(before + 1 / fade, 1.0), highest)
    lowest = np.where(has_flag(ticks, TickFlag.RUNS_AWAY), 0.0, lowest)
    off = np.where(is_capped, np.maximum(np.maximum(lever - highest, lowest - lever), 0.0), off)
    yield Deviation("lever", off, TOLERANCE, "", "buttons, events and flags")
    yield _wrench_deviation(block, parameters)
    is_active = has_flag(ticks, TickFlag.CONTROLLER_ACTIVE)
    guarding = parameters.guarding
    for name, limit in (
        ("injected_damping", guarding.max_damping),
        ("injected_rotational_damping", guarding.max_rotational_damping),
    ):
        damping, unit = ticks[name], UNITS[name]
        yield Deviation(name, np.where(is_active, 0.0, np.abs(damping)), 0.0, unit, "flags")
        beyond = np.maximum(damping - limit, -damping)
        yield Deviation(name, beyond, TOLERANCE * (1 + limit), unit, "the controller's limits")


def _handle_deviations(block: AuditedBlock, events: RunEvents) -> Iterator[Deviation]:
    """Compares the handle with the device's motion; where it slipped, the energy of its spring."""
    ticks, motion, parameters = block.ticks, block.motion, events.parameters
    moved, turned = motion.handle_step, motion.handle_turn
    position = motion.handle_before[:, :3] + moved
    orientation = quaternion_product(quaternion_of(turned), motion.handle_before[:, 3:])
    has_slipped = has_flag(ticks, TickFlag.REANCHORED)
    off = np.linalg.norm(ticks["handle_position"] - position, axis=1)
    angle = np.linalg.norm(turn_between(orientation, ticks["handle_quaternion"]), axis=1)
    gains, before = events.gains(ticks["tick"]), events.gains(ticks["tick"] - 1)
    tool = motion.tool_before
    # with n laws per tick the spring is compared after the first of the handle's n steps
    pulled, pulled_turn = motion.pulled(parameters.law_evaluations)
    slipped = pulled + ticks["handle_position"] - position
    back = quaternion_of((1.0 / parameters.law_evaluations - 1.0) * turned)
    slipped_turn = turn_between(tool[:, 3:], quaternion_product(back, ticks["handle_quaternion"]))
    rounded = _ROUNDING * np.abs(position).max(axis=1)  # of a scene far from its origin
    for kind, name, amount, lengths, unit, rounding in (
        (0, "handle_position", off, (pulled, slipped), "m", rounded),
        (1, "handle_quaternion", angle, (pulled_turn, slipped_turn), "rad", 0.0),
    ):
        stored, kept = (
            springs(k, parameters)[kind].energy(e)
            for k, e in zip((before, gains), lengths, strict=True)
        )
        gained = np.where(has_slipped & (amount > TOLERANCE), kept - stored, amount)
        allowed = TOLERANCE * (1 + stored) + rounding
        yield Deviation(name, gained, allowed, unit, "device pose and lever")


def axes_with_motor(parameters: RunParameters) -> Array:
    """Returns 1.0 for each axis of the device with a motor, else 0.0; (6,)."""
    return np.array([parameters.guarding.motors >> i & 1 for i in range(6)], dtype=np.float64)


def whole_wrench(ticks: NDArray[np.void], parameters: RunParameters) -> Array:
    """Returns the wrench that a device with six motors would be sent, (n, 6) in N and N m."""
    axes = np.array(parameters.axes).reshape(3, 3)
    on_tool = ticks["wrench_on_tool"].copy()
    if not parameters.has_law:  # a law limits it on the tool too
        for part, limit in zip((_FORCE, _TORQUE), levels_on_tool(parameters), strict=True):
            on_tool[:, part] = shortened(on_tool[:, part], limit)
    wrench = -parameters.force_scale * ticks["lever"][:, None] * on_tool
    return np.concatenate(
        [wrench[:, _FORCE] @ axes, wrench[:, _TORQUE] / parameters.scale @ axes], axis=1
    )


def without_pulse(ticks: NDArray[np.void]) -> Array:
    """Returns the wrench on the device without the pulses of blows, (n, 6) in N and N m."""
    wrench = ticks["wrench_on_device"].copy()
    wrench[:, _FORCE] -= ticks["pulse"]
    return wrench


def _wrench_deviation(block: AuditedBlock, parameters: RunParameters) -> Deviation:
    """Compares the wrench on the device with the wrench on the tool times the lever.

    A wrench that the device reports of a loop of its own is compared with the limits alone.
    """
    ticks = block.ticks
    expected = whole_wrench(ticks, parameters) * axes_with_motor(parameters)
    sent, source = ticks["wrench_on_device"], "wrench on the tool and lever"
    deviation = Deviation.between(
        "wrench_on_device", without_pulse(ticks), expected, "N or N m", source
    )
    limits = parameters.force_limit, parameters.torque_limit
    rounding = SINGLE if parameters.is_apart else TOLERANCE
    beyond = [
        np.linalg.norm(sent[:, part], axis=1) - limit * (1 + rounding)
        for part, limit in zip((_FORCE, _TORQUE), limits, strict=True)
    ]
    is_bounded_only = has_flag(ticks, TickFlag.CONTROLLER_ACTIVE) | parameters.is_apart
    return deviation._replace(
        amount=np.where(is_bounded_only, np.maximum(*beyond), deviation.amount)
    )
