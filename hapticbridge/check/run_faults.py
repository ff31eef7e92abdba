"""Faults that only the motion shows."""

from __future__ import annotations

from collections.abc import Iterator

from hapticbridge.check.case import Case
from hapticbridge.check.faults import Fault, number

ITERATIONS = 100
"""MuJoCo's own limit on the solver's iterations; Newton's takes 1 to 8 in the shipped scenes."""


def run_faults(case: Case) -> Iterator[Fault]:
    """Yields what went wrong while the scene was led through its motion.

    Args:
        case: The scene under check.
    """
    seen, option = case.observation, case.places.option
    if seen is None:
        yield Fault(
            "motion not finished",
            option("timestep"),
            f"under {case.motion_name}: {case.motion_fault}",
            "what stands above, if anything; else a softer contact or a heavier tool",
        )
        return
    if seen.full_ticks:
        limit = int(case.model.opt.iterations)
        yield Fault(
            "solver iterations",
            option("iterations"),
            f"the solver stopped at its limit of {limit} iterations in {seen.full_ticks} of "
            f"{case.samples.size} ticks: contact forces are not what they should be",
            f'iterations="{max(ITERATIONS, 2 * limit)}"',
        )
    for words, count in seen.warnings.items():
        yield Fault(
            "MuJoCo warning",
            option("timestep"),
            f"MuJoCo warned {count} times in the motion: {words}",
            "see what it says",
        )
    if seen.environment != "strict":
        used = f"{number(100 * seen.slack_share)} % of the coupling's slack, which covers it"
        if seen.environment == "active":
            used = "more than the coupling's slack covers"
        yield Fault(
            "energy created",
            option("integrator"),
            f"contacts or joints created energy in the motion: {used}",
            "the contact settings named here; if none is, a heavier tool",
        )
