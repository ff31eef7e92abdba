"""Haptic loop as the theory sees it: device, coupling law, period, scales and their demand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import UNITS, Axis, Coupling
from hapticbridge.demand.methods import IMPLICIT, Method
from hapticbridge.device.base import DeviceInfo
from hapticbridge.errors import CouplingError
from hapticbridge.kernel.ledger import SLACK_SHARE
from hapticbridge.kernel.parameters import ROUNDING, RunParameters, checked_substeps, whole_ticks
from hapticbridge.theory.bounds import minimum_damping
from hapticbridge.theory.transfer import CouplingGrid, delayed_by

# Time in which a device answers


def device_period(info: DeviceInfo, period: float) -> float:
    """Returns the time in s between two samples: the loop's period, or the device's if longer.

    For a prescribed motion it is the loop's period.
    """
    if info.rate is None or info.is_prescribed:
        return period
    own = 1.0 / info.rate
    return own if own > period * (1.0 + ROUNDING) else period


def fresh_share(info: DeviceInfo, period: float, fresh: int, due: int) -> float:
    """Returns the share of the device's samples due that were new, 0 to 1.

    Args:
        info: The device; with a rate of its own it owes fewer samples than there are deadlines.
        period: T in s.
        fresh: Number of ticks with a new sample.
        due: Number of deadlines.
    """
    owed = due * (period / device_period(info, period))
    return min(fresh / owed, 1.0) if owed else 1.0


def delay_ticks(info: DeviceInfo, period: float) -> int | None:
    """Returns the whole ticks from a sample to the resulting wrench; None if unknown."""
    return None if info.delay is None else whole_ticks(info.delay, period)


@dataclass(frozen=True, slots=True)
class Lag:
    """Time in which a device answers, as its condition counts it.

    Attributes:
        ticks_per_sample: n, ticks of the loop for which one force is held; at least 1.
        delay: t_d in s from a sample to its force, >= 0, in whole ticks of the loop, rounded up,
            because a reply is read, and the next request sent, in a tick. An unknown delay counts
            as 0.
    """

    ticks_per_sample: int = 1
    delay: float = 0.0

    @classmethod
    def of(cls, info: DeviceInfo, period: float) -> Lag:
        """Returns that of a device on a loop of period T in s."""
        delay = (delay_ticks(info, period) or 0) * period
        if info.loop_period == period:  # it reads no reply in a tick, so its delay is not rounded
            delay = info.loop_delay
        return cls(whole_ticks(device_period(info, period), period), delay)


IN_TIME = Lag()
"""A device that gives a sample in each tick and answers it at once."""


UNCONFIRMED = 1e-3
"""Time in s by which a delay may exceed what a device states: one message of USB, or a tick of the
usual rate. A larger value makes the couplings of unmeasured devices softer."""


def assumed_lag(info: DeviceInfo, period: float) -> Lag:
    """Returns the lag for which a coupling is chosen, with T in s.

    A delay that no measurement confirms counts as one tick more, at most ``UNCONFIRMED``, and one
    that the device does not state as this tick: links and services take a time that no data sheet
    has.
    """
    lag = Lag.of(info, period)
    is_confirmed = info.is_delay_measured and info.delay is not None
    if is_confirmed or info.is_prescribed:
        return lag
    return replace(lag, delay=lag.delay + min(period, UNCONFIRMED))


def pulling_loop(info: DeviceInfo, period: float) -> tuple[DeviceInfo, float]:
    """Returns the device as the loop that pulls at it sees it, and the period of that loop in s.

    That is the bridge's loop of ``period`` s, or one of the device's own, which reads the position
    itself: the link does not delay it.
    """
    if info.loop_period is None:
        return info, period
    own = replace(info, rate=None, delay=info.loop_delay, is_delay_measured=True)
    return own, info.loop_period


# Device damping required by a coupling

LOWEST_FREQUENCY, FREQUENCIES = 3e-3, 60
"""Lowest frequency in rad per sample, and number of frequencies per ripple, of the search for the
damping that substeps need. Without a delay the maximum lies at one end in all cases tried: at
Nyquist, or at the limit towards rest, which 3e-3 approximates to 1e-5."""


@cache
def required_damping(
    coupling: Coupling,
    period: float,
    law_evaluations: int = 1,
    axis: Axis = "translation",
    lag: Lag = IN_TIME,
) -> float:
    """Returns the damping b that a device needs behind a coupling, in N s/m or N m s/rad.

    K and B are those of the law (``Method.law_coupling``), not the effective ones. With one
    evaluation of the law per tick b = K T/2 + B, and more behind a device that is late
    (``theory.bounds.minimum_damping``). With m evaluations of the law per tick the handle
    moves by an m-th of its step for each, and the mean wrench is sent. There is no closed form; b
    is the smallest value for which

        Σ_k f̄_{k−d}·δh_{k+1} + (b/nT) ‖δh_k‖² − Σ_i f_i·δx_i − ½ s (K + mB/T) ‖δx_i‖² >= 0,
        f_i = K e_i + (mB/T) δe_i,   e = h − x

    for every motion, with k over samples and i over evaluations; d is the delay in whole sample
    periods, rounded up. The share s = ``SLACK_SHARE`` = ½ of the slack may be used; with one
    evaluation it is the whole slack. The search finds b frequency by frequency as the smallest
    value of a quadratic form over the n m deflections e_i. For B = 0, b grows with m (for strict
    environments it is K T m/2, because the mean comes late); for B > K T it falls towards B.

    The form is sufficient for any environment within its share of the slack; strict environments
    need less. Example: default coupling (K = 2400 N/m, B = 0.5 N s/m, 1 kHz) at m = 2, 4, 8. The
    form gives 1.63, 1.90, 2.42 N s/m; a wall needs 1.30, 1.60, 1.75; the worst free tool of 1 to
    0.01 kg needs 1.29, 1.65, 2.03.

    Args:
        coupling: K and B of the law.
        period: T of the loop in s.
        law_evaluations: m, 1 to ``MAX_SUBSTEPS``.
        axis: Kind of axis.
        lag: n and the delay of the device.

    Raises:
        CouplingError: m or the period is out of range, or the delay is more than 50 n T.

    References:
        Brown & Colgate 1997, eq. (6), for m = 1 and a device in time.
    """
    is_linear = axis == "translation"
    k = coupling.stiffness if is_linear else coupling.rotational_stiffness
    damping = coupling.damping if is_linear else coupling.rotational_damping
    if checked_substeps(law_evaluations, CouplingError) == 1:
        if k == 0.0:
            return lag.ticks_per_sample * damping
        law, ticks = CouplingGrid(k, damping), lag.delay / period
        n = lag.ticks_per_sample
        return float(minimum_damping(law, period, delay=ticks, ticks_per_sample=n))
    count, held = law_evaluations * lag.ticks_per_sample, lag.ticks_per_sample * period
    b = damping * law_evaluations / period
    if k == 0.0:
        return float(b * held / law_evaluations)
    delay = delayed_by(whole_ticks(lag.delay, held))
    slack = 0.5 * SLACK_SHARE * (k + b)
    most = 0.0
    for theta in _frequencies(delay):
        # the form is diagonal in deflections that turn by one of these angles per evaluation
        angles = (theta + 2.0 * np.pi * np.arange(count)) / count
        backward = -np.expm1(1j * angles)  # conjugate of δe_i / e_i
        form = (0.5 * k + b - slack) * np.abs(backward) ** 2
        ahead = np.expm1(1j * theta * (delay + 1))
        mean = np.sin(0.5 * law_evaluations * angles) / np.sin(0.5 * angles) / law_evaluations
        linear = (0.5 * ahead * (k + b * backward) + slack * backward) * mean
        most = max(most, float(np.mean(np.abs(linear) ** 2 / form)))
    return (most + slack / law_evaluations) * held


def _frequencies(delay: int) -> NDArray[np.float64]:
    """Returns the frequencies in rad per sample at which substeps may need most."""
    if delay == 0:
        return np.geomspace(LOWEST_FREQUENCY, np.pi, FREQUENCIES)
    return np.linspace(LOWEST_FREQUENCY, np.pi, FREQUENCIES * (delay + 1))


# The loop


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSetting:
    """Device, coupling law, period and scales: all that the device condition depends on.

    For the device, the coupling is scale · force_scale times as stiff in translation. Angles are
    not scaled, so the factor for rotation is force_scale / scale.

    Attributes:
        info: The device.
        law: K and B' of the law, not the effective coupling.
        period: T in s.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.
        law_evaluations: Evaluations of the law per tick (substeps).
        method: Rendering method, which makes the law of the requested coupling.
        timestep: MuJoCo's h in s; None for ``period`` / ``law_evaluations``.
    """

    info: DeviceInfo
    law: Coupling
    period: float
    scale: float = 1.0
    force_scale: float = 1.0
    law_evaluations: int = 1
    method: Method = IMPLICIT
    timestep: float | None = None

    @classmethod
    def of_run(cls, info: DeviceInfo, run: RunParameters, method: Method) -> LoopSetting:
        """Returns the loop of a run; a weld counts by its measured stiffness and damping."""
        own, period = pulling_loop(info, run.period)
        has_own = info.loop_period is not None
        return cls(
            info=own,
            law=run.effective or run.coupling,
            period=period,
            scale=run.scale,
            force_scale=run.force_scale,
            law_evaluations=1 if has_own else run.law_evaluations,
            method=method,
            timestep=run.timestep,
        )

    @property
    def h(self) -> float:
        """MuJoCo's time step in s."""
        return self.timestep or self.period / self.law_evaluations

    @property
    def lag(self) -> Lag:
        """Time in which the device answers."""
        return Lag.of(self.info, self.period)

    @property
    def is_judged(self) -> bool:
        """True if the device has a condition: its damping along what it moves is known."""
        return self.info.damping is not None or not self.info.moves

    def ratio(self, axis: Axis) -> float:
        """Returns the ratio of the coupling at the device to that in the scene."""
        is_linear = axis == "translation"
        return self.scale * self.force_scale if is_linear else self.force_scale / self.scale

    def needed(self, axis: Axis, lag: Lag | None = None) -> float:
        """Returns the damping that the device needs in N s/m or N m s/rad; None takes its lag."""
        lag = self.lag if lag is None else lag
        needed = required_damping(self.law, self.period, self.law_evaluations, axis, lag)
        return self.ratio(axis) * needed

    def needs(self) -> tuple[float, float]:
        """Returns the damping in N s/m and N m s/rad of both kinds; 0 without a condition."""
        if not self.method.has_coupling or not self.is_judged:
            return 0.0, 0.0
        return (
            self.needed("translation") if self.info.moves else 0.0,
            self.needed("rotation") if self.info.turns else 0.0,
        )

    def requested(self, law: Coupling) -> Coupling:
        """Returns the requested coupling of which the method makes a law."""
        return self.method.requested_coupling(law, self.h)

    def is_hidden(self, axis: Axis) -> bool:
        """Returns True if the method took all requested damping, of any value, off the law."""
        return self.method.compensated_share > 0.0 and self.law.gains(axis)[1] == 0.0

    @property
    def least_requested(self) -> Coupling:
        """Smallest requested coupling of this law; hidden damping counts as 0."""
        requested = self.requested(self.law)
        for axis in UNITS:
            if self.is_hidden(axis):
                requested = requested.with_axis(axis, requested.gains(axis)[0], 0.0)
        return requested

    def requesting(self, requested: Coupling, faster: float = 1.0) -> LoopSetting:
        """Returns the loop with another requested coupling, and its period times a factor."""
        step = self.h * faster
        law = self.method.law_coupling(requested, step)
        return replace(self, law=law, period=faster * self.period, timestep=step)
