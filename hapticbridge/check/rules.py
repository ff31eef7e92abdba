"""Rules by which a scene is judged."""

from __future__ import annotations

from hapticbridge.check.case import Case
from hapticbridge.check.constraint_faults import constraint_faults
from hapticbridge.check.contact_faults import contact_faults
from hapticbridge.check.faults import Fault
from hapticbridge.check.geometry_faults import geometry_faults
from hapticbridge.check.mass_faults import mass_faults
from hapticbridge.check.option_faults import keyframe_faults, option_faults
from hapticbridge.check.run_faults import run_faults
from hapticbridge.check.start_faults import margin_faults, start_faults

RULES = (
    option_faults,
    keyframe_faults,
    mass_faults,
    geometry_faults,
    start_faults,
    contact_faults,
    margin_faults,
    constraint_faults,
    run_faults,
)
"""Functions that yield the faults of one subject, in the best order for mending."""


def find_faults(case: Case) -> tuple[Fault, ...]:
    """Returns all faults of a scene from ``open_case``; the scene is reset."""
    return tuple(fault for rule in RULES for fault in rule(case))
