"""What the measured rule for contacts has to say against a setting, in words."""

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
"""Coefficient below which a pyramidal cone is called a risk, no unit. Measured once, not in the
map: with MuJoCo's default ``solref`` 0.96 of the slack at 0.42; a test has 1.5 times it at 0.1."""

SOFT_STEPS = 10.0
"""timeconst·dampratio/h beyond which a contact is called soft: 25 times softer than at 2 h, some
0.3 mm under 3 N on a 0.1 kg peg (computed), more than its clearance."""


def suggested_solref(timestep: float) -> str:
    """Returns the attribute that is strict at a time step in s: timeconst h/2, dampratio 8."""
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
    """Says what a contact setting risks, one clause each; nothing where it is as recommended.

    Args:
        solref: As ``contact_numbers`` takes it.
        solimp: Likewise.
        timestep: h in s.
        cone: Of friction; it matters for condim > 1 and a friction below 0.4 only.
        diagexact: Whether MuJoCo's exact diagonal is on; without it more runs of the map's shipped
            setting create energy.
        refsafe: As ``contact_numbers`` takes it.
        condim: Of the contact; 1 is without friction.
        friction: Coefficient of sliding.
        only_active: Leave out what is not likely to go beyond the slack.

    Returns:
        Clauses that go after "the contact of …": what is wrong, the risk, what to write instead.

    Raises:
        SceneError: As ``contact_numbers``.
    """
    numbers = contact_numbers(solref, solimp, timestep, refsafe=refsafe)
    # + 0.0: a negative zero would be printed as one
    steps, instead = numbers.relaxation + 0.0, suggested_solref(timestep)
    concerns = []
    if numbers.grade == "active" and numbers.is_too_stiff:
        concerns.append(
            f"is stiffer than was seen to stay passive (impedance {numbers.impedance:.3g}, "
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
            f'solref="{REFERENCE_STEPS * timestep:g} 1"; write {instead} unless that is meant'
        )
    return concerns
