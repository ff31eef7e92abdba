"""Which contact settings keep a scene passive: a rule that was measured, as data and in words.

Two numbers of a contact decide. MuJoCo's contact is a spring and a damper, scaled by the inertia
at the contact. With h the time step, in the format (timeconst, dampratio), or (−k, −b) directly,

    τ = 2 d_w timeconst dampratio²  or  d_w b/k          relaxation time in s,
    κ = d/(1 − d) (h/(timeconst dampratio))²             stiffness, in units of inertia/h²,

with d_w the impedance from the width of ``solimp`` on, d the impedance at a depth of 0.1 mm, and
timeconst·dampratio = 1/√k, raised to h as MuJoCo itself does under ``discrete`` unless flag
``refsafe`` is off. A contact that relaxes slowly stores little of a push and gives it back too
slowly to matter; this is a reading of what was measured, not a proof:

    κ <= 4, τ >= 60 h max(1, κ/0.6)       strict: Σ E_k <= 0 throughout,
    κ <= 4, d <= 0.91, τ >= 30 h          within slack: less is created than the coupling's slack,
    κ <= 4, d <= 0.91, τ >= 3.8 h         within slack for tools of 0.1 kg and more; with pegs of
                                          30 g up to 1.4 times the slack was used,

and all else is called active: it may create more than the slack allows. That is a warning, many
such runs stayed within it.

The map ``contact`` measures this on a peg in its hole (30 to 300 g, K of 1000 and 6000 N/m,
friction 0 and 0.42, recorded and random hands with up to 30 N) under integrator ``discrete`` with
the elliptic cone at 1 kHz, draws the lines on top, and counts where rule and runs differ.

The pyramidal cone is worse the lower the friction is. With MuJoCo's defaults for the rest, pegs
created up to 8.1 times the slack (16 of 36 runs of the map active).

One contact alone is kinder: a mass on a wall stays within the slack at nearly every setting. Beyond
what was measured (other shapes, lighter tools, stiffer couplings, other periods) the rule is a
guide and the meter decides. Under ``implicitfast`` next to no setting is strict.

A damped contact is paid for in time: what a strong push left comes back as exp(−t/τ). A steady
force sinks in (timeconst dampratio/2h)² times as deep as in the shipped scenes, whatever τ is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from hapticbridge.errors import SceneError

STRICT_STEPS = 60.0
"""τ/h from which a contact of moderate stiffness created nothing in any run of the map (its row
"damped": τ = 60.8 h)."""

MODERATE_STIFFNESS = 0.6
"""κ up to which ``STRICT_STEPS`` suffices: timeconst·dampratio >= 4 h at d = 0.9. Stiffer contacts
need τ in proportion: at κ = 2.3 the map's τ = 30 h created energy, its 380 h none."""

STIFFEST = 4.0
"""κ of the stiffest contact that is promised anything; the map's rows at 2.3 are as said."""

LARGEST_IMPEDANCE = 0.91
"""d up to which the lines of the slack hold, no unit: 0.9 as shipped, whatever it rises to within
1 mm. At 0.95 throughout tools of 0.1 kg used 1.07 of the slack at κ = 1.2 and τ = 15 h; at 0.99
1.4 at κ = 1.5 and τ = 32 h; the line of strict runs held there (timeconst 4 h, dampratio 8)."""

SHALLOW = 1e-4
"""Depth in m at which the impedance counts: where a push begins and most of it is felt."""

SLACK_STEPS = 30.0
"""τ/h from which no run of the map went beyond the slack, down to tools of 30 g; at 15 h and
κ = 2.3 two of 36 did, all of them 30 g."""

HEAVY_SLACK_STEPS = 3.8
"""The same for tools of 0.1 kg and more: the shipped scenes' setting."""

REFERENCE_STEPS = 2.0
"""timeconst·dampratio/h of the shipped scenes, to which softness is compared."""

SUGGESTED = (0.5, 8.0)
"""timeconst/h and dampratio of the softest damping that is strict: τ = 60.8 h, κ = 0.57."""

MUJOCO_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
"""MuJoCo's defaults for what a ``solimp`` leaves out: d₀, d_w, width in m, midpoint, power."""

ROUNDING = 1e-9
"""Relative: 2·0.002·1 is 4·0.001 but for rounding."""

Grade = Literal["strict", "within slack", "active"]


@dataclass(frozen=True, slots=True)
class ContactNumbers:
    """A contact's setting as the rule sees it, without unit, in time steps.

    Attributes:
        resolved: timeconst·dampratio/h = 1/(h √k), >= 1 unless ``refsafe`` is off: its static
            depth grows with the square.
        relaxation: τ/h.
        stiffness: κ.
        impedance: d, 0.1 mm deep.
    """

    resolved: float
    relaxation: float
    stiffness: float
    impedance: float

    @property
    def grade(self) -> Grade:
        """What the environment is expected to be with tools of 0.1 kg and more."""
        return self._grade(HEAVY_SLACK_STEPS)

    @property
    def light_grade(self) -> Grade:
        """The same with tools down to 30 g."""
        return self._grade(SLACK_STEPS)

    @property
    def is_too_stiff(self) -> bool:
        """Whether κ or d are beyond what was seen to stay within the slack at any τ."""
        return max(self.stiffness / STIFFEST, self.impedance / LARGEST_IMPEDANCE) > 1 + ROUNDING

    @property
    def softness(self) -> float:
        """How much deeper a static force goes than in the shipped scenes, as a factor."""
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
    """Returns the numbers of a contact setting that the rule is about.

    Args:
        solref: (timeconst in s, dampratio), or (−stiffness in 1/s², −damping in 1/s).
        solimp: MuJoCo's d₀, d_w, width in m, midpoint, power; the last may be left out.
        timestep: h in s, > 0: MuJoCo's, so the period over the substeps.
        refsafe: Whether MuJoCo raises what the step cannot resolve.

    Raises:
        SceneError: A number is not finite, the time step is not > 0, or a sequence is too short.
    """
    values = [*solref, *solimp, timestep]
    if len(solref) < 2 or len(solimp) < 1 or not all(map(math.isfinite, values)) or timestep <= 0:
        raise SceneError(
            f"solref {list(solref)}, solimp {list(solimp)} and time step {timestep!r} s: a contact "
            "needs two numbers, at least one, and a time step > 0, all finite"
        )
    impedance, last = impedance_at(solimp, SHALLOW), impedance_at(solimp, math.inf)
    first, second = float(solref[0]), float(solref[1])
    if first > 0 and second > 0:
        resolved, ratio = first * second / timestep, second
    else:
        stiffness, damping = max(-first, 0.0), max(-second, 0.0)
        if stiffness == 0:
            # nothing pushes back out, so nothing is stored; it never stops sinking either
            return ContactNumbers(math.inf, math.inf if damping > 0 else 0.0, 0.0, impedance)
        resolved = 1 / (timestep * math.sqrt(stiffness))
        ratio = damping / (2 * math.sqrt(stiffness))
    if refsafe:
        resolved = max(resolved, 1.0)
    stiffness = impedance / (1 - impedance) / resolved**2
    return ContactNumbers(resolved, 2 * last * resolved * ratio, stiffness, impedance)


def impedance_at(solimp: Sequence[float], depth: float) -> float:
    """Returns the impedance d at a depth, as MuJoCo computes it, without unit.

    Args:
        solimp: MuJoCo's d₀, d_w, width in m, midpoint, power; the last may be left out.
        depth: In m, >= 0; infinity for d_w.
    """
    given = (*map(float, solimp), *MUJOCO_SOLIMP[len(solimp) :])
    # between mjMINIMP and mjMAXIMP
    start, last, middle = (min(max(given[i], 1e-4), 0.9999) for i in (0, 1, 3))
    width, power = given[2], max(given[4], 1.0)
    share = min(depth / width, 1.0) if width > 0 else 1.0
    if share <= middle:
        rise = share**power / middle ** (power - 1)
    else:
        rise = 1 - (1 - share) ** power / (1 - middle) ** (power - 1)
    return float(start + rise * (last - start))
