"""Plots of the theory: couplings that a device can show, and their required damping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import (
    Method,
    RunCoupling,
    default_method,
    guaranteed_methods,
)
from hapticbridge.plotting import new_figure
from hapticbridge.theory.bounds import minimum_damping, worst_frequency
from hapticbridge.theory.spectrum import damping_spectrum
from hapticbridge.theory.transfer import Discretization, transmission_line_spectrum
from hapticbridge.theory.z_width import ZWidth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Array = NDArray[np.float64]

POINTS = 400
"""Number of frequencies per spectrum, over three decades up to Nyquist; more only enlarges the
file."""

HIGHEST_SHOWN = 4.0
"""Upper limit of an axis in units of its main quantity: the largest stiffness of the region, or the
required damping. A larger limit shows more of the far range and flattens the rest."""

TITLE_WIDTH = 95
"""Number of characters in a title's line that fit into 8 inches; more would be cut off."""

_COLOURS = ("#1a5fb4", "#b3261e", "#2e7d32", "#8e44ad", "#c77700", "#5f6368", "#0b7285", "#d6336c")
_STYLES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)), "-.", (0, (4, 4)))


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """One realisation of a stiffness and damping, and its requirement on the device.

    Attributes:
        name: Distinctive property.
        needed: Required device damping in N s/m; inf if none suffices.
        frequency: Frequency in rad/s at which it is needed, 0.0 for low frequency. None without a
            single frequency: all alike, as for a spring without damper, or none.
        spectrum: Frequencies in rad/s and the required damping there; None without a curve.
    """

    name: str
    needed: float
    frequency: float | None
    spectrum: tuple[_Array, _Array] | None


def alternatives(requested: Coupling, period: float, filter_time: float) -> tuple[Alternative, ...]:
    """Returns the requirements of a coupling by method, and by each way around the bound.

    The methods with a guarantee come first, the default one leading. Each uses the law of
    ``Method.law_coupling``; if its damping would be negative, the effective damping exceeds the
    requested one. Laws with the requested damping follow: at half the period; with a first-order
    low-pass behind the damper; with Tustin's damper; with one tick of delay. Last is a lossless
    transmission line of equal static stiffness, with impedance Z = K T and one sample each way,
    terminated by the device.

    Args:
        requested: Requested K and B; only the translation counts.
        period: T in s, finite and > 0.
        filter_time: τ in s of the low-pass, >= 0.

    Raises:
        CouplingError: An argument is out of range.

    References:
        Brown & Colgate 1997, eqs. (2), (6), (7) and section 6.
    """

    def way(
        name: str,
        step: float = period,
        scheme: Discretization = "backward",
        delay: int = 0,
        low_pass: float = 0.0,
        law: Coupling = requested,
    ) -> Alternative:
        loop: Any = {"discretization": scheme, "delay": delay, "filter_time": low_pass}
        needed = minimum_damping(law, step, **loop)
        frequency = _frequencies(step)
        spectrum = damping_spectrum(law, step, frequency, **loop)
        if delay == 0 and law.damping == 0:  # a plain spring needs K T/2 at all frequencies
            return Alternative(name, needed, None, (frequency, spectrum))
        worst = float(worst_frequency(law, step, **loop))
        return Alternative(name, needed, worst, (frequency, spectrum))

    def by_method(method: Method) -> Alternative:
        used = method.law_coupling(requested, period)
        shown = RunCoupling.of(method, period, requested).effective or used
        name = f"{method.name}: B = {shown.damping:.4g} (B_law = {used.damping:.4g})"
        return way(name, law=used)

    methods = list(map(by_method, guaranteed_methods().values()))
    frequency = _frequencies(period)
    line = transmission_line_spectrum(requested.stiffness * period, period, frequency)
    return (
        *methods,
        way("B_law = B at half the period", step=period / 2),
        way(f"B_law = B, low-pass of {1e3 * filter_time:g} ms on it", low_pass=filter_time),
        way("B_law = B, Tustin's damper", scheme="tustin"),
        way("B_law = B, one tick late", delay=1),
        Alternative(
            "transmission line of that stiffness", float(line.max()), None, (frequency, line)
        ),
    )


def _frequencies(period: float) -> _Array:
    frequency = np.geomspace(1e-3, 1, POINTS) * np.pi / period
    frequency[-1] = np.pi / period
    return frequency


def draw_alternatives(
    ways: tuple[Alternative, ...], title: str, device_damping: float | None = None
) -> Figure:
    """Draws the required damping of each alternative over frequency.

    The first alternative sets the scale. ``device_damping`` b in N s/m is drawn as a level.
    """
    figure = new_figure(8, 5.5)
    axes = figure.subplots()
    drawn = [(way.name, *way.spectrum) for way in ways if way.spectrum is not None]
    for i, (name, frequency, needed) in enumerate(drawn):
        axes.semilogx(
            frequency / (2 * np.pi),
            np.where(np.isfinite(needed), needed, np.nan),
            color=_COLOURS[i % len(_COLOURS)],
            ls=_STYLES[i % len(_STYLES)],
            lw=2.2 if i == 0 else 1.5,
            label=name,
        )
    scale = max(ways[0].needed, device_damping or 0.0)
    if device_damping is not None:
        axes.axhline(device_damping, color="black", lw=1, label="the device's damping b")
    lowest = min(needed.min() for _, _, needed in drawn)
    axes.set_ylim(max(min(0.0, lowest), -scale), HIGHEST_SHOWN / 2 * scale)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("device damping needed (N s/m)")
    axes.grid(alpha=0.3, which="both")
    figure.suptitle(title, fontsize="medium", parse_math=False)
    figure.legend(loc="outside lower center", fontsize="small", ncols=2, frameon=False)
    return figure


def recommended(z: ZWidth) -> Coupling:
    """Returns the coupling to request of the default method, whose law is then the corner."""
    return default_method().requested_coupling(z.corner, z.period)


def recommended_coupling(z: ZWidth) -> RunCoupling:
    """Returns the recommended coupling as requested, in the law and effective."""
    return RunCoupling.of(default_method(), z.period, recommended(z), law=z.corner)


def draw_z_width(z: ZWidth, measured: Sequence[tuple[float, float, float]] | None = None) -> Figure:
    """Draws the couplings that a device can show: region, limiting lines and recommended corner.

    ``measured`` holds limits found by trial: B in N s/m, K and its half-width in N/m.
    """
    figure = new_figure(8, 5.5)
    axes = figure.subplots()
    axes.fill_between(z.damping, z.limit, color="#1a5fb4", alpha=0.15, lw=0, label="can be shown")
    for i, line in enumerate(z.lines):
        remark = "" if line.is_required else ", not kept"
        # draw the line to its end only
        inside = z.damping < line.largest_damping
        ends = not inside.all()
        axes.plot(
            np.append(z.damping[inside], [line.largest_damping] * ends),
            np.append(line.stiffness[inside], [0.0] * ends),
            color=_COLOURS[i],
            ls=_STYLES[i],
            lw=2,
            label=f"{line.name}{remark}: {line.reason}",
        )
    corner = z.corner
    axes.plot(corner.damping, corner.stiffness, "o", color="black", ms=7, label="to be used")
    axes.annotate(
        f"K = {corner.stiffness:.4g} N/m\nB = {recommended(z).damping:.3g} N s/m\n"
        f"(B_law = {corner.damping:.3g})",
        (corner.damping, corner.stiffness),
        xytext=(0, -10),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize="small",
    )
    region = float(z.limit.max())
    highest = max(float(line.stiffness.max()) for line in z.lines)
    if measured:
        damping, stiffness, half_width = zip(*measured, strict=True)
        label = "measured: below it a push died down, above it did not"
        axes.errorbar(damping, stiffness, half_width, fmt="D", color="#c64600", ms=6, label=label)
        region = max(region, max(stiffness) / HIGHEST_SHOWN)
    axes.set_ylim(0, min(1.08 * highest, HIGHEST_SHOWN * region))
    axes.set_xlim(0, z.damping[-1])
    axes.set_xlabel("damping of the law, B_law (N s/m)")
    axes.set_ylabel("coupling stiffness K (N/m)")
    axes.grid(alpha=0.3)
    facts = [f"b = {z.device_damping:g} N s/m", f"{1 / z.period:g} Hz"]
    facts += [] if z.mass is None else [f"{z.mass:g} kg"]
    facts += [] if z.friction is None else [f"friction {z.friction:g} N"]
    facts += [f"steps of {z.resolution:g} m"] * bool(z.resolution)
    facts += [f"delay of {1e3 * z.delay * z.period:g} ms"] * bool(z.delay)
    facts += [f"low-pass of {1e3 * z.filter_time:g} ms"] * bool(z.filter_time)
    # line breaks fall between facts only
    kept = ", ".join(fact.replace(" ", "\xa0") for fact in facts)
    title = "\n".join(wrap(f"What a device can show: {kept}", TITLE_WIDTH)).replace("\xa0", " ")
    figure.suptitle(title, fontsize="medium", parse_math=False)
    figure.legend(loc="outside lower center", fontsize="small", ncols=1, frameon=False)
    return figure
