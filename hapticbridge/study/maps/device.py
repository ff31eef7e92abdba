"""Map ``device``: what encoder steps and dry friction of a device make of a wall.

Diolaiti's regions are those of a spring alone, B = 0, of which no method takes anything off: the
law is one for ``implicit``, ``compensated`` and ``lossless``, and one of them is run. With a damper
they differ by their B', and each is measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.study.maps.device_picture import draw
from hapticbridge.study.maps.device_runs import (
    DAMPERS,
    LARGE,
    METHODS_SHOWN,
    PERIOD,
    QUANTUM,
    RANGE,
    REGIONS,
    RESOLUTION,
    STIFFNESS,
    friction_needed,
    friction_to_rest,
    region_of,
    settle,
    shaken,
)
from hapticbridge.study.maps.stability_map import Finding, Point, StabilityMap, computed
from hapticbridge.study.maps.verdicts import MISSING
from hapticbridge.study.table import Table
from hapticbridge.theory.device_limits import quantization_limit

SMALLEST = 1e-4
"""Deviation in per cent below which rounding alone is left, and nothing smaller is quoted."""


def points(count: int) -> Sequence[Point]:
    """Returns a grid of β and σ, and dampers by method at which the friction needed is measured."""
    side = max(3, round(count**0.5))
    values = np.geomspace(*RANGE, side)
    cells: list[Point] = [
        _point("cell", METHODS_SHOWN[0], float(beta), float(sigma), 0.0)
        for beta in values
        for sigma in values
    ]
    dampers: list[Point] = [
        _point("friction", name, 0.0, 0.0, float(damping))
        for name in METHODS_SHOWN
        for damping in np.linspace(*DAMPERS, max(3, side // 3))
    ]
    return cells + dampers


def _point(what: str, method: str, beta: float, sigma: float, damping: float) -> Point:
    return {"what": what, "method": method, "beta": beta, "sigma": sigma, "damping": damping}


def evaluate(point: Point) -> Mapping[str, float | str | bool]:
    """Lets a pressed device settle from where it is and from a large knock, and says what it did.

    Or measures the friction that pays for a coupling's damper.
    """
    if point["what"] == "friction":
        law = str(point["method"]), float(point["damping"])
        return {"needed_at_rest": friction_to_rest(*law), "needed_shaken": shaken(*law)}
    beta, sigma = float(point["beta"]), float(point["sigma"])
    small, small_range, _ = settle(beta, sigma, 0.0)
    large, large_range, run = settle(beta, sigma, LARGE)
    return {
        "small": small,
        "large": large,
        "region": region_of(small, large),
        "cycle": small_range if small == "cycle" else large_range if large == "cycle" else 0.0,
        "last_range": large_range,
        "ticks": run.ticks,
        "device_energy": run.device_energy,
    }


def read(table: Table) -> Finding:
    """Compares regions over β and σ, and the friction that a damper needs, with theory.

    Where no point of one of the two, or of a method, was computed it is left out, and the
    paragraph says so.

    Raises:
        StudyError: No point was computed at all.
    """
    table = computed(table, "device")
    cells = table.select(table["what"] == "cell")
    dampers = table.select(table["what"] == "friction")
    boundary: dict[str, Any] = {
        "period": PERIOD,
        "stiffness": STIFFNESS,
        "resolution": RESOLUTION,
        "regions": _regions(cells) if len(cells) else {},
        "friction": {
            name: _friction(name, mine)
            for name in METHODS_SHOWN
            if len(mine := dampers.select(dampers["method"] == name))
        },
    }
    said = [_of_regions(boundary["regions"]), _of_friction(boundary["friction"])]
    return Finding(draw(cells, boundary["friction"]), " ".join(said), boundary)


def _regions(cells: Table) -> dict[str, Any]:
    cycle = cells.numbers("cycle")[cells["region"] == "bounded limit cycle"]
    return {
        "points": {name: int((cells["region"] == name).sum()) for name in REGIONS},
        "agreement": float(np.mean(cells["region"] == predicted_regions(cells))),
        "measured_edges": _edges(cells),
        "predicted_edges": {"beta": 0.5, "sigma": 0.5},
        "largest_cycle_steps": float(cycle.max()) if cycle.size else None,
        "median_cycle_steps": float(np.median(cycle)) if cycle.size else None,
    }


def _friction(name: str, dampers: Table) -> dict[str, Any]:
    """Returns σ that a method needs at each B, measured twice and by theory."""
    predicted = friction_needed(name, dampers["damping"])
    shaken_needs = dampers.numbers("needed_shaken")
    return {
        "damping": dampers["damping"].tolist(),
        "predicted": predicted.tolist(),
        "shaken": shaken_needs.tolist(),
        "pressed": dampers.numbers("needed_at_rest").tolist(),
        "worst_ratio_error": float(np.abs(shaken_needs / predicted - 1).max()),
    }


def _of_regions(found: Mapping[str, Any]) -> str:
    if not found:
        return f"Regions over β and σ: {MISSING}."
    counts = ", ".join(f"{name} {count}" for name, count in found["points"].items())
    edges, largest = found["measured_edges"], found["largest_cycle_steps"]
    size = (
        "no bounded limit cycle was seen"
        if largest is None
        else f"in encoder steps, peak to peak, the largest bounded limit cycle is {largest:.0f}, "
        f"the median one {found['median_cycle_steps']:.0f}"
    )
    return (
        f"What the runs did agrees with Diolaiti's regions at {100 * found['agreement']:.0f} % of "
        f"the points: {counts}. Divergence ends at β = {_said(edges['beta'])}, and the pressed "
        f"device comes to rest from σ = {_said(edges['sigma'])} on (theory: both ½); {size}."
    )


def _of_friction(found: Mapping[str, Any]) -> str:
    if not found:
        return f"Friction against the damper: {MISSING}."
    error = max(SMALLEST, *(100 * mine["worst_ratio_error"] for mine in found.values()))
    needs = "; ".join(_needs_of(name, found.get(name)) for name in METHODS_SHOWN)
    return (
        "With a damper, a hand that shakes the device across one encoder step needs f_c = K Δ/2 + "
        f"B′ Δ/T within {error:.2g} %. That, and where one that only presses begins to let it "
        f"rest, at the values of B that were tried: {needs}."
    )


def _needs_of(name: str, mine: Mapping[str, Any] | None) -> str:
    if mine is None:
        return f"'{name}': {MISSING}"
    shaken_needs, pressed = mine["shaken"], mine["pressed"]
    return (
        f"'{name}' shaken {min(shaken_needs):.3g} to {max(shaken_needs):.3g} K Δ, pressed "
        f"{min(pressed):.3g} to {max(pressed):.3g} K Δ"
    )


def _said(edge: Mapping[str, float] | None) -> str:
    return "no value here" if edge is None else f"{edge['last']:.2f} to {edge['first']:.2f}"


def _edges(cells: Table) -> dict[str, Any]:
    """Returns between which β divergence ends, and between which σ motion from a press ends.

    None where no run was bad, or the largest value had a bad one.
    """
    return {
        "beta": _edge(cells["beta"], cells["large"] == "diverges"),
        "sigma": _edge(cells["sigma"], cells["small"] != "rest"),
    }


def _edge(values: NDArray[np.float64], is_bad: NDArray[np.bool_]) -> dict[str, float] | None:
    """Returns the ``last`` value with a bad run, and the ``first`` one from which none is bad."""
    if not is_bad.any() or not (values > values[is_bad].max()).any():
        return None
    last = float(values[is_bad].max())
    return {"last": last, "first": float(values[values > last].min())}


def predicted_regions(cells: Table) -> NDArray[np.object_]:
    """Returns Diolaiti's region at each row, from its β and σ."""
    coupling = Coupling(STIFFNESS, 0.0, 0.0, 0.0)
    return np.array(
        [
            quantization_limit(
                SimulatedDevice(
                    damping=float(b) * STIFFNESS * PERIOD,
                    friction=float(s) * QUANTUM,
                    resolution=RESOLUTION,
                ).info,
                coupling,
                PERIOD,
            ).region
            for b, s in zip(cells["beta"], cells["sigma"], strict=True)
        ],
        dtype=object,
    )


DEVICE = StabilityMap(
    name="device",
    about="encoder steps against Coulomb friction of the device: Diolaiti's four regions, measured",
    default_points=400,
    points=points,
    evaluate=evaluate,
    read=read,
)
