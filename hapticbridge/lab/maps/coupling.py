"""Map ``coupling``: stiffness against damping at one device, for every method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.lab.closed_loop import ClosedLoop, LoopOutcome
from hapticbridge.lab.maps import base
from hapticbridge.lab.maps.base import PERIOD, Point, Sentences
from hapticbridge.lab.maps.tool_mass import effective_response, worst_angle
from hapticbridge.lab.maps.twins import NO_LIMITS, UNGUARDED_OPTIONS, Run, Twins
from hapticbridge.lab.methods import METHODS, THEORIES
from hapticbridge.plotting import new_figure
from hapticbridge.sweep import Table
from hapticbridge.theory.sampled_loop import WorstHand

DEVICE_DAMPING = 2.0
"""Device damping b in N s/m, that of the default simulated device."""

TOOL_MASS = 0.05
"""Mass in kg of the tool of the scene ``virtual_wall``. Tool and wall are from there, without the
rail."""

WALL_MASS = 1e6
"""Mass in kg of a tool that no hand moves: a wall at a known place without MuJoCo's contact. Its
limit is (6) to within T (KT/2 + B)/(2 m) = 1e-9. A lighter tool drifts away, so the run would be
counted as unstable although it is not."""

STABLE = ("stable_on_wall", "stable_free", "stable_tapping")
"""Columns that must all be true for a stable loop; a column without measurement is left out."""

TICKS = 2000
KNOCK = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Displacement that starts a run of the worst hand, in m: 0.1 mm, so that a loop that decays never
reaches the wall 10 mm away."""

STIFFNESS = (100.0, 20_000.0)
"""Range of K in N/m, even in its logarithm: from soft to five times the bound at B = 0."""

DAMPING = (0.0, 3.0)
"""Range of B in N s/m, up to one and a half times b; beyond b nothing is passive."""

SEARCHED = (1.0, 200_000.0)
"""Range of K in N/m for the search of a limit on a wall. It is far wider than the picture's and
equal for every B."""


PATH = base.swinging(0.0075, 1.5, duration=2.0, count=201)
"""Path of a hand that goes 5 mm deep into the wall three times in 2 s."""


DEFAULT_POINTS = 3500
"""Approximate number of points by default."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of K and B for every method, ``count`` runs in all, and a limit per column.

    A cell takes three runs.
    """
    side = max(2, round((count / 3 / len(THEORIES)) ** 0.5))
    stiffness = np.geomspace(*STIFFNESS, side)
    damping = np.linspace(*DAMPING, side)
    cells: list[Point] = [
        {"what": "cell", "method": method, "stiffness": float(k), "damping": float(b)}
        for method in THEORIES
        for b in damping
        for k in stiffness
    ]
    limits: list[Point] = [
        {"what": "limit", "method": method, "stiffness": 0.0, "damping": float(b)}
        for method in THEORIES
        if METHODS[method].has_law
        for b in damping[damping < DEVICE_DAMPING]
    ]
    return cells + limits


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Runs one coupling three times for 2 s, or finds the largest K that is stable on a wall.

    A wall and a free tool, each with its worst hand, show if the loop is stable. A wall without
    contact requires a coupling law. The weld has none: that run is left out and its value is
    missing.

    An ordinary hand that taps a wall shows the energy that the environment creates, and any excess
    energy to the device. Its run fails if it diverges, or if the first fault is at the device's
    port. ``fault_tick`` and ``fault_port`` name the first fault; they are −1 and empty without a
    fault.
    """
    name, damping = str(point["method"]), float(point["damping"])
    if point["what"] == "limit":
        return {"limit": _limit_on_wall(name, damping)}
    coupling = _coupling(float(point["stiffness"]), damping)
    on_wall: dict[str, bool] = {}
    if METHODS[name].has_law:
        on_wall = {"stable_on_wall": _worst_hand(name, coupling, None).is_stable}
    is_stable_free = _worst_hand(name, coupling, TOOL_MASS).is_stable
    touch = _tool().run(
        SimulatedDevice(damping=DEVICE_DAMPING, path=PATH),
        coupling,
        METHODS[name],
        period=PERIOD,
        ticks=TICKS,
    )
    tick, port = touch.fault or (-1, "")
    return on_wall | {
        "stable_free": is_stable_free,
        "stable_tapping": touch.ticks == TICKS and port != "device",
        "fault_tick": tick,
        "fault_port": port,
        "environment": touch.environment,
        "created": touch.created,
        "slack_share": touch.slack_share,
        "peak_force": touch.peak_force,
    }


def _coupling(stiffness: float, damping: float) -> Coupling:
    return Coupling(stiffness, damping, 1.0, 1e-3)  # the rail prevents rotation


def _worst_hand(name: str, coupling: Coupling, mass: float | None) -> LoopOutcome:
    """Runs the worst hand of a method on a wall (no mass) or with a free tool."""
    used = METHODS[name].law_coupling(coupling, PERIOD)
    k, b = used.stiffness, used.damping
    if mass is None:  # at Nyquist, where the damper alone is the worst hand
        hand, loop = WorstHand(DEVICE_DAMPING, np.pi / PERIOD, PERIOD), _wall()
    else:
        angle, _ = worst_angle(THEORIES[name], k, b, mass, PERIOD)
        response = complex(effective_response(THEORIES[name], k, b, mass, PERIOD, angle))
        hand, loop = WorstHand(DEVICE_DAMPING, angle / PERIOD, PERIOD, response), _tool()
    return loop.run(
        SimulatedDevice(hand=hand), coupling, METHODS[name], period=PERIOD, ticks=TICKS, knock=KNOCK
    )


def _tool() -> ClosedLoop:
    return base.loop_in(base.free_tool_and_wall)


def _wall() -> ClosedLoop:
    return base.wall_loop(WALL_MASS, base.free_tool_and_wall)


def _limit_on_wall(name: str, damping: float) -> float:
    """Returns the largest K in N/m at which the wall's worst hand is stable; 0 for none."""

    def is_stable(stiffness: float) -> bool:
        return _worst_hand(name, _coupling(stiffness, damping), None).is_stable

    return base.largest_stable(is_stable, *SEARCHED).middle


def verdicts_of(cells: Table) -> NDArray[np.int64]:
    """Returns the verdict of each cell as an index in ``VERDICTS``, shape (n,).

    A cell is unstable if a measured run failed; a missing value is no measurement.
    """
    is_stable = np.ones(len(cells), dtype=bool)
    for column in STABLE:
        value = cells.numbers(column)
        is_stable &= np.isnan(value) | (value == 1)
    return base.verdict_numbers(is_stable, cells.texts("environment"))


CONTOUR = 41
"""Points along each axis from which the free tool's bound is drawn; more make it smoother."""

FINE = 201
"""Points along each axis from which (6) is drawn; more make its corner sharper."""


def draw(table: Table, _boundary: Mapping[str, Any]) -> Figure:
    """Draws K against B by method, with the bounds and the measured limits on top."""
    figure = new_figure(8, 8.4)
    panels = base.panels(figure, len(THEORIES))
    for axes, name in zip(panels, THEORIES, strict=True):
        has_wall = METHODS[name].has_law
        _draw_cells(axes, base.of_method(table, "cell", name))
        _draw_theory(axes, name, has_wall=has_wall)
        limits = base.of_method(table, "limit", name)
        axes.plot(limits["damping"], limits.numbers("limit"), "o", color="black", ms=4, mfc="white")
        axes.set_title(f"{name}{_note(name)}", fontsize="medium")
        axes.set(xlim=DAMPING, ylim=STIFFNESS)
    for axes in panels[-3:]:
        axes.set_xlabel("coupling damping B (N s/m)")
        axes.tick_params(labelbottom=True)
    for axes in panels[::3]:
        axes.set_ylabel("coupling stiffness K (N/m)")
    figure.suptitle(
        f"K against B, device damping b = {DEVICE_DAMPING:g} N s/m at {1 / PERIOD:g} Hz;\n"
        f"worst hands on a wall and with a tool of {1e3 * TOOL_MASS:g} g, and a hand that taps.\n"
        "B is requested; the law uses B′ = B, or less where a title says so (0 at least)",
        fontsize="medium",
    )
    base.verdict_legend(
        figure,
        [
            ("(6): b = K T/2 + B′", "black", "-"),
            ("(7), Tustin's rule, at low frequency", "black", ":"),
            (f"free tool of {1e3 * TOOL_MASS:g} g by this method", base.THEORY_COLOUR, "--"),
            ("measured limit on a wall", "black", "o"),
        ],
    )
    return figure


def _draw_cells(axes: Axes, cells: Table) -> None:
    base.draw_verdicts(axes, cells["damping"], cells["stiffness"], verdicts_of(cells), log_y=True)


def _note(name: str) -> str:
    """Returns the text of a panel's title after the method's name."""
    method = METHODS[name]
    if not method.has_law:
        return ": free, and tapping"
    return f", {base.law_in_words(name)}" if method.compensated_share else ""


def _draw_theory(axes: Axes, name: str, *, has_wall: bool) -> None:
    """Draws the references of the measurement: (6) and (7) only with a wall."""
    b = DEVICE_DAMPING
    if has_wall:
        fine = np.linspace(*DAMPING, FINE), np.geomspace(*STIFFNESS, FINE)
        by_6 = base.needed_by_6(name, fine[1][:, None], fine[0])
        axes.contour(*fine, by_6, levels=[b], colors="black", linewidths=1.8)
    if has_wall and METHODS[name].compensated_share == 0.0:
        # (7) as θ → 0: (K T)² = 2 b (K T + 2 B)
        damping = np.linspace(*DAMPING, FINE)
        low = (b + np.sqrt(b**2 + 4 * b * damping)) / PERIOD
        axes.plot(damping, low, color="black", ls=":", lw=1.5)
    axes.contour(
        np.linspace(*DAMPING, CONTOUR),
        np.geomspace(*STIFFNESS, CONTOUR),
        np.minimum(_needed(_first_alike(name)), 10 * b),
        levels=[b],
        colors=base.THEORY_COLOUR,
        linestyles="--",
        linewidths=1.5,
    )


def _first_alike(name: str) -> str:
    """Returns the first method with an equal bound of the free tool, computed once."""
    selected = THEORIES[name], METHODS[name].compensated_share
    return next(
        each for each in THEORIES if (THEORIES[each], METHODS[each].compensated_share) == selected
    )


@cache
def _needed(name: str) -> NDArray[np.float64]:
    """Returns the device damping in N s/m that a free tool needs, rows by K and columns by B."""
    stiffness, damping = np.geomspace(*STIFFNESS, CONTOUR), np.linspace(*DAMPING, CONTOUR)
    used = base.used_damping(name, stiffness[:, None], damping)
    return np.array(
        [
            [worst_angle(THEORIES[name], k, float(b), TOOL_MASS, PERIOD)[1] for b in row]
            for k, row in zip(stiffness, used, strict=True)
        ]
    )


def summarize(table: Table) -> dict[str, Any]:
    """Counts outcomes below (6) by method, and compares the limits on a wall with (6)."""
    methods = {
        name: _cells_below(name, base.of_method(table, "cell", name))
        | _limits(name, base.of_method(table, "limit", name))
        for name in THEORIES
    }
    return {"period": PERIOD, "device_damping": DEVICE_DAMPING, "methods": methods}


def _cells_below(name: str, cells: Table) -> dict[str, Any]:
    """Counts the outcomes at a method's points below (6), where a device bears the coupling."""
    needed = base.needed_by_6(name, cells["stiffness"], cells["damping"])
    below = needed < DEVICE_DAMPING
    selected = cells.select(below)
    is_passive = verdicts_of(selected) <= base.VERDICTS.index("within slack")
    ports = selected.texts("fault_port")
    return {
        "passive_share_below_6": float(np.mean(is_passive)) if len(selected) else None,
        "runs_below_6": len(selected),
        "environment_faults_below_6": int((ports == "environment").sum()),
        "device_faults_below_6": int((ports == "device").sum()),
        "max_slack_used_below_6": float(selected.numbers("slack_share").max(initial=0.0)),
        "largest_tapping_force_below_6": float(selected.numbers("peak_force").max(initial=0.0)),
    }


def _limits(name: str, limits: Table) -> dict[str, Any]:
    """Compares the limits that were found on a wall with (6); empty where none was searched."""
    if not len(limits):
        return {}
    predicted = base.limit_by_6(name, DEVICE_DAMPING, limits["damping"])
    measured = limits.numbers("limit")
    return {
        "damping": limits["damping"].tolist(),
        "measured_on_wall": measured.tolist(),
        "predicted_6": predicted.tolist(),
        "largest_deviation": base.agreement(measured, predicted),
    }


def sentences(boundary: Mapping[str, Any]) -> Sentences:
    """States the agreement with (6), and the outcomes below it by method."""
    methods = boundary["methods"]
    yield (
        "On a wall the worst hand turns 'implicit' unstable within {largest_deviation:.2%} of "
        "K = 2 (b − B)/T, eq. (6)",
        methods["implicit"],
    )
    for name, selected in methods.items():
        yield (
            "'{name}' is stable and passive in {passive_share_below_6:.0%} of the runs below (6), "
            "{runs_below_6} in number; the hand that taps finds the environment at fault at "
            "{environment_faults_below_6}, the device at {device_faults_below_6}, and at most "
            "{max_slack_used_below_6:.0%} of the slack used",
            selected | {"name": name},
        )
    yield (
        "B is the requested damping; 'compensated' and 'lossless' use B − K T and B − K T/2, 0 at "
        "least, and (6) holds for what is used",
        {},
    )


TWIN_COUPLING = Coupling(1500.0, 0.6, 1.0, 1e-3)
"""Coupling of the twins: far below (6), and K above B/T, where ``implicitfast`` exceeds its
slack."""


def twins() -> Twins:
    """Returns a hand that taps the wall through one coupling, by two methods."""
    return Twins(
        shared=f"A hand taps a wall, K = {TWIN_COUPLING.stiffness:g} N/m and "
        f"B = {TWIN_COUPLING.damping:g} N s/m",
        name="method",
        values=("implicitfast", "implicit"),
        run=lambda method: Run(
            scene=base.free_tool_and_wall,
            device=partial(SimulatedDevice, damping=DEVICE_DAMPING, path=PATH, **NO_LIMITS),
            coupling=TWIN_COUPLING,
            # by default 'implicit' has rigid contacts, which 'implicitfast' cannot have
            options=replace(UNGUARDED_OPTIONS, method=method, contact="scene", rate=1 / PERIOD),
            duration=1.0,
        ),
    )
