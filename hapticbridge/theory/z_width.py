"""Z-width: the stiffness and damping that a device can render, and its limits.

B is the damping of the coupling's law. For a method that adds damping by integration it is B', and
the effective damping is ``effective_damping``; the printed sentences use B'.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.theory.bounds import DAMPING_SHARE, STIFFNESS_MARGIN
from hapticbridge.theory.device_limits import free_device_damping, free_device_stiffness
from hapticbridge.theory.spectrum import wall_supremum
from hapticbridge.theory.transfer import delayed_by, scalar, whole

# Line of passivity in the plane of K and B

SECANTS, SETTLED = 60, 1e-13
"""Largest number of secant steps towards the line against a wall, and relative step in K at which
they end. About ten steps are taken. The step equals the resolution of the bound. Both without
unit."""

SOFT = 1e-12
"""Stiffness, as a share of B/T or b/T, that stands for K → 0, without unit."""


@dataclass(frozen=True, slots=True)
class PassiveLine:
    """Largest passive stiffness of a device as a function of the coupling's damping.

    Attributes:
        b: Device damping in N s/m, > 0.
        period: T in s, > 0.
        delay: d in samples; for d >= 1 the line is that against a wall.
        filter_time: τ in s, >= 0.
    """

    b: float
    period: float
    delay: int
    filter_time: float

    @property
    def share(self) -> float:
        """Share of B in the device condition without a delay: T/(T + 2τ)."""
        return self.period / (self.period + 2 * self.filter_time)

    def stiffness(self, damping: _Array) -> _Array:
        """Returns the largest K in N/m for any hand; with a delay, against a wall."""
        if self.delay == 0:
            return np.maximum(0.0, 2 * (self.b - self.share * damping) / self.period)
        # The damping that a wall requires is convex in K, so secants from above never cross the
        # line. They start above it, because at ω → 0 a wall already requires (d + ½) K T − B.
        soft = SOFT * self.b / self.period
        before, last = ((self.b + damping) / (self.period * self.delay) * x for x in (1.1, 1.0))
        needed_before = self._needed(before, damping)
        for _ in range(SECANTS):
            needed = self._needed(last, damping)
            rise, step = needed_before - needed, before - last
            following = last - (needed - self.b) * step / np.where(rise > 0, rise, np.inf)
            before, needed_before = last, needed
            last = np.clip(following, soft, last)
            if (before - last <= SETTLED * before).all():
                break
        return np.where(last > 2 * soft, last, 0.0)

    def largest_damping(self) -> float:
        """Returns the B in N s/m at which ``stiffness`` falls to 0."""
        if self.delay == 0:
            return self.b / self.share
        return float(self.b / self._needed(np.full(1, SOFT / self.period), np.ones(1))[0])

    def _needed(self, stiffness: _Array, damping: _Array) -> _Array:
        return wall_supremum(
            stiffness, damping, self.period, "backward", self.delay, self.filter_time
        )[0]


_Array = NDArray[np.float64]

ANY_HAND = "passive for any hand"
WALL = "passive against a wall"
NO_LIMIT_CYCLES = "free of limit cycles"
WITHOUT_HAND = "stable without a hand"

MIN_FRICTION_SHARE = 0.1
"""Smallest f_c T/Δ, as a share of the device's damping b, at which friction counts as a limit,
without unit. Below it a coupling free of limit cycles would be softer than a tenth of the passive
one, so the result reports limit cycles instead. A larger value reports them earlier. Our choice."""

MAX_POINTS = 100_000
"""Largest number of values of B: far more than the pixels of a plot."""

MARGIN_OF_RANGE = 1.25
"""Range of B divided by the largest passive B, without unit. A larger value shows more of the
region that is not passive."""

_CYCLES = "limit cycles, which stay bounded as long as K < 2b/T"
_DELAYED = "with a delay the bound is that of a wall; no general bound exists, so watch the meter"


@dataclass(frozen=True, slots=True, eq=False)
class LimitLine:
    """A limit in the plane of K and B; below the line the named property holds.

    Attributes:
        name: Property that holds below the line.
        reason: The condition, in one line.
        stiffness: Largest K in N/m at each B of the result, >= 0.
        largest_damping: B in N s/m at which K falls to 0.
        is_required: True if the line bounds the usable region; otherwise it is shown for
            information.
    """

    name: str
    reason: str
    stiffness: _Array
    largest_damping: float
    is_required: bool


@dataclass(frozen=True, slots=True, eq=False)
class ZWidth:
    """Region of couplings that a device can render: 0 < K < limit(B).

    Attributes:
        damping: B in N s/m, ascending from 0, shape (n,).
        lines: All lines, each of the shape of ``damping``.
        limit: Smallest K in N/m over the required lines, shape (n,).
        limited_by: Name of that line at each B.
        corner: Recommended coupling in translation (rotational part 0). B is a quarter of the limit
            at K → 0, K is 80 % of the limit at that B.
        corner_limited_by: Name of the line above the corner.
        notes: Sentences about effects that the lines do not cover.
        device_damping: b in N s/m.
        period: T in s.
        delay: d in samples.
        filter_time: τ in s.
        mass: m_d in kg; None if unknown.
        friction: f_c in N; None if unknown.
        resolution: Δ in m.
    """

    damping: _Array
    lines: tuple[LimitLine, ...]
    limit: _Array
    limited_by: tuple[str, ...]
    corner: Coupling
    corner_limited_by: str
    notes: tuple[str, ...]
    device_damping: float
    period: float
    delay: int
    filter_time: float
    mass: float | None
    friction: float | None
    resolution: float


def z_width(
    device_damping: float,
    period: float,
    *,
    mass: float | None = None,
    friction: float | None = None,
    resolution: float = 0.0,
    delay: int = 0,
    filter_time: float = 0.0,
    points: int = 101,
) -> ZWidth:
    """Returns the couplings (K, B) that a device can render, and a recommended one.

        passive for any hand     K = 2(b − B T/(T + 2τ))/T              d = 0
        passive against a wall   minimum_damping(K, B, delay=d) = b     d >= 1
        free of limit cycles     K = 2(f_c/Δ − B/T)                     Δ > 0
        stable without a hand    ``free_device_stiffness``              m_d known

    Without a delay the first line is sufficient for any passive hand and any environment that is
    discrete-time passive. **With a delay no bound holds for a general environment**: the line
    against a wall is necessary but not sufficient, and the energy meter must decide.

    The friction line holds for a loop without delay and low-pass; a low-pass makes the damper's
    jumps smaller. It is required only if f_c T/Δ reaches ``MIN_FRICTION_SHARE`` of b. Otherwise a
    note announces limit cycles, which stay bounded while β = b/(K T) > ½, that is below the first
    line.

    A coupling that is passive against a wall is stable without a hand, so the last line lies above
    the first one. If rounding puts the line of a very heavy device below it, the first line is
    used.

    Args:
        device_damping: b in N s/m, finite and > 0.
        period: T in s, finite and > 0.
        mass: m_d in kg, finite and > 0; None omits its line.
        friction: f_c in N, finite and >= 0; None: unknown.
        resolution: Δ in m, finite and >= 0; 0: positions are exact.
        delay: d, whole samples from position to force, 0 to 50.
        filter_time: τ in s, >= 0, of a first-order low-pass behind the damper.
        points: Number of values of B, >= 2.

    Raises:
        CouplingError: An argument is out of range.

    References:
        Brown & Colgate 1997, eq. (6); Colgate & Schenkel 1997 (wall); Abbott & Okamura 2005
        (friction); Diolaiti et al. 2006 (limit cycles); Colgate & Brown 1994 (Z-width).
    """
    loop = PassiveLine(
        scalar("device damping", device_damping, "N s/m", positive=True),
        scalar("period", period, "s", positive=True),
        delayed_by(delay),
        scalar("filter time", filter_time, "s"),
    )
    count = whole("points", points, least=2, most=MAX_POINTS)
    quantum = scalar("resolution", resolution, "m")
    allowed, of_friction = _friction(friction, quantum, loop)
    passive_damping = loop.largest_damping()
    is_kept = (allowed or 0.0) >= MIN_FRICTION_SHARE * loop.b
    available = min(passive_damping, allowed) if allowed and is_kept else passive_damping
    grid = np.linspace(0.0, MARGIN_OF_RANGE * passive_damping, count)
    # the last element of the arrays is the corner's B
    damping = np.append(grid, DAMPING_SHARE * available)

    lines = [_passive_line(loop, damping, passive_damping)]
    if allowed is not None:
        stiffness = np.maximum(0.0, 2 * (allowed - damping) / loop.period)
        because = "f_c >= K Δ/2 + B_law Δ/T"
        lines.append(LimitLine(NO_LIMIT_CYCLES, because, stiffness, allowed, is_kept))
    if mass is not None:
        heft = scalar("mass", mass, "kg", positive=True)
        lines.append(_free_line(loop, heft, damping, lines[0]))
    # if several lines are 0, the one that reached 0 at the smallest B is the limit
    required = [line for line in lines if line.is_required]
    required.sort(key=lambda line: line.largest_damping)
    rows = np.stack([line.stiffness for line in required])
    least, limit = rows.argmin(axis=0), rows.min(axis=0)
    return ZWidth(
        damping=grid,
        lines=tuple(replace(line, stiffness=line.stiffness[:-1]) for line in lines),
        limit=limit[:-1],
        limited_by=tuple(required[index].name for index in least[:-1]),
        corner=Coupling(STIFFNESS_MARGIN * float(limit[-1]), float(damping[-1]), 0.0, 0.0),
        corner_limited_by=required[least[-1]].name,
        notes=tuple(note for note in (_DELAYED if delay else "", of_friction) if note),
        device_damping=loop.b,
        period=period,
        delay=delay,
        filter_time=filter_time,
        mass=mass,
        friction=friction,
        resolution=quantum,
    )


def _passive_line(loop: PassiveLine, damping: _Array, largest: float) -> LimitLine:
    reason = "b > K T/2 + B_law T/(T + 2τ)" if loop.filter_time else "b > K T/2 + B_law"
    name = ANY_HAND
    if loop.delay:
        name, reason = WALL, "at the worst frequency"
    return LimitLine(name, reason, loop.stiffness(damping), largest, is_required=True)


def _free_line(loop: PassiveLine, mass: float, damping: _Array, passive: LimitLine) -> LimitLine:
    b, period, late, tau = loop.b, loop.period, loop.delay, loop.filter_time
    stiffness = free_device_stiffness(b, period, mass, damping, delay=late, filter_time=tau)
    largest = free_device_damping(b, period, mass, delay=late, filter_time=tau)
    # the roots of a heavy device lie so near to 1 that rounding hides its damping
    stiffness = np.maximum(stiffness, passive.stiffness)
    largest = max(float(largest), passive.largest_damping)
    reason = f"{mass:g} kg let go against a wall"
    return LimitLine(WITHOUT_HAND, reason, stiffness, largest, is_required=True)


def _friction(
    friction: float | None, quantum: float, loop: PassiveLine
) -> tuple[float | None, str]:
    """Returns f_c T/Δ, the largest B that friction allows (None: no such line), and a note."""
    known = None if friction is None else scalar("friction", friction, "N")
    if quantum == 0:
        return None, ""
    if known is None:
        return None, f"the friction is not known: the position's steps may cause {_CYCLES}"
    allowed = known * loop.period / quantum
    if allowed < MIN_FRICTION_SHARE * loop.b:
        steps = f"steps of {quantum:g} m"
        return allowed, f"friction of {known:g} N is too low for {steps}: expect {_CYCLES}"
    return allowed, "the friction line is that of a loop without delay" if loop.delay else ""
