"""Z-width: the stiffness and damping that a device can render, and its limits.

B is the damping of the coupling's law. For a method that adds damping by integration it is B', and
the effective damping is ``effective_damping``; the printed sentences use B'.

A free device, without a hand, must be stable against a wall behind the coupling. In units of the
period and of the device's mass, x = b T/m, κ = K T²/m, β = B T/m, ν = τ/T, with d samples of delay,
an exact zero-order hold gives the closed loop

    p(z) = (z − 1)(z − e^{−x}) z^d F(z) + [φ₂ (z − e^{−x}) + φ₁²] [κ F(z) + β (z − 1)]
    F(z) = (1 + ν) z − ν,    φ₁ = (1 − e^{−x})/x,    φ₂ = (1 − φ₁)/x

The loop is stable if all roots of p lie inside the unit circle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.theory.bounds import (
    DAMPING_SHARE,
    NEEDED_SHARE,
    STIFFNESS_MARGIN,
    minimum_damping,
    stiffest_late_coupling,
)
from hapticbridge.theory.transfer import (
    CouplingGrid,
    checked,
    delayed_by,
    plain,
    scalar,
    single,
    together,
    whole,
)

# Stiffness limits from position resolution and Coulomb friction

Region = Literal["passive", "locally stable", "bounded limit cycle", "unstable"]
"""Regions of (β, σ) after Diolaiti et al. 2006."""


@dataclass(frozen=True, slots=True)
class QuantizationLimit:
    """Limits of a coupling on a device that quantises its position.

    Attributes:
        stiffness: Largest K in N/m that damping and friction both allow; 0 if the damper alone
            exceeds them. Always finite, because the damping bounds it.
        limited_by: The line that limits it: ``damping`` or ``friction``.
        beta: β = b / (K T), without unit.
        sigma: σ = f_c / (K Δ), without unit; inf for Δ = 0.
        region: ``passive`` (β and σ above ½), ``locally stable`` (only σ), ``bounded limit cycle``
            (only β), ``unstable`` (neither). Defined for a coupling without damper.
        friction_needed: K Δ/2 + B Δ/T in N.
    """

    stiffness: float
    limited_by: Literal["damping", "friction"]
    beta: float
    sigma: float
    region: Region
    friction_needed: float


def quantization_limit(
    damping: float, friction: float, resolution: float, coupling: Coupling, period: float
) -> QuantizationLimit:
    """Returns the stiffness that friction and resolution allow, and the region of a coupling.

        K <= min( 2(b − B)/T,  2(f_c/Δ − B/T) ),      f_c >= K Δ/2 + B Δ/T

    Friction sets a line of its own, because motion over one quantum may be arbitrarily slow.

    Args:
        damping: Damping b of one axis of the device in N s/m, >= 0.
        friction: Its Coulomb friction f_c in N, >= 0.
        resolution: Its position quantum Δ in m, >= 0.
        coupling: K and B in translation.
        period: T in s, finite and > 0.

    Raises:
        CouplingError: A value is not finite or out of range.

    References:
        Abbott & Okamura 2005 (friction and damping bounds); Diolaiti et al. 2006 (regions).
    """
    period = scalar("period", period, "s", positive=True)
    b = scalar("device damping", damping, "N s/m")
    friction = scalar("device friction", friction, "N")
    quantum = scalar("device resolution", resolution, "m")
    k, law_damping = single(coupling)
    by_damping = 2 * (b - law_damping) / period
    by_friction = 2 * (friction / quantum - law_damping / period) if quantum else float("inf")
    beta = b / (k * period)
    sigma = friction / (k * quantum) if quantum else float("inf")
    region: Region
    if beta > 0.5:
        region = "passive" if sigma > 0.5 else "bounded limit cycle"
    else:
        region = "locally stable" if sigma > 0.5 else "unstable"
    return QuantizationLimit(
        stiffness=max(0.0, min(by_damping, by_friction)),
        limited_by="damping" if by_damping <= by_friction else "friction",
        beta=beta,
        sigma=sigma,
        region=region,
        friction_needed=k * quantum / 2 + law_damping * quantum / period,
    )


FIRST_SHARE = 1e-6
"""Start of the search, without unit, as a share of (b + B)/T in stiffness or of b + m/T in damping.
A limit below it is returned as 0; no real device is that soft. A smaller value takes longer."""

SMALL = 1e-2
"""Value of b T/m, without unit, below which φ₂ is summed as a series. Five terms leave an error of
1e-14 there. Below it the closed form loses as many digits to cancellation."""

BISECTIONS = 27
"""Number of halvings of an octave: 2^-27 = 7e-9. This is a hundredth of the accuracy of the
boundary, 1e-6, which double roots near 1 limit. More halvings only take longer."""

OCTAVES = 200
"""Number of doublings after which the search ends. The end, 2^200 times the start, lies beyond
every limit."""


def _plant(x: _Array) -> tuple[_Array, _Array, _Array]:
    """Returns e^{−x}, φ₁ and φ₂ of a damped mass under an exact zero-order hold."""
    safe = np.where(x > 0, x, 1.0)
    first = np.where(x > 0, -np.expm1(-safe) / safe, 1.0)
    series = 1 / 2 - x / 6 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6)))
    return np.exp(-x), first, np.where(x < SMALL, series, (1 - first) / safe)


def _product(first: list[_Array], second: list[_Array]) -> list[_Array]:
    """Multiplies polynomials whose coefficient arrays start with the highest power."""
    result = [np.zeros_like(first[0]) for _ in range(len(first) + len(second) - 1)]
    for i, left in enumerate(first):
        for j, right in enumerate(second):
            result[i + j] = result[i + j] + left * right
    return result


def _is_stable(coefficients: list[_Array]) -> NDArray[np.bool_]:
    degree = len(coefficients) - 1
    companion = np.zeros((*coefficients[0].shape, degree, degree))
    companion[..., range(1, degree), range(degree - 1)] = 1
    companion[..., 0, :] = -np.stack(coefficients[1:], -1) / coefficients[0][..., None]
    stable: NDArray[np.bool_] = np.abs(np.linalg.eigvals(companion)).max(axis=-1) < 1
    return stable


def _first_unstable(stable_at: Callable[[_Array], NDArray[np.bool_]], start: _Array) -> _Array:
    """Returns the end of the stable range from the start value on; 0 if the start is unstable."""
    low, high = np.zeros_like(start), start
    growing = stable_at(start)
    for _ in range(OCTAVES):
        if not growing.any():
            break
        low = np.where(growing, high, low)
        high = np.where(growing, 2 * high, high)
        growing = growing & stable_at(high)
    found = low > 0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        stable = stable_at(middle) & found
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return np.where(found, low, 0.0)


def _loop(
    device_damping: _Array, mass: _Array, damping: _Array, period: float, delay: int, lag: float
) -> Callable[[_Array], list[_Array]]:
    """Returns p(z) as a function of κ; for κ = 0 its trivial root z = 1 is divided out."""
    x, beta = device_damping * period / mass, damping * period / mass
    decay, first, second = _plant(x)
    one, zero = np.ones_like(x), np.zeros_like(x)
    filtering = [(1 + lag) * one, -lag * one]
    plant = [second, first**2 - second * decay]
    still = [*_product([one, -decay], filtering), *[zero] * delay]
    with_damper = _sum(still, [beta * value for value in plant])
    spring = _product(plant, filtering)
    moving = _product([one, -one], with_damper)

    def polynomial(kappa: _Array) -> list[_Array]:
        if not kappa.any():
            return with_damper
        return _sum(moving, [kappa * value for value in spring])

    return polynomial


def _sum(long: list[_Array], short: list[_Array]) -> list[_Array]:
    """Adds two polynomials; the second has the lower degree."""
    head = len(long) - len(short)
    return [*long[:head], *(a + b for a, b in zip(long[head:], short, strict=True))]


def free_device_stiffness(
    device_damping: ArrayLike,
    period: float,
    mass: ArrayLike,
    damping: ArrayLike = 0.0,
    *,
    delay: int = 0,
    filter_time: float = 0.0,
) -> float | NDArray[np.float64]:
    """Returns the stiffness up to which a free device is stable against a wall.

    The device is a mass with viscous damping, m_d v' = −b v − f, without a hand. The coupling's
    force f is held for a period (exact zero-order hold). The tool does not move. Friction and
    quantisation are left out.

    This is a *stability* limit of one loop. A hand that stores energy can lower it down to
    ``maximum_stiffness``; a little damping of the hand raises it. The coupling's damper raises it
    until B reaches about m_d/T.

    The boundary is exact to 1e-6 for b T/m_d > 1e-6. The roots of a heavier device lie so near to 1
    that double precision no longer resolves its damping.

    Args:
        device_damping: b in N s/m, finite and >= 0.
        period: T in s, finite and > 0.
        mass: m_d in kg, finite and > 0.
        damping: B in N s/m, finite and >= 0.
        delay: d, whole samples from position to force, 0 to 50.
        filter_time: τ in s, >= 0, of a first-order low-pass behind the damper (backward).

    Returns:
        K in N/m, of the broadcast shape of the arguments. Every smaller stiffness is stable too. 0
        if none is stable, as for b = B = 0.

    Raises:
        CouplingError: An argument is out of range or mis-shaped.

    References:
        Gil, Avello, Rubio, Flórez 2004, Stability analysis of a 1 DOF haptic interface using the
        Routh-Hurwitz criterion (this loop without a low-pass).
    """
    period = scalar("period", period, "s", positive=True)
    lag = scalar("filter time", filter_time, "s") / period
    b, masses, dampings = together(
        device_damping=checked("device damping", device_damping, "N s/m"),
        mass=checked("mass", mass, "kg", positive=True),
        coupling_damping=checked("coupling damping", damping, "N s/m"),
    )
    polynomial = _loop(b, masses, dampings, period, delayed_by(delay), lag)
    available = (b + dampings) * period / masses
    start = FIRST_SHARE * np.where(available > 0, available, 1.0)
    kappa = _first_unstable(lambda value: _is_stable(polynomial(value)), start)
    stiffness = np.where(available > 0, kappa, 0.0) * masses / period**2
    return plain(np.asarray(stiffness))


def free_device_damping(
    device_damping: ArrayLike,
    period: float,
    mass: ArrayLike,
    *,
    delay: int = 0,
    filter_time: float = 0.0,
) -> float | NDArray[np.float64]:
    """Returns the coupling damping at which ``free_device_stiffness`` falls to 0, the limit K → 0.

    Arguments, errors and source as for ``free_device_stiffness``.

    Returns:
        B in N s/m, of the broadcast shape of the arguments.
    """
    period = scalar("period", period, "s", positive=True)
    lag = scalar("filter time", filter_time, "s") / period
    samples = delayed_by(delay)
    b, masses = together(
        device_damping=checked("device damping", device_damping, "N s/m"),
        mass=checked("mass", mass, "kg", positive=True),
    )
    zero = np.zeros_like(b)

    def stable_at(beta: _Array) -> NDArray[np.bool_]:
        loop = _loop(b, masses, beta * masses / period, period, samples, lag)
        return _is_stable(loop(zero))

    beta = _first_unstable(stable_at, FIRST_SHARE * (1 + b * period / masses))
    return plain(np.asarray(beta * masses / period))


# Line of passivity in the plane of K and B

SECANTS, SETTLED = 60, 1e-13
"""Largest number of secant steps towards the line of a late device, and relative step in K at which
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
        delay: d in samples.
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
        """Returns the largest K in N/m for any hand and in every scene."""
        if self.delay == 0:
            return np.maximum(0.0, 2 * (self.b - self.share * damping) / self.period)
        # The requirement is convex in K, so secants from above never cross the line. They start
        # where ω → 0 alone requires b: (d + 1)² K² T/2 = b (K + 2B/T).
        soft, burden = SOFT * self.b / self.period, (self.delay + 1) ** 2
        root = np.sqrt(self.b + 4 * burden * damping) * np.sqrt(self.b)
        before, last = ((self.b + root) / (self.period * burden) * x for x in (1.1, 1.0))
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
        laws, late, low_pass = CouplingGrid(stiffness, damping), self.delay, self.filter_time
        return np.asarray(minimum_damping(laws, self.period, delay=late, filter_time=low_pass))


_Array = NDArray[np.float64]

ANY_HAND = "passive for any hand"
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
            at K → 0, K is 80 % of the limit at that B. With a delay it is that of
            ``bounds.stiffest_late_coupling``.
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

        passive for any hand     ``minimum_damping`` = b;  d = 0: K = 2(b − B T/(T + 2τ))/T
        free of limit cycles     K = 2(f_c/Δ − B/T)              Δ > 0
        stable without a hand    ``free_device_stiffness``       m_d known

    The first line is necessary, and sufficient for any passive hand and any environment that is
    discrete-time passive. With a delay the recommended coupling needs 85 % of b; it is not that of
    a low-pass.

    The friction line holds for a loop without delay and low-pass; a low-pass makes the damper's
    jumps smaller. It is required only if f_c T/Δ reaches ``MIN_FRICTION_SHARE`` of b. Otherwise a
    note announces limit cycles, which stay bounded while β = b/(K T) > ½, that is below the first
    line.

    A coupling that is passive for any hand is stable without one, so the last line lies above the
    first one. If rounding puts the line of a very heavy device below it, the first line is
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
        Brown & Colgate 1997, eq. (6); Abbott & Okamura 2005 (friction); Diolaiti et al. 2006 (limit
        cycles); Colgate & Brown 1994 (Z-width).
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
    corner = STIFFNESS_MARGIN * float(limit[-1]), float(damping[-1])
    limited_by = required[least[-1]].name
    if delay and not loop.filter_time:
        stiff, damped = stiffest_late_coupling(loop.b, loop.period, delay * loop.period, 1)
        needed = 0.5 * stiff * loop.period + damped  # of f_c T/Δ
        share = min(NEEDED_SHARE * allowed / needed, 1.0) if allowed and is_kept else 1.0
        corner = share * stiff, share * damped
        limited_by = ANY_HAND if share == 1.0 else NO_LIMIT_CYCLES
    return ZWidth(
        damping=grid,
        lines=tuple(replace(line, stiffness=line.stiffness[:-1]) for line in lines),
        limit=limit[:-1],
        limited_by=tuple(required[index].name for index in least[:-1]),
        corner=Coupling(*corner, 0.0, 0.0),
        corner_limited_by=limited_by,
        notes=(of_friction,) if of_friction else (),
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
    if loop.delay:
        reason = "behind the delay, at the worst frequency"
    return LimitLine(ANY_HAND, reason, loop.stiffness(damping), largest, is_required=True)


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
