"""Map ``restitution``: a rod after one contact of MuJoCo's, against three laws of impact.

No rendering method is involved: the rod has no handle and no coupling. Its contact depends on
MuJoCo's integrator and contact setting alone.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.lab.maps import base
from hapticbridge.lab.maps.base import Point, Sentences
from hapticbridge.lab.maps.twins import NO_LIMITS, UNGUARDED_OPTIONS, Run, Twins
from hapticbridge.plotting import new_figure
from hapticbridge.scene import Scene
from hapticbridge.sweep import Table
from hapticbridge.theory.impact import ImpactBody, Law, resolve_impact

MASS, LENGTH = 1.0, 1.0
"""Mass in kg and length in m of the uniform rod."""
INERTIA = MASS * LENGTH**2 / 12
"""Moment of inertia about its centre of mass, in kg m²."""

TIP = 1e-3
"""Radius in m of the sphere at the rod's lower end; it is a point beside 1 m."""

APPROACH = 1.0
"""Speed in m/s at which the rod falls, without turning. Gravity is off, so only the contact
acts."""

LONGEST = 0.2
"""Time in s after which an unfinished contact is read as it is: four times the longest."""

ROD = f"""
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0" cone="elliptic"><flag diagexact="enable"/></option>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="rod">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <joint type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="{MASS!r}" diaginertia="{INERTIA!r} {INERTIA!r} 0.001"/>
      <geom name="tip" type="sphere" size="{TIP!r}" pos="{-LENGTH / 2!r} 0 0"/>
    </body>
  </worldbody>
</mujoco>"""
"""A rod that moves in a plane and whose lower end alone can touch the floor."""


@dataclass(frozen=True, slots=True)
class ContactSetting:
    """Contact setting of MuJoCo.

    Attributes:
        solref: Time constant in s and damping ratio, or minus stiffness and damping.
        impedance: ``dmin`` and ``dmax``, without unit.
        integrator: Name of the integrator in MJCF.
        timestep: Timestep in s.
    """

    solref: tuple[float, float]
    impedance: tuple[float, float]
    integrator: str
    timestep: float = 1e-3


SETTINGS: Mapping[str, ContactSetting] = {
    "scenes": ContactSetting((0.002, 1.0), (0.9, 0.95), "discrete"),
    "scenes, implicitfast": ContactSetting((0.002, 1.0), (0.9, 0.95), "implicitfast"),
    "soft": ContactSetting((0.02, 1.0), (0.9, 0.95), "discrete"),
    "bouncy": ContactSetting((0.02, 0.1), (0.9, 0.95), "discrete"),
    "bouncy, implicitfast": ContactSetting((0.02, 0.1), (0.9, 0.95), "implicitfast"),
    "bouncy, implicitfast, 0.1 ms": ContactSetting((0.02, 0.1), (0.9, 0.95), "implicitfast", 1e-4),
    "hard spring": ContactSetting((-1e5, -5.0), (0.99, 0.99), "discrete"),
}
"""Contact settings. ``scenes`` is that of the scenes shipped with hapticbridge, ``soft`` has
MuJoCo's default ``solref``; the others rebound."""

_INTEGRATORS = {
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


@dataclass(frozen=True, slots=True)
class Rebound:
    """Effect of one contact on the rod.

    Attributes:
        velocity: Velocity of the tip along t and n afterwards in m/s.
        energy_change: Kinetic energy after minus before in J.
        first_gain: First step after which the rod had more energy than at the start, −1 for
            none.
        steps: Number of steps of the contact.
    """

    velocity: tuple[float, float]
    energy_change: float
    first_gain: int
    steps: int


@lru_cache
def restitution_of(setting: str) -> float:
    """Returns e of a contact setting, from a rod that falls upright without friction.

    The value is clipped to [0, 1], the range of the laws.
    """
    return min(1.0, max(0.0, drop(setting, np.pi / 2, 0.0, 0.0).velocity[1] / APPROACH))


def drop(setting: str, angle: float, friction: float, slide: float) -> Rebound:
    """Lets MuJoCo's contact act on a rod until it ends.

    The tip starts half a step's fall above the floor. The contact has ended when its force is 0
    again.

    Args:
        setting: One of ``SETTINGS``.
        angle: Angle of the rod above the floor in rad; π/2 is upright.
        friction: μ, >= 0, without unit.
        slide: Speed along the floor in m/s, > 0 towards the rod's upper end.
    """
    chosen = SETTINGS[setting]
    model, data = _rod()
    model.opt.timestep = chosen.timestep
    model.opt.integrator = _INTEGRATORS[chosen.integrator]
    model.geom_solref[:] = chosen.solref
    model.geom_solimp[:] = (*chosen.impedance, 0.001, 0.5, 2)
    model.geom_friction[:, 0] = max(friction, 1e-9)  # MuJoCo refuses a friction of 0 with a cone
    mujoco.mj_resetData(model, data)
    height = LENGTH / 2 * np.sin(angle) + TIP + APPROACH * chosen.timestep / 2
    data.qpos[:] = 0.0, height, -angle
    data.qvel[:] = slide, -APPROACH, 0.0
    start = 0.5 * MASS * (slide**2 + APPROACH**2)
    touched, first_gain, kinetic, step = False, -1, start, 0
    for step in range(1, round(LONGEST / chosen.timestep) + 1):
        mujoco.mj_step(model, data)
        v_x, v_z, spin = (float(value) for value in data.qvel)
        kinetic = 0.5 * (MASS * (v_x**2 + v_z**2) + INERTIA * spin**2)
        if kinetic > start + 1e-9 and first_gain < 0:
            first_gain = step
        pushes = data.nefc > 0 and data.efc_force[0] > 0
        if touched and not pushes:
            break
        touched = touched or pushes
    tilt = -float(data.qpos[2])
    arm = -LENGTH / 2 * np.cos(tilt), -LENGTH / 2 * np.sin(tilt) - TIP
    velocity = float(v_x + spin * arm[1]), float(v_z - spin * arm[0])
    return Rebound(velocity, kinetic - start, first_gain, step)


_rods = threading.local()
"""The rod of each thread, because an executor may compute several points at a time."""


def _rod() -> tuple[mujoco.MjModel, mujoco.MjData]:
    if not hasattr(_rods, "model"):
        _rods.model = mujoco.MjModel.from_xml_string(ROD)
        _rods.data = mujoco.MjData(_rods.model)
    return _rods.model, _rods.data


SLIDE = 0.8
"""Speeds in m/s along the floor: forwards, backwards and none."""

SHOWN = 0.75
"""Friction coefficient of the drawn curves, that of the example in which Newton's law gains
energy."""

DRAWN = ("scenes", "bouncy, implicitfast")

COLOURS = {
    "inelastic": "#b0b0b0",
    "newton": base.THEORY_COLOUR,
    "poisson": "#7fb2ee",
    "stronge": "#0d2c54",
}
"""Colours of the laws, tints of the theory's colour; ``inelastic`` is any of them with e = 0. The
measurement is black."""

STYLES = {"inelastic": ":", "newton": "-", "poisson": "--", "stronge": "-."}
MEASURED: Mapping[str, Any] = {"color": "black", "ls": "", "marker": "o", "ms": 3.5, "mfc": "white"}

Summary = dict[str, Any]
"""Results of one contact setting."""


def draw(table: Table, boundary: Mapping[str, Any]) -> Figure:
    """Draws the energy over the angle, and the distance of each law from MuJoCo."""
    by_setting = boundary["settings"]
    figure = new_figure(8, 7.2)
    panels = figure.subplots(2, 2, gridspec_kw={"height_ratios": [1, 1.1]})
    for axes, name in zip(panels[0], DRAWN, strict=True):
        _draw_curves(axes, table, name)
    panels[0, 0].set_ylabel("change of kinetic energy (J)")
    summaries = by_setting.values()
    distances = {law: [row["rms_distance_to_law"][law] for row in summaries] for law in COLOURS}
    _draw_bars(panels[1, 0], by_setting, distances, "distance from MuJoCo, RMS (J)")
    largest = {
        "MuJoCo": [row["largest_energy_change"] for row in summaries],
        "newton": [row["largest_by_newton"] for row in summaries],
    }
    label = "largest change of energy (J)\nblack: MuJoCo, blue: Newton"
    _draw_bars(panels[1, 1], by_setting, largest, label)
    figure.suptitle(
        f"A rod of {MASS:g} kg and {LENGTH:g} m falls at {APPROACH:g} m/s on MuJoCo's floor;\n"
        f"above: it slides at {SLIDE:g} m/s, friction {SHOWN:g}",
        fontsize="medium",
    )
    _legend(figure)
    return figure


def _draw_curves(axes: Axes, table: Table, name: str) -> None:
    rows = (table["setting"] == name) & (table["friction"] == SHOWN) & (table["slide"] == SLIDE)
    selected = table.select(rows)
    if not len(selected):
        base.say_missing(axes)
        return
    angle = np.degrees(selected["angle"])
    for law, colour in COLOURS.items():
        axes.plot(angle, selected[law], color=colour, ls=STYLES[law], lw=1.6)
    axes.plot(angle, selected["energy_change"], **MEASURED)
    axes.axhline(0.0, color="black", lw=0.6)
    axes.set_xlabel("angle of the rod above the floor (°)")
    axes.set_title(f"{name}: e = {selected['restitution'][0]:.2g}", fontsize="medium")


def _legend(figure: Figure) -> None:
    """Names laws and measurement in a legend, also those that no panel shows."""
    handles = [
        Line2D([], [], color=colour, ls=STYLES[law], lw=1.6, label=_named(law))
        for law, colour in COLOURS.items()
    ]
    handles.append(Line2D([], [], label="MuJoCo", **MEASURED))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=5, fontsize="small", frameon=False
    )


def _named(law: str) -> str:
    return "any law, e = 0" if law == "inelastic" else law.capitalize()


def _draw_bars(
    axes: Axes, names: Iterable[str], rows: Mapping[str, Sequence[float]], label: str
) -> None:
    """Draws a bar per setting for each law, or for MuJoCo in black."""
    names = [name.replace(", ", ",\n", 1) for name in names]
    place, height = np.arange(len(names)), 0.8 / len(rows)
    for shift, (law, values) in enumerate(rows.items()):
        centre = place + height * (shift - (len(rows) - 1) / 2)
        axes.barh(centre, values, height, color=COLOURS.get(law, "black"))
    axes.set_yticks(place, names, fontsize="small")
    axes.invert_yaxis()
    axes.axvline(0.0, color="black", lw=0.6)
    axes.set_xlabel(label)


RESTITUTION_LAWS: tuple[Law, ...] = ("newton", "poisson", "stronge")

FRICTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Coulomb's coefficients μ, without unit."""

LEAD = 0.2
"""Lead by which the nearest law must be nearer to MuJoCo than the second, without unit. With less,
laws that a soft contact cannot distinguish would be named by chance."""


DEFAULT_POINTS = 4200
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns contact settings, frictions and slides at angles that make about ``count``."""
    angles = np.linspace(0.05, 1.52, max(2, round(count / (len(SETTINGS) * len(FRICTIONS) * 3))))
    return [
        {"setting": name, "friction": friction, "slide": slide, "angle": float(angle)}
        for name in SETTINGS
        for friction in FRICTIONS
        for slide in (-SLIDE, 0.0, SLIDE)
        for angle in angles
    ]


def evaluate(point: Point) -> Mapping[str, float | int]:
    """Drops a rod on MuJoCo's floor, and resolves the same impact by each law.

    The laws get the e of the contact setting: that of a rod that falls upright without friction,
    where they agree.
    """
    name = str(point["setting"])
    angle, friction, slide = (float(point[key]) for key in ("angle", "friction", "slide"))
    impact = drop(name, angle, friction, slide)
    restitution = restitution_of(name)
    results: dict[str, float | int] = {
        "energy_change": impact.energy_change,
        "restitution": restitution,
        "own_restitution": impact.velocity[1] / APPROACH,
        "first_gain": impact.first_gain,
        "steps": impact.steps,
        "inelastic": _by_law("poisson", angle, friction, slide, 0.0),
    }
    return results | {
        law: _by_law(law, angle, friction, slide, restitution) for law in RESTITUTION_LAWS
    }


def _by_law(law: Law, angle: float, friction: float, slide: float, restitution: float) -> float:
    arm = [-LENGTH / 2 * np.cos(angle), -LENGTH / 2 * np.sin(angle) - TIP]
    rod = ImpactBody(MASS, INERTIA, arm)
    velocity = [slide, -APPROACH]
    return float(resolve_impact(rod, velocity, friction, restitution, law).energy_change)


def summarize(table: Table) -> dict[str, Any]:
    """Compares each contact setting with the laws of impact."""
    groups = {name: table.select(table["setting"] == name) for name in SETTINGS}
    return {
        "settings": {name: _summary(selected) for name, selected in groups.items() if len(selected)}
    }


def _summary(selected: Table) -> Summary:
    measured = selected["energy_change"]
    distances = {law: float(np.sqrt(np.mean((measured - selected[law]) ** 2))) for law in COLOURS}
    return {
        "restitution": float(selected["restitution"][0]),
        "rms_distance_to_law": distances,
        "nearest_law": _nearest(distances),
        "largest_energy_change": float(measured.max()),
        "largest_by_newton": float(selected["newton"].max()),
        "share_that_gained": float(np.mean(selected["first_gain"] >= 0)),
        "at_the_largest": {
            key: float(selected[key][measured.argmax()]) for key in ("angle", "friction", "slide")
        },
        "largest_own_restitution": float(selected["own_restitution"].max()),
    }


def _nearest(distances: Mapping[str, float]) -> str | None:
    """Returns the law that leads the second by more than ``LEAD``; None without such a lead."""
    first, second = sorted(distances, key=distances.__getitem__)[:2]
    return first if distances[first] < (1 - LEAD) * distances[second] else None


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States e, the energy and the nearest law of each contact setting."""
    for name, selected in boundary["settings"].items():
        yield (
            "With '{name}' a rod that falls upright comes back with e = {restitution:.2g}; at any "
            "angle and friction its energy changes by {largest_energy_change:+.2g} J at most, by "
            "Newton's law {largest_by_newton:+.2g} J; the nearest law is {nearest}",
            selected | {"name": name, "nearest": selected["nearest_law"] or "none"},
        )


TWIN_SETTING = SETTINGS["bouncy, implicitfast"]
"""Contact setting of the twin that fails; the other one has another damping ratio."""

TWIN_RATIOS = (TWIN_SETTING.solref[1], 1.0)
"""Damping ratios of the twins' contacts, without unit: bouncy, and critically damped."""

TWIN_ANGLE = 45.0
"""Angle in degrees of the twins' rod above the floor."""


def falling_rod(ratio: float) -> Scene:
    """Loads the rod as it slides and falls, beside a tool that a hand holds still.

    Args:
        ratio: Damping ratio of the rod's contact, without unit.
    """
    angle, (timeconst, _) = float(np.radians(TWIN_ANGLE)), TWIN_SETTING.solref
    height = float(LENGTH / 2 * np.sin(angle) + TIP + APPROACH * TWIN_SETTING.timestep / 2)
    low, high = TWIN_SETTING.impedance
    setting = f"""
  <default>
    <geom solref="{timeconst!r} {ratio!r}" solimp="{low!r} {high!r} 0.001"
      friction="{SHOWN!r} 0 0"/>
  </default>
  <worldbody>"""
    rest = f"""
    <body name="tool" pos="0 0 1">
      <freejoint/>
      <geom type="sphere" size="0.01" mass="0.1" contype="0" conaffinity="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
  <keyframe>
    <key name="home" qpos="0 {height!r} {-angle!r} 0 0 1 1 0 0 0"
      qvel="{SLIDE!r} {-APPROACH!r} 0 0 0 0 0 0 0"/>
  </keyframe>"""
    return base.scene_of(ROD.replace("<worldbody>", setting).replace("</worldbody>", rest))


def twins() -> Twins:
    """Returns a rod that slides and falls on the floor, with a bouncy and with a damped contact."""
    return Twins(
        shared=f"A rod of {MASS:g} kg falls on MuJoCo's floor at {APPROACH:g} m/s, "
        f"{TWIN_ANGLE:g}° above it and sliding at {SLIDE:g} m/s, "
        f"timeconst {1e3 * TWIN_SETTING.solref[0]:g} ms",
        name="damping ratio of the contact",
        values=TWIN_RATIOS,
        run=lambda ratio: Run(
            scene=partial(falling_rod, ratio),
            device=partial(SimulatedDevice, path=base.STILL, **NO_LIMITS),
            coupling=Coupling(1000.0, 0.5, 0.0, 0.0),
            options=replace(
                UNGUARDED_OPTIONS,
                method=TWIN_SETTING.integrator,  # the method of this integrator
                contact="scene",
                rate=1 / TWIN_SETTING.timestep,
            ),
            duration=0.1,
        ),
    )
