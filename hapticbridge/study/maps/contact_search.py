"""The search of the map ``contact``: which treatment of the peg's contact is strict at 1 kHz."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hapticbridge.study.maps.contact_bars import Columns, draw_bars
from hapticbridge.study.maps.contact_rigs import peg_runs, summary
from hapticbridge.study.maps.contact_treatments import TREATMENTS
from hapticbridge.study.table import Table

SEARCH_MASSES = (0.03, 0.1, 0.3)
"""In kg."""

SEARCH_STIFFNESS = (1000.0, 6000.0)
"""K in N/m."""

SEARCH_HANDS = (0, 1, 2)
"""The recorded one and two seeds."""

FRICTION = (0.0, 0.42)


def search(name: str, mass: float) -> dict[str, float | int]:
    """Runs a peg of a mass in kg in one treatment, by K, friction and hand."""
    cases = list(itertools.product([mass], FRICTION, SEARCH_HANDS))
    treatment = TREATMENTS[name]
    return summary([run for k in SEARCH_STIFFNESS for run in peg_runs(treatment, k, cases)])


def searched(table: Table, name: str) -> dict[str, Any]:
    """Returns what one treatment came to in a table of the map, over all tools."""
    mine = table.select(table["treatment"] == name)
    treatment = TREATMENTS[name]
    return {
        "treatment": name,
        "relaxation": treatment.relaxation,
        "static_depth": treatment.static_depth,
        "runs": int(mine["runs"].sum()),
        "strict": int(mine["strict"].sum()),
        "within_slack": int(mine["within_slack"].sum()),
        "active": int(mine["active"].sum()),
        "created": float(mine["created"].max()),
        "slack_share": float(mine["slack_share"].max()),
        "median_depth": float(np.median(mine["median_depth"])),
        "largest_depth": float(mine["largest_depth"].max()),
    }


COLUMNS: Columns = (
    ("most energy\nmade, J", 0.34, "created", 1.0, ".1e"),
    ("depth, mm:\nmedian", 0.66, "median_depth", 1e3, ".2f"),
    ("\nlargest", 0.9, "largest_depth", 1e3, ".2f"),
    ("steady depth,\n× shipped", 1.28, "static_depth", 1.0, ".3g"),
    ("\nτ, ms", 1.5, "relaxation", 1e3, ".3g"),
)
"""Beside the bars. The steady depth is computed, the others are measured."""


def draw_search(axes: Axes, found: Sequence[Mapping[str, Any]]) -> None:
    """Draws a bar a treatment, runs by verdict, with what they came to in columns beside it."""
    draw_bars(axes, found, [one["treatment"] for one in found], COLUMNS)
