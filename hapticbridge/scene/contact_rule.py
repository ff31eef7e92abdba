"""Measured rule for contact settings that keep a scene passive.

Two numbers of a contact decide. MuJoCo's contact is a spring and a damper, scaled by the inertia at
the contact. With the time step h and ``solref`` as (timeconst, dampratio), or directly as (−k, −b),

    τ = 2 d_w timeconst dampratio²  or  d_w b/k          relaxation time in s,
    κ = d/(1 − d) (h/(timeconst dampratio))²             stiffness, in units of inertia/h².

d_w is the impedance from the width of ``solimp`` on, d the impedance at a depth of 0.1 mm, and
timeconst·dampratio = 1/√k. MuJoCo raises timeconst·dampratio to h under ``discrete`` unless flag
``refsafe`` is off. A contact that relaxes slowly stores little of a push and returns it too slowly
to matter. This is an interpretation of the measurements, not a proof:

    κ <= 4, τ >= 60 h max(1, κ/0.6)       strict: Σ E_k <= 0 throughout,
    κ <= 4, d <= 0.91, τ >= 30 h          within slack: less energy than the coupling's slack,
    κ <= 4, d <= 0.91, τ >= 3.8 h         within slack for tools of 0.1 kg and more; pegs of
                                          30 g used up to 1.4 times the slack.

All other settings count as active: they may generate more energy than the slack allows. This is a
warning; many such runs stayed within the slack.

The map ``contact`` measures the rule on a peg in its hole: 30 to 300 g, K of 1000 and 6000 N/m,
friction 0 and 0.42, recorded and random hands with up to 30 N. It uses integrator ``discrete`` with
the elliptic cone at 1 kHz, draws the lines, and counts the differences between rule and runs.

The pyramidal cone is worse the lower the friction is. With MuJoCo's defaults otherwise, pegs
generated up to 8.1 times the slack (16 of 36 runs of the map active).

A single contact is less critical: a mass on a wall stays within the slack at nearly every setting.
Beyond the measured range (other shapes, lighter tools, stiffer couplings, other periods) the rule
is a guide and the energy meter decides. Under ``implicitfast`` hardly any setting is strict.

Damping a contact costs time: the deflection after a strong push decays as exp(−t/τ). A steady force
penetrates (timeconst dampratio/2h)² times as deep as in the shipped scenes, for any τ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from hapticbridge.errors import SceneError

STRICT_STEPS = 60.0
"""τ/h above which a contact of moderate stiffness generated no energy in any run of the map (its
row "damped": τ = 60.8 h)."""

MODERATE_STIFFNESS = 0.6
"""Largest κ for which ``STRICT_STEPS`` suffices: timeconst·dampratio >= 4 h at d = 0.9. Stiffer
contacts require τ in proportion: at κ = 2.3 the map's τ = 30 h generated energy, its 380 h none."""

STIFFEST = 4.0
"""Largest κ that the rule covers; the map's rows at 2.3 agree with the rule."""

LARGEST_IMPEDANCE = 0.91
"""Largest d for which the slack conditions hold, without unit: 0.9 as shipped, for any increase
within 1 mm. At 0.95 throughout, tools of 0.1 kg used 1.07 of the slack at κ = 1.2 and τ = 15 h. At
0.99 they used 1.4 at κ = 1.5 and τ = 32 h. The strict condition still held there (timeconst 4 h,
dampratio 8)."""

SHALLOW = 1e-4
"""Depth in m at which the impedance is taken: a push begins there, and most of it is felt there."""

SLACK_STEPS = 30.0
"""τ/h above which no run of the map exceeded the slack, for tools down to 30 g. At 15 h and κ = 2.3
two of 36 runs exceeded it, both with 30 g."""

HEAVY_SLACK_STEPS = 3.8
"""τ/h above which no run of the map exceeded the slack, for tools of 0.1 kg and more: the shipped
scenes' setting."""

REFERENCE_STEPS = 2.0
"""timeconst·dampratio/h of the shipped scenes, the reference for softness."""

SUGGESTED = (0.5, 8.0)
"""timeconst/h and dampratio of the least damped strict setting: τ = 60.8 h, κ = 0.57."""

MUJOCO_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
"""MuJoCo's defaults for missing values of a ``solimp``: d₀, d_w, width in m, midpoint, power."""

ROUNDING = 1e-9
"""Relative difference that counts as rounding, without unit: 2·0.002·1 must equal 4·0.001."""

Grade = Literal["strict", "within slack", "active"]


@dataclass(frozen=True, slots=True)
class ContactNumbers:
    """Numbers of a contact's setting that the rule uses, without unit, in time steps.

    Attributes:
        resolved: timeconst·dampratio/h = 1/(h √k), >= 1 unless ``refsafe`` is off. The static depth
            grows with its square.
        relaxation: τ/h.
        stiffness: κ.
        impedance: d at a depth of 0.1 mm.
    """

    resolved: float
    relaxation: float
    stiffness: float
    impedance: float

    @property
    def grade(self) -> Grade:
        """Expected verdict on the environment for tools of 0.1 kg and more."""
        return self._grade(HEAVY_SLACK_STEPS)

    @property
    def light_grade(self) -> Grade:
        """Expected verdict on the environment for tools down to 30 g."""
        return self._grade(SLACK_STEPS)

    @property
    def is_too_stiff(self) -> bool:
        """True if κ or d exceeds the range that stayed within the slack, at any τ."""
        return max(self.stiffness / STIFFEST, self.impedance / LARGEST_IMPEDANCE) > 1 + ROUNDING

    @property
    def softness(self) -> float:
        """Depth under a static force relative to the shipped scenes, without unit."""
        return (self.resolved / REFERENCE_STEPS) ** 2

    def _grade(self, slack_steps: float) -> Grade:
        strict_steps = STRICT_STEPS * max(1.0, self.stiffness / MODERATE_STIFFNESS)
        relaxation = self.relaxation * (1 + ROUNDING)
        if self.stiffness <= STIFFEST * (1 + ROUNDING) and relaxation >= strict_steps:
            return "strict"
        return "active" if self.is_too_stiff or relaxation < slack_steps else "within slack"


def contact_numbers(
    solref: Sequence[float],
    solimp: Sequence[float],
    timestep: float,
    *,
    refsafe: bool = True,
) -> ContactNumbers:
    """Returns the numbers of a contact setting that the rule uses.

    Args:
        solref: (timeconst in s, dampratio), or (−stiffness in 1/s², −damping in 1/s).
        solimp: MuJoCo's d₀, d_w, width in m, midpoint, power; trailing values may be left out.
        timestep: h in s, > 0: MuJoCo's, that is the period divided by the substeps.
        refsafe: True if MuJoCo raises a time constant that the step cannot resolve.

    Raises:
        SceneError: A number is not finite, the time step is not > 0, or a sequence is too short.
    """
    values = [*solref, *solimp, timestep]
    if len(solref) < 2 or len(solimp) < 1 or not all(map(math.isfinite, values)) or timestep <= 0:
        raise SceneError(
            f"solref {list(solref)}, solimp {list(solimp)} and time step {timestep!r} s: a contact "
            "needs two numbers in solref, at least one in solimp and a time step > 0, all finite"
        )
    impedance, last = impedance_at(solimp, SHALLOW), impedance_at(solimp, math.inf)
    first, second = float(solref[0]), float(solref[1])
    if first > 0 and second > 0:
        resolved, ratio = first * second / timestep, second
    else:
        stiffness, damping = max(-first, 0.0), max(-second, 0.0)
        if stiffness == 0:
            # without stiffness nothing is stored, and the contact never stops sinking
            return ContactNumbers(math.inf, math.inf if damping > 0 else 0.0, 0.0, impedance)
        resolved = 1 / (timestep * math.sqrt(stiffness))
        ratio = damping / (2 * math.sqrt(stiffness))
    if refsafe:
        resolved = max(resolved, 1.0)
    stiffness = impedance / (1 - impedance) / resolved**2
    return ContactNumbers(resolved, 2 * last * resolved * ratio, stiffness, impedance)


def impedance_at(solimp: Sequence[float], depth: float) -> float:
    """Returns the impedance d at a depth by MuJoCo's formula, without unit.

    Args:
        solimp: MuJoCo's d₀, d_w, width in m, midpoint, power; trailing values may be left out.
        depth: Depth in m, >= 0; infinity for d_w.
    """
    values = (*map(float, solimp), *MUJOCO_SOLIMP[len(solimp) :])
    # between mjMINIMP and mjMAXIMP
    start, last, middle = (min(max(values[i], 1e-4), 0.9999) for i in (0, 1, 3))
    width, power = values[2], max(values[4], 1.0)
    share = min(depth / width, 1.0) if width > 0 else 1.0
    if share <= middle:
        rise = share**power / middle ** (power - 1)
    else:
        rise = 1 - (1 - share) ** power / (1 - middle) ** (power - 1)
    return float(start + rise * (last - start))
