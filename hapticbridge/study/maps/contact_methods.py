"""The methods on the contact as shipped, in the map ``contact``: the same hands for each."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.rendering import METHODS
from hapticbridge.study.maps.contact_bars import Columns, draw_bars
from hapticbridge.study.maps.contact_hands import random_push, random_taps, recorded
from hapticbridge.study.maps.contact_rigs import (
    PEG_ROTATION,
    ContactRun,
    deepest,
    firm_device,
    run_once,
    set_mass,
    summary,
    ticks_of,
)
from hapticbridge.study.maps.contact_search import FRICTION, SEARCH_MASSES, SEARCH_STIFFNESS
from hapticbridge.study.maps.contact_treatments import PERIOD, Treatment
from hapticbridge.study.maps.rigs import loop_in
from hapticbridge.study.table import Table

COMPARED = ("implicit", "compensated", "lossless")
"""The methods that are passive behind the coupling. They differ away from contact, and in the
damping of their law: so the hands here come and go."""

HANDS = 20
"""A rig. At the mouth the first is the recorded one, the others are seeds."""

FELT_DAMPING = 1.25
"""B over K T, no unit: more than 1, so that every method has some of its law left (B > K T)."""

MOUTH = 0.0275
"""Height of the peg's centre at the start in m, 2.5 mm of it in the hole: where the recorded hand
is when its part begins, and where a random one goes in and out."""

RIGS = ("taps", "mouth")

Case = tuple[float, float, float, int]
"""K in N/m, tool mass in kg, friction and hand."""


def method_points() -> list[tuple[str, str, float]]:
    """Returns rig, method and tool mass in kg of every comparison."""
    return list(itertools.product(RIGS, COMPARED, SEARCH_MASSES))


def cases_of(rig: str, mass: float) -> list[Case]:
    """Returns what each method is run through on a rig with a tool mass in kg."""
    friction = FRICTION if rig == "mouth" else (0.0,)
    return list(itertools.product(SEARCH_STIFFNESS, [mass], friction, range(HANDS)))


def compared(rig: str, method: str, mass: float) -> dict[str, float | int]:
    """Runs a tool of a mass in kg on a rig by a method, by K, friction and hand."""
    return summary(list(method_runs(rig, method, cases_of(rig, mass))))


def method_runs(
    rig: str, method: str, cases: Iterable[Case], *, same_law: bool = False
) -> Iterator[ContactRun]:
    """Runs a method through cases; ``taps`` are on a wall, ``mouth`` is in and out of a hole.

    Args:
        rig: One of ``RIGS``.
        method: Its name.
        cases: What to run it through.
        same_law: Whether it is asked for what gives it the K and B' that ``lossless`` uses, which
            need the same device. By default all methods are asked for the same K and B.
    """
    treatment = Treatment(method=method)
    for stiffness, mass, friction, hand in cases:
        damping, turning = FELT_DAMPING * stiffness * PERIOD, PEG_ROTATION[0] * stiffness
        felt = Coupling(stiffness, damping, turning, FELT_DAMPING * turning * PERIOD)
        coupling = felt
        if same_law:
            law = METHODS["lossless"].used(felt, PERIOD)
            coupling = METHODS[method].rendered(law, PERIOD)
        if rig == "taps":
            loop = loop_in("virtual_wall", "contact")
            path, holder = random_taps(hand)
        else:
            loop = loop_in("peg_in_hole", "mouth", _start_at_mouth)
            path, holder = recorded() if hand == 0 else random_push(hand)
        treatment.apply(loop.scene.model, friction)
        set_mass(loop, "tool" if rig == "taps" else "peg", mass)
        device = firm_device(felt, path, holder)
        records, run = run_once(loop, device, coupling, treatment, ticks_of(device))
        yield replace(run, depth=deepest(loop, records) if rig == "mouth" else _behind(records))


def _start_at_mouth(model: mujoco.MjModel) -> None:
    model.key_qpos[0, 2] = MOUTH


def _behind(records: NDArray[np.void]) -> float:
    # the face is 10 mm from where the tool's surface starts
    return max(0.0, float(records["tool_position"][:, 0].max()) - 0.01)


def methods_found(table: Table) -> list[dict[str, Any]]:
    """Returns what each method came to on each rig in a table of the map, over all tools."""
    found = []
    for rig, method in itertools.product(RIGS, COMPARED):
        mine = table.select((table["rig"] == rig) & (table["method"] == method))
        if len(mine):
            counts = ("runs", "strict", "within_slack", "active")
            worst = ("created", "slack_share", "peak_force", "largest_depth")
            found.append(
                {
                    "rig": rig,
                    "method": method,
                    **{name: int(mine[name].sum()) for name in counts},
                    **{name: float(mine[name].max()) for name in worst},
                    "median_depth": float(np.median(mine["median_depth"])),
                }
            )
    return found


def of_methods(found: Sequence[Mapping[str, Any]]) -> str:
    """Says what the methods came to, in a sentence a rig; nothing where none was computed."""
    said = []
    words = {"taps": "tapping on a wall", "mouth": "in and out of the hole"}
    for rig, doing in words.items():
        mine = [one for one in found if one["rig"] == rig]
        if mine:
            parts = [
                f"'{one['method']}' is strict in {one['strict']} of {one['runs']} runs, active in "
                f"{one['active']}, makes {1e3 * one['created']:.2g} mJ at most"
                for one in mine
            ]
            said.append(f"{HANDS} hands {doing}, as shipped: {'; '.join(parts)}.")
    return " ".join(said)


COLUMNS: Columns = (
    ("most energy\nmade, J", 0.34, "created", 1.0, ".1e"),
    ("slack\nused", 0.56, "slack_share", 1.0, ".2f"),
    ("peak\nforce, N", 0.84, "peak_force", 1.0, ".1f"),
    ("depth, mm:\nmedian", 1.2, "median_depth", 1e3, ".2f"),
    ("\nlargest", 1.5, "largest_depth", 1e3, ".2f"),
)
"""Beside the bars: the largest of all runs, but for the median."""


def draw_methods(axes: Axes, found: Sequence[Mapping[str, Any]]) -> None:
    """Draws a bar a rig and method, runs by verdict, with what they came to beside it."""
    names = [f"{one['method']}, {one['rig']}" for one in found]
    draw_bars(axes, found, names, COLUMNS)
