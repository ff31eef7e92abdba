"""Where the map ``contact`` and the rule for contacts agree, and where they do not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.scene.contacts import (
    HEAVY_SLACK_STEPS,
    SLACK_STEPS,
    STRICT_STEPS,
    ContactNumbers,
    contact_numbers,
)
from hapticbridge.study.maps.contact_treatments import PERIOD, SHIPPED_SOLIMP, TREATMENTS
from hapticbridge.study.maps.verdicts import VERDICTS
from hapticbridge.study.table import Table

HEAVY = 0.1
"""Tool mass in kg from which the rule's line for heavier tools counts."""

LINES = (
    ("strict", "-", f"rule: strict above (τ = {STRICT_STEPS:g} T or more)"),
    ("relaxed", "--", f"within slack above (τ = {SLACK_STEPS:g} T)"),
    ("heavy", ":", f"the same from 0.1 kg (τ = {HEAVY_SLACK_STEPS:g} T)"),
)
"""Regions of the rule: name, line style and words."""


def is_in(region: str, numbers: ContactNumbers) -> bool:
    """Tells whether the rule has a setting in a region; ``abrupt`` is where it promises nothing."""
    if region == "strict":
        return numbers.grade == "strict"
    if region == "relaxed":
        return numbers.light_grade != "active"
    return (numbers.grade == "active") == (region == "abrupt")


def verdicts(table: Table) -> NDArray[np.int64]:
    """Returns the worst verdict of each row, by its place in ``VERDICTS``."""
    return np.where(table["active"] > 0, 2, np.where(table["within_slack"] > 0, 1, 0))


def agreement(table: Table) -> dict[str, Any]:
    """Counts, on the peg's grid, what the rule says against what was measured."""
    mine = table.select(table["rig"] == "peg")
    numbers = [
        contact_numbers((s * PERIOD, d), SHIPPED_SOLIMP, PERIOD)
        for s, d in zip(mine["steps"], mine["dampratio"], strict=True)
    ]
    measured = verdicts(mine)
    regions = {
        name: np.array([is_in(name, n) for n in numbers], dtype=bool)
        for name in ("strict", "relaxed", "abrupt")
    }
    return {
        name: {
            "cells": int(cells.sum()),
            **{
                verdict.replace(" ", "_"): int((measured[cells] == place).sum())
                for place, verdict in enumerate(VERDICTS[:3])
            },
        }
        for name, cells in regions.items()
    }


def exceptions(table: Table) -> list[dict[str, Any]]:
    """Returns where the search was worse than the rule says, by treatment and tool mass in kg."""
    found = []
    for name, treatment in TREATMENTS.items():
        mine = table.select(table["treatment"] == name)
        for mass, verdict in zip(mine["mass"].tolist(), verdicts(mine).tolist(), strict=True):
            numbers = treatment.numbers
            grade = numbers.grade if mass >= HEAVY else numbers.light_grade
            if treatment.is_ruled and verdict > VERDICTS.index(grade):
                worse = {"treatment": name, "mass": mass, "rule": grade}
                found.append({**worse, "measured": VERDICTS[verdict]})
    return found
