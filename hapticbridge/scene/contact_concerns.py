"""Concerns about a contact's setting, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from hapticbridge.scene.contact_rule import (
    HEAVY_SLACK_STEPS,
    LARGEST_IMPEDANCE,
    REFERENCE_STEPS,
    ROUNDING,
    STIFFEST,
    SUGGESTED,
    contact_numbers,
)

LOW_FRICTION = 0.4
"""Coefficient of sliding, without unit, below which a pyramidal cone counts as a risk. Measured
apart from the map: with MuJoCo's default ``solref`` 0.96 of the slack was used at 0.42. A test uses
1.5 times the slack at 0.1."""

SOFT_STEPS = 10.0
"""timeconst·dampratio/h above which a contact counts as soft. It is then 25 times softer than at 2
h: some 0.3 mm under 3 N on a peg of 0.1 kg (computed), more than its clearance."""


def suggested_solref(timestep: float) -> str:
    """Returns the strict ``solref`` for a time step in s: timeconst h/2, dampratio 8."""
    return f'solref="{SUGGESTED[0] * timestep:g} {SUGGESTED[1]:g}"'


def contact_concerns(
    solref: Sequence[float],
    solimp: Sequence[float],
    timestep: float,
    *,
    cone: Literal["elliptic", "pyramidal"] = "elliptic",
    diagexact: bool = True,
    refsafe: bool = True,
    condim: int = 3,
    friction: float = 1.0,
    only_active: bool = False,
) -> list[str]:
    """Returns the risks of a contact setting, one clause each; empty for a recommended setting.

    Args:
        solref: As for ``contact_numbers``, which raises the errors.
        solimp: As for ``contact_numbers``.
        timestep: h in s.
        cone: Friction cone; it matters only for condim > 1 and a friction below 0.4.
        diagexact: True if MuJoCo's exact diagonal is enabled. Without it more runs of the map's
            shipped setting generate energy.
        refsafe: As for ``contact_numbers``.
        condim: Dimension of the contact; 1 is without friction.
        friction: Coefficient of sliding.
        only_active: If true, only risks that are likely to exceed the slack are returned.

    Returns:
        Clauses that follow "the contact of …": the fault, the risk, and what to write instead.
    """
    numbers = contact_numbers(solref, solimp, timestep, refsafe=refsafe)
    # + 0.0 turns a negative zero into 0
    steps, instead = numbers.relaxation + 0.0, suggested_solref(timestep)
    concerns = []
    if numbers.grade == "active" and numbers.is_too_stiff:
        concerns.append(
            f"is stiffer than any that stayed passive in tests (impedance {numbers.impedance:.3g}, "
            f"stiffness {numbers.stiffness:.3g} inertia/step²; at most {LARGEST_IMPEDANCE:g} and "
            f"{STIFFEST:g}) and may create more energy than the coupling's slack allows; write "
            f'{instead} and solimp="0.9 0.95 0.001"'
        )
    elif numbers.grade == "active":
        concerns.append(
            f"relaxes within {steps:.2g} time steps (2 d_w timeconst dampratio²) and may create "
            f"more energy than the coupling's slack allows; write {instead}, or at least a "
            f"relaxation of {HEAVY_SLACK_STEPS:g} steps"
        )
    if cone == "pyramidal" and condim > 1 and friction < LOW_FRICTION:
        concerns.append(
            f"has a pyramidal cone and a friction of {friction:g}, below {LOW_FRICTION:g}, and may "
            "create several times the energy that the coupling's slack allows; write "
            'cone="elliptic" in <option>, or condim="1" for no friction'
        )
    if only_active:
        return concerns
    if numbers.grade != "strict" and not diagexact:
        concerns.append(
            "is solved with MuJoCo's approximate diagonal, with which more runs created energy; "
            'write <flag diagexact="enable"/> in <option>'
        )
    if numbers.resolved > SOFT_STEPS * (1 + ROUNDING):
        concerns.append(
            f"is soft: a steady force sinks in {numbers.softness:.3g} times as deep as with "
            f'solref="{REFERENCE_STEPS * timestep:g} 1"; write {instead} unless this is intended'
        )
    return concerns
