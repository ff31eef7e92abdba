"""Which contact settings keep a scene passive: a rule that was measured, as data and in words.

Two numbers of a contact decide. MuJoCo's contact is a spring and a damper, scaled by the inertia
at the contact. With h the time step, in the format (timeconst, dampratio), or (−k, −b) directly,

    τ = b/k = 2 timeconst dampratio²                     relaxation time in s,
    κ = d₀/(1 − d₀) (h/(timeconst dampratio))²           stiffness, in units of inertia/h²,

where timeconst·dampratio = 1/√k, and is raised to h, as MuJoCo itself does under ``discrete``
(flag ``refsafe``), at the same dampratio. A contact that relaxes slowly stores little of a push and
gives it back too slowly to matter; this is a reading of what was measured, not a proof:

    τ >= 64 h max(1, κ/0.6), κ <= 4    strict: Σ E_k <= 0 throughout,
    τ >= 16 h                          within slack: less is created than the coupling's slack,
    τ >= 4 h                           within slack for tools of 0.1 kg and more; 30 g without
                                       friction used up to 1.3 times the slack,
    τ < 4 h                            active: creates more than the slack allows.

Measured on the peg in its hole (tools of 30 to 300 g, K of 1000 to 6000 N/m, friction 0 and 0.42,
recorded and random hands with up to 36 N) under integrator ``discrete``, elliptic cone, periods of
0.5 to 2 ms: the map ``contact`` measures it again and draws these lines on top.

The pyramidal cone is worse the lower the friction is. With all of MuJoCo's defaults pegs of 30 and
100 g created up to 8.7 times the slack at friction 0 and 0.1 (20 of 24 runs active), used 0.96 of
it at 0.42, and created nothing at 1; with τ = 64 h they used up to 1.1, 0.2, none and none of it.

One contact alone is kinder: a mass on a wall stays within the slack at nearly every setting. Beyond
what was measured (other shapes, lighter tools, stiffer couplings) the rule is a guide and the meter
decides. Under ``implicitfast`` next to no setting is strict.

A damped contact is paid for in time: what a strong push left comes back as exp(−t/τ). A steady
force sinks in (timeconst dampratio/2h)² times as deep as in the shipped scenes, whatever τ is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from hapticbridge.errors import SceneError

STRICT_STEPS = 64.0
"""τ/h from which a contact of moderate stiffness created nothing in 60 of 60 runs; 36 left 2."""

MODERATE_STIFFNESS = 0.6
"""κ up to which ``STRICT_STEPS`` suffices: timeconst·dampratio >= 4 h at d₀ = 0.9. Stiffer contacts
need τ in proportion: at κ = 2.25 and τ = 80 h 2 of 60 runs created energy, at 400 h none."""

STIFFEST = 4.0
"""κ of the stiffest contact seen strict; at 9 and τ = 960 h 2 of 48 runs created energy."""

SLACK_STEPS = 16.0
"""τ/h from which no run went beyond the slack, down to tools of 30 g; at 9 h 1 of 36 did, and of
settings at 12 and 13 h 3 too."""

HEAVY_SLACK_STEPS = 4.0
"""The same for tools of 0.1 kg and more: the shipped scenes' setting."""

LOW_FRICTION = 0.4
"""Coefficient below which a pyramidal cone is a risk: 0.42 stayed within the slack, 0.1 did not."""

SOFT_STEPS = 10.0
"""timeconst·dampratio/h beyond which a contact is called soft: 25 times softer than at 2 h, some
0.3 mm under 3 N on a 0.1 kg peg, more than its clearance."""

REFERENCE_STEPS = 2.0
"""timeconst·dampratio/h of the shipped scenes, to which softness is compared."""

SUGGESTED = (0.5, 8.0)
"""timeconst/h and dampratio of the softest damping that is strict: τ = 64 h, κ = 0.56."""

ROUNDING = 1e-9
"""Relative: 2·0.002·1 is 4·0.001 but for rounding."""

Grade = Literal["strict", "within slack", "active"]


@dataclass(frozen=True, slots=True)
class ContactNumbers:
    """A contact's setting as the rule sees it, without unit, in time steps.

    Attributes:
        resolved: timeconst·dampratio/h = 1/(h √k), >= 1: its static depth grows with the square.
        relaxation: τ/h.
        stiffness: κ.
    """

    resolved: float
    relaxation: float
    stiffness: float

    @property
    def grade(self) -> Grade:
        """What the environment is expected to be with tools of 0.1 kg and more."""
        needed = STRICT_STEPS * max(1.0, self.stiffness / MODERATE_STIFFNESS)
        is_resolved = self.stiffness <= STIFFEST * (1 + ROUNDING)
        if is_resolved and self.relaxation >= needed * (1 - ROUNDING):
            return "strict"
        if self.relaxation >= HEAVY_SLACK_STEPS * (1 - ROUNDING):
            return "within slack"
        return "active"

    @property
    def softness(self) -> float:
        """How much deeper a static force goes than in the shipped scenes, as a factor."""
        return (self.resolved / REFERENCE_STEPS) ** 2


def contact_numbers(
    solref: Sequence[float], solimp: Sequence[float], timestep: float
) -> ContactNumbers:
    """Returns the numbers of a contact setting that the rule is about.

    Args:
        solref: (timeconst in s, dampratio), or (−stiffness in 1/s², −damping in 1/s).
        solimp: MuJoCo's; only d₀, the impedance at the surface, counts.
        timestep: h in s, > 0: MuJoCo's, so the period over the substeps.

    Raises:
        SceneError: A number is not finite, the time step is not > 0, or a sequence is too short.
    """
    values = [*solref, *solimp, timestep]
    if len(solref) < 2 or len(solimp) < 1 or not all(map(math.isfinite, values)) or timestep <= 0:
        raise SceneError(
            f"solref {list(solref)}, solimp {list(solimp)} and time step {timestep!r} s: a contact "
            "needs two numbers, at least one, and a time step > 0, all finite"
        )
    first, second = float(solref[0]), float(solref[1])
    if first > 0 and second > 0:
        resolved, ratio = first * second / timestep, second
    else:
        stiffness, damping = max(-first, 0.0), max(-second, 0.0)
        if stiffness == 0:
            # nothing pushes back out, so nothing is stored; it never stops sinking either
            return ContactNumbers(math.inf, math.inf if damping > 0 else 0.0, 0.0)
        resolved = 1 / (timestep * math.sqrt(stiffness))
        ratio = damping / (2 * math.sqrt(stiffness))
    resolved = max(resolved, 1.0)
    # MuJoCo keeps the impedance between mjMINIMP and mjMAXIMP
    impedance = min(max(float(solimp[0]), 1e-4), 0.9999)
    return ContactNumbers(resolved, 2 * resolved * ratio, impedance / (1 - impedance) / resolved**2)


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
        diagexact: Whether MuJoCo's exact diagonal is on; without it 14 of 36 runs were strict
            instead of 20 at τ = 4 h, and all at τ = 120 h.
        condim: Of the contact; 1 is without friction.
        friction: Coefficient of sliding.
        only_active: Leave out what is not likely to go beyond the slack.

    Returns:
        Clauses that go after "the contact of …": what is wrong, the risk, what to write instead.

    Raises:
        SceneError: As ``contact_numbers``.
    """
    numbers = contact_numbers(solref, solimp, timestep)
    steps, instead = numbers.relaxation, suggested_solref(timestep)
    concerns = []
    if numbers.grade == "active":
        concerns.append(
            f"relaxes within {steps:.2g} time steps (2 timeconst dampratio²) and may create more "
            f"energy than the coupling's slack allows; write {instead}, or at least a relaxation "
            f"of {HEAVY_SLACK_STEPS:g} steps"
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
