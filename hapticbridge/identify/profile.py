"""Measured values of a device as a profile."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hapticbridge.device.profile import Profile, Quantity
from hapticbridge.identify.fit import AxisFit, Estimate, noise_of, windows
from hapticbridge.identify.identify import UNHELD, Identification
from hapticbridge.plotting import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Plot of the identified law: resistance of each axis over its speed


_COLOURS = {"x": "#a51d2d", "y": "#1b7837", "z": "#1a5fb4"}

_WIDTHS = {"x": 5.0, "y": 3.0, "z": 1.2}
"""Line widths in points. Lines of similar axes coincide, and all must remain visible."""


def draw_identification(result: Identification) -> Figure:
    """Draws the force of each axis, less inertia and constant, over the speed.

    Each point is one window: F − M x'' − c over x'. A device that obeys the law lies on the line b
    x' + b_2 x' |x'| + f_c sign(x'), with b_2 only if it is significant.

    Args:
        result: Result of ``identify``.
    """
    kinds = [turns for turns in (False, True) if any((len(a) == 2) == turns for a in result.fits)]
    figure = new_figure(8, 4.0 * len(kinds) + 0.3)
    panels = figure.subplots(len(kinds), 1, squeeze=False)[:, 0]
    for panel, turns in zip(panels, kinds, strict=True):
        for axis, fit in result.fits.items():
            if (len(axis) == 2) == turns:
                _draw_axis(panel, result, axis, fit)
        panel.axhline(0.0, color="#777777", lw=0.8)
        panel.axvline(0.0, color="#777777", lw=0.8)
        panel.set_xlabel("angular velocity (rad/s)" if turns else "velocity (m/s)")
        panel.set_ylabel("torque F − M x'' − c (N m)" if turns else "force F − M x'' − c (N)")
        panel.grid(alpha=0.3)
        panel.legend(fontsize="small", loc="upper left")
    bends = any(fit.drag.is_seen for fit in result.fits.values())
    law = f"b v + {'b_2 v |v| + ' if bends else ''}f_c sign(v)"
    figure.suptitle(
        f"Resistance of {result.info.name}: points measured, lines {law}",
        fontsize="medium",
        parse_math=False,
    )
    return figure


def _draw_axis(panel: Axes, result: Identification, axis: str, fit: AxisFit) -> None:
    run, colour = result.runs[axis], _COLOURS[axis[-1]]
    turns = len(axis) == 2
    step = 0.0 if turns else result.resolution or 0.0
    noise = noise_of(run.position, step)
    found = windows(run.position, run.force, run.period, fit.window, step, fit.delay.value, noise)
    area = found.columns[:, 3]
    speed = found.columns[:, 1] / area
    rest = found.right / area - fit.mass.value * found.columns[:, 0] / area - fit.offset.value
    panel.plot(speed, rest, ".", color=colour, ms=3, zorder=3)
    most = float(np.abs(speed).max())
    line = np.linspace(-most, most, 400)
    force = fit.resistance(line)
    units = ("N m s/rad", "N m") if turns else ("N s/m", "N")
    panel.plot(
        line,
        force,
        color=colour,
        lw=_WIDTHS[axis[-1]],
        alpha=0.45,
        label=f"{axis}: b = {fit.damping.as_text()} {units[0]}, "
        f"f_c = {fit.friction.as_text()} {units[1]}",
    )


_FIELDS = {
    "mass": ("mass", False),
    "damping": ("damping", False),
    "friction": ("friction", False),
    "rotational_inertia": ("mass", True),
    "rotational_damping": ("damping", True),
}


def measured_profile(
    result: Identification,
    *,
    device: str,
    serial: str,
    date: str,
    duration: float,
    workspace: tuple[float, float, float] | None = None,
) -> Profile:
    """Returns a profile of the unit with the most cautious values of each kind of axis.

    Args:
        result: Result of ``identify``.
        device: Name of the driver.
        serial: Serial number of the unit; may be empty.
        date: Date of the measurement, as written into the file.
        duration: Time per axis in s, as written into the file.
        workspace: Workspace in m, for a device whose metres are stated by the user. The measured
            values hold only together with it.
    """
    info = result.info
    source = f"identified on {date}: {duration:g} s per axis ({', '.join(result.fits)}); {UNHELD}"
    quantities: dict[str, Quantity] = {}
    for name, (field, turns) in _FIELDS.items():
        found = result.of_all(field, turns=turns)
        if found is not None:
            quantities[name] = _quantity(found, source)
    if result.resolution is not None:
        quantities["resolution"] = Quantity(result.resolution, source)
    late = [
        found
        for turns in (False, True)
        if (found := result.of_all("delay", turns=turns, most=True)) is not None
    ]
    latest = max(late, key=lambda delay: delay.most)
    quantities["delay"] = replace(
        _quantity(latest, source), value=delay_of(latest, next(iter(result.runs.values())).period)
    )
    for name in ("force_limit", "torque_limit", "speed_limit"):
        quantities[name] = Quantity(float(getattr(info, name)), "from the driver, not measured")
    if info.reach is not None:
        quantities["reach"] = Quantity(info.reach, "as known before, not measured")
    if workspace is not None:
        quantities["workspace"] = Quantity(workspace, "stated or assumed when it was identified")
    return Profile(
        name=f"{info.name} {serial}".strip(),
        device=device,
        serial=serial,
        axes=info.axes,
        about="",
        quantities=quantities,
        models=(info.name,),
    )


def delay_of(found: Estimate, period: float) -> float:
    """Returns a measured delay in s: as whole ticks if the interval has a whole number of them.

    A device that answers a request within the tick is a tick late. Its estimate is a little more or
    less than that, and a little more would count as another whole tick.

    Args:
        found: The estimate in s.
        period: T in s of the loop that measured it.
    """
    whole = max(round(found.value / period), 0) * period
    return whole if found.least <= whole <= found.most else max(found.value, 0.0)


def _quantity(found: Estimate, source: str) -> Quantity:
    # friction and delay are not negative, but a measurement of zero may be
    value = max(found.value, 0.0)
    return Quantity(value, source, (min(max(found.least, 0.0), value), max(found.most, value)))
