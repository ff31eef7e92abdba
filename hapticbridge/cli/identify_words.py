"""What ``hapticbridge identify`` says of a device, and the couplings that follow."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from hapticbridge.cli.terminal import out, plain
from hapticbridge.cli.zwidth import next_command
from hapticbridge.felt import coupling_sentences
from hapticbridge.identify import Identification
from hapticbridge.identify.estimate import CONFIDENCE
from hapticbridge.identify.identification import UNHELD
from hapticbridge.passivity import ZWidth, z_width
from hapticbridge.quantity import quantity
from hapticbridge.rendering import default_method
from hapticbridge.theory_plots import recommended


def safe_width(result: Identification) -> ZWidth | None:
    """Returns the couplings that are safe with the lower ends of what was measured."""
    damping = result.of_all("damping", turns=False)
    mass = result.of_all("mass", turns=False)
    friction = result.of_all("friction", turns=False)
    delay = result.of_all("delay", turns=False, most=True)
    if damping is None or mass is None or friction is None or delay is None:
        return None
    if damping.least <= 0.0:
        return None
    period = result.runs[next(iter(result.runs))].period
    late = delay.least / period  # the interval must leave zero for a delay to be one
    return z_width(
        damping.least,
        period,
        mass=mass.least,
        friction=max(friction.least, 0.0),
        resolution=result.resolution or 0.0,
        delay=math.ceil(delay.most / period) if late > 0.05 else 0,
    )


def print_result(result: Identification, z: ZWidth | None) -> None:
    """Prints what was measured, how surely, and the coupling to use.

    Args:
        result: What ``identify`` returned.
        z: What ``safe_width`` made of it.
    """
    for turns, units in ((False, ("kg", "N s/m", "N")), (True, ("kg m²", "N m s/rad", "N m"))):
        names = zip(("mass", "damping", "friction"), units, strict=True)
        headings = [f"{name} ({unit})" for name, unit in names]
        table = Table("axis", *headings, "delay (ms)", box=None, pad_edge=False)
        for axis, fit in result.fits.items():
            if (len(axis) == 2) == turns:
                table.add_row(
                    axis,
                    fit.mass.told(),
                    fit.damping.told(),
                    fit.friction.told(),
                    f"{1e3 * fit.delay.value:.2f} ± {1e3 * fit.delay.half_width:.2f}",
                )
        if table.row_count:
            out.print(table)
    out.print(
        f"period {1e3 * result.period:.4g} ms, spread {quantity(result.period_spread, 's')}, "
        f"one in a thousand longer than {1e3 * result.period_most:.4g} ms"
    )
    if result.resolution is not None:
        step = quantity(result.resolution, "m") if result.resolution else "none seen"
        out.print(f"resolution {step}")
    out.print(f"the interval holds the true value with {CONFIDENCE:.0%}; {UNHELD}")
    for axis, fit in result.fits.items():
        if fit.drag.is_seen:
            unit = "N m s²/rad²" if len(axis) == 2 else "N s²/m²"
            at = f"{fit.drag_speed:.2g} {'rad/s' if len(axis) == 2 else 'm/s'}"
            out.print(
                f"{axis}: resistance also changes with speed squared, {fit.drag.told()} {unit}; "
                f"damping is that at {at if fit.drag_speed else 'small speeds'}, the least seen"
            )
    if left := [axis for axis in result.info.axes if axis not in result.fits]:
        out.print(f"not measured: {', '.join(left)}; a profile takes axes of a kind for alike")
    if z is None:
        out.print(why_none(result))
        return
    out.print(
        f"with the lower ends (b = {z.device_damping:.4g} N s/m) the largest safe stiffness is "
        f"{z.limit[0]:.4g} N/m at B' = 0 ({z.corner_limited_by})"
    )
    (told,) = coupling_sentences(z.corner, default_method(), z.period, 1)
    felt = recommended(z)
    out.print(f"use {told}")
    out.print(f"next: {plain(next_command(felt.stiffness, felt.damping, 1.0 / z.period))}")


def why_none(result: Identification) -> str:
    """Says why there is no safe coupling to name."""
    if result.of_all("damping", turns=False) is None:
        return "none of x, y, z was measured: the stiffness that the device can show is not known"
    return "damping may be zero: no coupling is safe for any hand"


def facts(result: Identification, z: ZWidth | None, path: Path | None) -> dict[str, object]:
    """Returns the same as ``print_result`` prints, for ``--json``."""
    return {
        "device": result.info.name,
        "axes": {axis: asdict(fit) for axis, fit in result.fits.items()},
        "resolution": result.resolution,
        "period": result.period,
        "period_spread": result.period_spread,
        "period_most": result.period_most,
        "confidence": CONFIDENCE,
        "assumed": UNHELD,
        "largest_stiffness": None if z is None else float(z.limit[0]),
        "coupling": None
        if z is None
        else {"stiffness": recommended(z).stiffness, "damping": recommended(z).damping},
        "profile": None if path is None else str(path),
    }
