"""Second computation of the guard: anchoring of the handle, ramp and limits of the wrench.

Each tick follows from its record and the previous one, because the record holds the share r of the
wrench that ramp and fade transmitted:

    w_k = r_k F_k,   F_k = slew(limit(−s Aᵀ f_k), F_{k−1}),   F_{k−1} = w_{k−1} / r_{k−1}

f is the wrench on the tool, w the wrench on the device, A the device's axes, s ``force_scale``
(divided by ``scale`` for torque). While the passivity controller acts, only the bounds of norm and
change are checked; the re-simulation checks the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.motion import (
    Array,
    Motion,
    pose_of,
    quaternion_product,
    turn_between,
    wrench_by_law,
)
from hapticbridge.audit.state import AuditState
from hapticbridge.audit.structure import TOLERANCE, Deviation, has_share, may_fade
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.record import UNITS, TickFlag, has_flag

Flags = NDArray[np.bool_]

_FORCE, _TORQUE = slice(0, 3), slice(3, 6)


def limits_on_tool(parameters: RunParameters) -> tuple[float, float]:
    """Returns force and torque on the tool at the device's limits, in N and N m."""
    return (
        parameters.force_limit / parameters.force_scale,
        parameters.torque_limit * parameters.scale / parameters.force_scale,
    )


def spring_energy(stiffness: Array, length: Array, limit: float) -> Array:
    """Returns ∫ min(K e, limit) de in J, for each K and length, (n,) each."""
    at_limit = np.divide(limit, stiffness, out=np.full_like(length, np.inf), where=stiffness > 0)
    elastic = np.minimum(length, at_limit)
    return np.asarray(0.5 * stiffness * elastic**2 + limit * (length - elastic))


@dataclass(frozen=True, slots=True)
class AuditedBlock:
    """Consecutive records with the facts that both second computations need.

    Attributes:
        ticks: The records, at least one.
        following: The next records, as many as the device's delay in ticks, or fewer at the end.
        state: State before the records.
        motion: Motion of handle and tool.
        is_first: True for the first tick after a start or a pause without force, (n,).
        is_start: True where the wrench begins to rise from zero, (n,).
        interval: Time in s since the device's last new sample, at least T between readings, (n,).
        ramp_ticks: Length of the ramp in ticks: long after a start, short after an anchoring, (n,).
        anchors: Poses of device and handle at the last anchoring, (n, 7) each.
        limited: Wrench requested of the device, limited in norm, (n, 6).
        share: r, the share of the wrench that ramp and fade transmitted, (n,).
        share_before: r of the previous tick, (n,).
    """

    ticks: NDArray[np.void]
    following: NDArray[np.void]
    state: AuditState
    motion: Motion
    is_first: Flags
    is_start: Flags
    interval: Array
    ramp_ticks: Array
    anchors: tuple[Array, Array]
    limited: Array
    share: Array
    share_before: Array

    @classmethod
    def of(
        cls,
        ticks: NDArray[np.void],
        following: NDArray[np.void],
        state: AuditState,
        events: RunEvents,
    ) -> AuditedBlock:
        """Evaluates consecutive records, at least one."""
        parameters, motion = events.parameters, Motion.of(ticks, state, events)
        is_first, is_anchored = events.is_first(ticks), has_flag(ticks, TickFlag.REANCHORED)
        lengths = np.where(is_first, parameters.ramp_ticks, parameters.guarding.fade_ticks)
        start, anchoring = _newest(is_first | is_anchored), _newest(is_anchored)
        axes = np.array(parameters.axes).reshape(3, 3)
        wrench = -parameters.force_scale * ticks["wrench_on_tool"]
        force = _shortened(wrench[:, _FORCE] @ axes, parameters.force_limit)
        torque = wrench[:, _TORQUE] / parameters.scale @ axes
        limited = np.concatenate([force, _shortened(torque, parameters.torque_limit)], axis=1)
        share = _recorded_share(ticks, limited, state.share, parameters)
        poses = pose_of(ticks, "device"), motion.tool_before
        device, handle = (
            np.where(anchoring[:, None] >= 0, pose[anchoring], before)
            for pose, before in zip(poses, state.anchors, strict=True)
        )
        return cls(
            ticks=ticks,
            following=following,
            state=state,
            motion=motion,
            is_first=is_first,
            is_start=is_first | is_anchored,
            interval=_sample_intervals(ticks, state, parameters.period),
            ramp_ticks=np.where(start >= 0, lengths[start], state.ramp_ticks),
            anchors=(device, handle),
            limited=limited,
            share=share,
            share_before=np.concatenate([[state.share], share[:-1]]),
        )

    def state_after(self, sums: dict[str, float]) -> AuditState:
        """Returns the state after the records; ``sums`` are the cumulative energies."""
        row = self.ticks[-1:]
        return replace(
            self.state,
            row=row.copy(),
            since_sample=float(self.interval[-1] * has_flag(row, TickFlag.STALE_SAMPLE)[0]),
            share=float(self.share[-1]),
            ramp_ticks=float(self.ramp_ticks[-1]),
            anchors=(self.anchors[0][-1], self.anchors[1][-1]),
            sums=sums,
        )


def _newest(is_on: Flags) -> NDArray[np.int64]:
    """Returns the newest row that is True up to each row; -1 before the first."""
    return np.maximum.accumulate(np.where(is_on, np.arange(len(is_on)), -1))


def _shortened(vector: Array, limit: Array | float) -> Array:
    """Scales vectors (n, 3) down to a largest norm."""
    norm = np.linalg.norm(vector, axis=1)
    return np.asarray(
        vector * np.where(norm > limit, limit / np.maximum(norm, 1e-300), 1.0)[:, None]
    )


def _sample_intervals(ticks: NDArray[np.void], state: AuditState, period: float) -> Array:
    read_ns = np.concatenate([state.row["read_ns"], ticks["read_ns"]])
    interval = np.maximum(np.diff(read_ns) * 1e-9, period)
    interval[0] += state.since_sample
    # added one by one, so that the sums do not depend on the blocks
    for k in (1 + np.flatnonzero(has_flag(ticks[:-1], TickFlag.STALE_SAMPLE))).tolist():
        interval[k] += interval[k - 1]
    return np.asarray(interval)


def _recorded_share(
    ticks: NDArray[np.void], limited: Array, before: float, parameters: RunParameters
) -> Array:
    """Returns the share as recorded.

    A recording of an earlier version lacks it. Then it is estimated as the ratio of sent and
    limited wrench, and kept while there is no wrench.
    """
    if has_share(ticks.dtype):
        return np.asarray(ticks["share"])
    weights = np.repeat([1 / parameters.force_limit, 1 / parameters.torque_limit], 3)
    full, sent = weights * limited, weights * ticks["wrench_on_device"]
    square = np.sum(full**2, axis=1)
    ratio = np.divide(
        np.sum(full * sent, axis=1), square, out=np.ones_like(square), where=square > 0
    )
    last = _newest(square > 0)
    return np.where(last >= 0, np.clip(ratio, 0.0, 1.0)[last], before)


def wrench_deviations(block: AuditedBlock, events: RunEvents) -> Iterator[Deviation]:
    """Yields the deviations of handle, wrench on the tool, share, wrench and injected damping."""
    ticks, parameters = block.ticks, events.parameters
    yield from _handle_deviations(block, parameters)
    if parameters.has_law and parameters.law_evaluations == 1:
        law = wrench_by_law(ticks, events.gains(ticks["tick"]), parameters.period, block.motion)
        yield Deviation.between(
            "wrench_on_tool", ticks["wrench_on_tool"], law, "N or N m", "coupling law and poses"
        )
    if has_share(ticks.dtype):
        expected, share = _ramp_share(block, events), block.share
        off = np.where(
            may_fade(ticks), np.maximum(share - expected, -share), np.abs(share - expected)
        )
        yield Deviation("share", off, TOLERANCE, "", "ramp and flags")
    yield _wrench_deviation(block, parameters)
    is_active = has_flag(ticks, TickFlag.CONTROLLER_ACTIVE)
    guarding = parameters.guarding
    for name, most in (
        ("injected_damping", guarding.max_damping),
        ("injected_rotational_damping", guarding.max_rotational_damping),
    ):
        damping, unit = ticks[name], UNITS[name]
        yield Deviation(name, np.where(is_active, 0.0, np.abs(damping)), 0.0, unit, "flags")
        beyond = np.maximum(damping - most, -damping)
        yield Deviation(name, beyond, TOLERANCE * (1 + most), unit, "the controller's limits")


def _handle_deviations(block: AuditedBlock, parameters: RunParameters) -> Iterator[Deviation]:
    """Compares the handle with the device's pose: h = h_0 + scale · A (p − p_0).

    p_0 and h_0 are the poses of device and handle at the last anchoring. During a clutch the handle
    keeps its pose.
    """
    ticks, (origin, target) = block.ticks, block.anchors
    device = pose_of(ticks, "device")
    axes = np.array(parameters.axes).reshape(3, 3)
    moved = (device[:, :3] - origin[:, :3]) @ axes.T
    # a rotation vector turns with the axes: log(A R Aᵀ) = A log(R)
    vector = turn_between(origin[:, 3:], device[:, 3:]) @ axes.T
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    turn = np.concatenate([np.cos(angle / 2), np.sinc(angle / (2 * np.pi)) / 2 * vector], axis=1)
    pose = np.concatenate(
        [target[:, :3] + parameters.scale * moved, quaternion_product(turn, target[:, 3:])], axis=1
    )
    pose = np.where(has_flag(ticks, TickFlag.CLUTCH)[:, None], block.motion.handle_before, pose)
    yield Deviation.between(
        "handle_position", ticks["handle_position"], pose[:, :3], "m", "device pose and scale"
    )
    angle = np.linalg.norm(turn_between(pose[:, 3:], ticks["handle_quaternion"]), axis=1)
    yield Deviation("handle_quaternion", angle, TOLERANCE, "rad", "device pose")


def _ramp_share(block: AuditedBlock, events: RunEvents) -> Array:
    """Returns the share after a rise of min(1, V_0/V)/(n + 1) from the previous tick's.

    V is the energy stored in the coupling at the recorded poses, V_0 ``ramp_energy``, n the ramp's
    length in ticks.
    """
    parameters, motion = events.parameters, block.motion
    pace, most = np.ones(len(block.ticks)), parameters.guarding.ramp_energy
    if parameters.has_law and np.isfinite(most):
        gains, held = events.gains(block.ticks["tick"]), np.zeros(len(pace))
        for column, limit, e in zip(
            (0, 2), limits_on_tool(parameters), (motion.stretch, motion.twist), strict=True
        ):
            held += spring_energy(gains[:, column], np.linalg.norm(e, axis=1), limit)
        held *= parameters.force_scale / parameters.scale
        np.divide(most, held, out=pace, where=held > most)
    before = np.where(block.is_start, 0.0, block.share_before)
    return np.minimum(before + pace / (block.ramp_ticks + 1.0), 1.0)


def _wrench_deviation(block: AuditedBlock, parameters: RunParameters) -> Deviation:
    """Compares the wrench on the device with the transmitted share of the limited wrench."""
    sent, has_exact_share = block.ticks["wrench_on_device"], has_share(block.ticks.dtype)
    share, share_before = block.share[:, None], block.share_before[:, None]
    before = np.concatenate([block.state.row["wrench_on_device"], sent[:-1]])
    is_rising = ~block.is_start[:, None] & (share_before > 0)
    before = np.divide(before, share_before, out=np.zeros_like(before), where=is_rising)
    expected, beyond = np.zeros_like(sent), np.full(len(sent), -np.inf)
    for part, limit, most in (
        (_FORCE, parameters.force_limit, parameters.guarding.force_slew),
        (_TORQUE, parameters.torque_limit, parameters.guarding.torque_slew),
    ):
        rise = min(most, 2 * limit)  # finite also without a slew limit
        change = _shortened(block.limited[:, part] - before[:, part], rise)
        expected[:, part] = share * (before[:, part] + change)
        norm_limit = block.share * limit if has_exact_share else limit
        excess = np.linalg.norm(sent[:, part], axis=1) - norm_limit
        if has_exact_share:
            change = np.linalg.norm(sent[:, part] - share * before[:, part], axis=1)
            excess = np.maximum(excess, change - block.share * rise)
        beyond = np.maximum(beyond, excess)
    deviation = Deviation.between(
        "wrench_on_device", sent, expected, "N or N m", "wrench on the tool and limits"
    )
    is_bounded_only = has_flag(block.ticks, TickFlag.CONTROLLER_ACTIVE) | (not has_exact_share)
    return deviation._replace(amount=np.where(is_bounded_only, beyond, deviation.amount))
