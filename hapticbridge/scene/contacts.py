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

All other settings count as active: they may create more energy than the slack allows. This is a
warning; many such runs stayed within the slack.

The map ``contact`` measures the rule on a peg in its hole: 30 to 300 g, K of 1000 and 6000 N/m,
friction 0 and 0.42, recorded and random hands with up to 30 N. It uses integrator ``discrete`` with
the elliptic cone at 1 kHz, draws the lines, and counts the differences between rule and runs.

The pyramidal cone is worse the lower the friction is. With MuJoCo's defaults otherwise, pegs
created up to 8.1 times the slack (16 of 36 runs of the map active).

A single contact is less critical: a mass on a wall stays within the slack at nearly every setting.
Beyond the measured range (other shapes, lighter tools, stiffer couplings, other periods) the rule
is a guide and the energy meter decides. Under ``implicitfast`` hardly any setting is strict.

Damping a contact costs time: the deflection after a strong push decays as exp(−t/τ). A steady force
penetrates (timeconst dampratio/2h)² times as deep as in the shipped scenes, for any τ.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import SceneError, SceneWarning
from hapticbridge.kernel.codes import moving_geoms
from hapticbridge.kernel.jit import source_of
from hapticbridge.kernel.restitution import NOTABLE_BOUNCE, restitution

STRICT_STEPS = 60.0
"""τ/h above which a contact of moderate stiffness created no energy in any run of the map (its
row "damped": τ = 60.8 h)."""

MODERATE_STIFFNESS = 0.6
"""Largest κ for which ``STRICT_STEPS`` suffices: timeconst·dampratio >= 4 h at d = 0.9. Stiffer
contacts require τ in proportion: at κ = 2.3 the map's τ = 30 h created energy, its 380 h none."""

STIFFEST = 4.0
"""Largest κ that the rule covers; the map's rows at 2.3 agree with the rule."""

MAX_IMPEDANCE = 0.91
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

MUJOCO_SOLREF = (0.02, 1.0)
"""MuJoCo's default ``solref``, which it also takes for two numbers of which one alone is > 0."""

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
        return max(self.stiffness / STIFFEST, self.impedance / MAX_IMPEDANCE) > 1 + ROUNDING

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
    solref: Sequence[float], solimp: Sequence[float], timestep: float, *, refsafe: bool = True
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
    is_mixed = (solref[0] > 0) != (solref[1] > 0)
    first, second = MUJOCO_SOLREF if is_mixed else (float(solref[0]), float(solref[1]))
    if first > 0:
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


# Concerns about a contact's setting, in words

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


def set_as_suggested(model: mujoco.MjModel, pairs: Collection[frozenset[int]]) -> None:
    """Sets the contacts between pairs of geoms as recommended, and the cone of all friction."""
    solref = np.multiply(SUGGESTED, (model.opt.timestep, 1.0))
    model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    model.opt.o_solref, model.opt.o_solimp = solref, MUJOCO_SOLIMP
    geoms = sorted({geom for pair in pairs for geom in pair})
    model.geom_solref[geoms], model.geom_solimp[geoms] = solref, MUJOCO_SOLIMP
    for pair, both in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True)):
        if frozenset(map(int, both)) in pairs:
            model.pair_solref[pair], model.pair_solimp[pair] = solref, MUJOCO_SOLIMP


def bounce_of(solref: Sequence[float]) -> float:
    """Returns the coefficient of restitution of a ``solref``; 0 below ``NOTABLE_BOUNCE``."""
    e = float(source_of(restitution)(*map(float, solref[:2])))
    return e if e >= NOTABLE_BOUNCE else 0.0


class Concern(NamedTuple):
    """Risk of a contact's setting.

    Attributes:
        words: The fault and the risk.
        change: What to write instead.
        is_cone: True if the cone of friction is the fault, one option for all contacts.
    """

    words: str
    change: str
    is_cone: bool = False

    def __str__(self) -> str:
        return f"{self.words}; write {self.change}"


class ContactSetting(NamedTuple):
    """MuJoCo's parameters of a contact.

    ``condim`` is 1 without friction; ``friction`` is the coefficient of sliding.
    """

    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    condim: int = 3
    friction: float = 1.0


def contact_concerns(
    setting: ContactSetting,
    timestep: float,
    *,
    cone: Literal["elliptic", "pyramidal"] = "elliptic",
    refsafe: bool = True,
) -> list[Concern]:
    """Returns the risks of a contact setting that is likely to exceed the slack; else none.

    Args:
        setting: The contact's; ``contact_numbers`` raises the errors.
        timestep: h in s.
        cone: Friction cone; it matters only for condim > 1 and a friction below 0.4.
        refsafe: As for ``contact_numbers``.

    Returns:
        Risks whose words follow "the contact of …".
    """
    numbers = contact_numbers(setting.solref, setting.solimp, timestep, refsafe=refsafe)
    # + 0.0 turns a negative zero into 0
    steps, instead = numbers.relaxation + 0.0, suggested_solref(timestep)
    concerns = []
    if numbers.grade == "active" and numbers.is_too_stiff:
        concerns.append(
            Concern(
                f"has {_excess(numbers)} than any that stayed passive in tests, and may create "
                "more energy than the coupling's slack allows",
                f'{instead} and solimp="0.9 0.95 0.001"',
            )
        )
    elif numbers.grade == "active" and (e := bounce_of(setting.solref)):
        concerns.append(
            Concern(
                f"bounces (e = {e:.2g}): as MuJoCo's spring it may rise higher than it fell, and "
                "create more energy than the coupling's slack allows",
                "nothing, if it is to bounce: rigid contacts (without --contact scene) do so as "
                f"impacts that pay for it; for no bounce {instead}",
            )
        )
    elif numbers.grade == "active":
        concerns.append(
            Concern(
                f"relaxes within {steps:.2g} time steps (2 d_w timeconst dampratio²) and may "
                "create more energy than the coupling's slack allows",
                f"{instead}, or for a tool of 0.1 kg or more "
                f'solref="{REFERENCE_STEPS * timestep:g} 1" solimp="0.9 0.95 0.001"',
            )
        )
    if cone == "pyramidal" and setting.condim > 1 and setting.friction < LOW_FRICTION:
        concerns.append(
            Concern(
                f"has a pyramidal cone and a friction of {setting.friction:g}, below "
                f"{LOW_FRICTION:g}, and may create several times the energy that the "
                "coupling's slack allows",
                'cone="elliptic" in <option>, or condim="1" for no friction',
                is_cone=True,
            )
        )
    return concerns


def _excess(numbers: ContactNumbers) -> str:
    """Names the numbers of a setting that is too stiff which exceed the rule's."""
    found = []
    if numbers.impedance > MAX_IMPEDANCE * (1 + ROUNDING):
        found.append(f"a larger impedance ({numbers.impedance:.3g}, at most {MAX_IMPEDANCE:g})")
    if numbers.stiffness > STIFFEST * (1 + ROUNDING):
        found.append(
            f"a larger stiffness ({numbers.stiffness:.3g} inertia/step², at most {STIFFEST:g})"
        )
    return " and ".join(found)


# Contacts of a scene, checked against the measured rule


class _GeomSetting(NamedTuple):
    """Contact parameters of one geom, before mixing; the fields are MuJoCo's."""

    priority: int
    solmix: float
    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    condim: int
    friction: float


def warn_of_contacts(model: mujoco.MjModel, grip: str, scene: object) -> None:
    """Warns of contacts that are likely to create more energy than the slack allows."""
    for concern in check_contacts(model, grip):
        warnings.warn(SceneWarning(scene, str(concern)), stacklevel=3)


def check_contacts(
    model: mujoco.MjModel, grip: str, *, only: Collection[frozenset[int]] | None = None
) -> list[Concern]:
    """Returns the concerns about all contacts that the tool can have (``contact_concerns``).

    Flexes, and the ``solreffriction`` of pairs, are not checked.

    Args:
        model: The compiled scene with the time step of the run.
        grip: Name of the site on the tool.
        only: Pairs of geoms to check; None: all that the tool can have.
    """
    option, names_by_setting = model.opt, dict[ContactSetting, list[str]]()
    pairs = contact_settings(model, grip) if only is None else settings_among(model)
    for first, second, setting in pairs:
        if only is None or frozenset((first, second)) in only:
            names = f"{geom_name(model, first)} with {geom_name(model, second)}"
            names_by_setting.setdefault(setting, []).append(names)
    step = float(option.timestep)
    return [
        concern._replace(
            words=f"the contact of {names[0]}{_others(len(names) - 1)} "
            f"(solref {_words(setting.solref)}, solimp {_words(setting.solimp[:3])}, time step "
            f"{step:g} s) {concern.words}"
        )
        for setting, names in names_by_setting.items()
        for concern in contact_concerns(
            setting,
            step,
            cone="elliptic" if option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else "pyramidal",
            refsafe=not option.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE,
        )
    ]


def contact_settings(model: mujoco.MjModel, grip: str) -> Iterator[tuple[int, int, ContactSetting]]:
    """Yields pairs of geoms that may collide, at least one of the tool, with their setting.

    The tool consists of everything that moves with the grip: the bodies below one child of the
    world. Distances are ignored, so a pair may never meet.
    """
    yield from settings_among(model, tool_geoms(model, grip))


def tool_geoms(model: mujoco.MjModel, grip: str) -> NDArray[np.bool_]:
    """Returns a mask of the geoms that move with the grip, shape (ngeom,)."""
    return moving_geoms(model, model.site(grip).id)


def settings_among(
    model: mujoco.MjModel, among: NDArray[np.bool_] | None = None
) -> Iterator[tuple[int, int, ContactSetting]]:
    """Yields pairs of geoms that may collide, as ``meeting_pairs``, with their setting."""
    mixed = cache(_mixed)  # many geoms share their parameters
    geoms = [_geom_setting(model, g) for g in range(model.ngeom)]
    for first, second, pair in meeting_pairs(model, among):
        if pair < 0:
            setting = mixed(geoms[first], geoms[second])
        else:
            setting = ContactSetting(
                _floats(model.pair_solref[pair]),
                _floats(model.pair_solimp[pair]),
                int(model.pair_dim[pair]),
                float(model.pair_friction[pair, 0]),
            )
        yield first, second, _overridden(model, setting)


def meeting_pairs(
    model: mujoco.MjModel, among: NDArray[np.bool_] | None = None
) -> Iterator[tuple[int, int, int]]:
    """Yields pairs of geoms that may collide, by masks, exclusions, parents and explicit pairs.

    Args:
        model: The compiled scene.
        among: Mask of geoms of which at least one must belong to the pair; None: all.

    Yields:
        Two geoms, and the index of their explicit pair, or -1.
    """
    disable = mujoco.mjtDisableBit
    if model.opt.disableflags & (disable.mjDSBL_CONTACT | disable.mjDSBL_CONSTRAINT):
        return
    counts = np.ones(model.ngeom, dtype=bool) if among is None else among
    paired = set()
    for p in range(model.npair):
        first, second = int(model.pair_geom1[p]), int(model.pair_geom2[p])
        paired.add(frozenset((first, second)))
        if counts[first] or counts[second]:
            yield first, second, p
    excluded = _excluded(model)
    for first in np.flatnonzero(counts).tolist():
        for second in np.flatnonzero(_partners(model, first)).tolist():
            bodies = frozenset(model.geom_bodyid[[first, second]].tolist())
            is_seen = counts[second] and second < first
            if is_seen or bodies in excluded or frozenset((first, second)) in paired:
                continue
            yield first, second, -1


def _partners(model: mujoco.MjModel, geom: int) -> NDArray[np.bool_]:
    """Returns a mask of the geoms that pass MuJoCo's filters (masks, welded bodies, parents)."""
    meets = (model.geom_contype[geom] & model.geom_conaffinity) | (
        model.geom_contype & model.geom_conaffinity[geom]
    )
    # bodies without joints between them count as one
    group = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[group]]
    can_meet = (meets != 0) & (group != group[geom])
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        is_near = (parent == group[geom]) | (group == parent[geom])
        # MuJoCo does not count the world as a parent here
        can_meet &= ~is_near | (group == 0) | (group[geom] == 0)
    return np.asarray(can_meet, dtype=bool)


def _excluded(model: mujoco.MjModel) -> set[frozenset[int]]:
    return {frozenset((int(s) >> 16, int(s) & 0xFFFF)) for s in model.exclude_signature}


def _mixed(one: _GeomSetting, other: _GeomSetting) -> ContactSetting:
    """Mixes two geoms' parameters by the rules of MuJoCo's ``mj_contactParam``."""
    if one.priority != other.priority:
        sole = max(one, other, key=lambda geom: geom.priority)
        return ContactSetting(sole.solref, sole.solimp, sole.condim, sole.friction)
    least = mujoco.mjMINVAL
    if one.solmix >= least and other.solmix >= least:
        share = one.solmix / (one.solmix + other.solmix)
    elif one.solmix < least and other.solmix < least:
        share = 0.5
    else:
        share = 0.0 if one.solmix < least else 1.0

    def blend(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(share * x + (1 - share) * y for x, y in zip(a, b, strict=True))

    if one.solref[0] > 0 and other.solref[0] > 0:
        solref = blend(one.solref, other.solref)
    else:
        solref = tuple(itertools.starmap(min, zip(one.solref, other.solref, strict=True)))
    return ContactSetting(
        solref,
        blend(one.solimp, other.solimp),
        max(one.condim, other.condim),
        max(one.friction, other.friction),
    )


def _geom_setting(model: mujoco.MjModel, geom: int) -> _GeomSetting:
    return _GeomSetting(
        int(model.geom_priority[geom]),
        float(model.geom_solmix[geom]),
        _floats(model.geom_solref[geom]),
        _floats(model.geom_solimp[geom]),
        int(model.geom_condim[geom]),
        float(model.geom_friction[geom, 0]),
    )


def _overridden(model: mujoco.MjModel, setting: ContactSetting) -> ContactSetting:
    option = model.opt
    if not option.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        return setting
    return ContactSetting(
        _floats(option.o_solref),
        _floats(option.o_solimp),
        setting.condim,
        float(option.o_friction[0]),
    )


def _floats(values: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(values.tolist())


def _words(values: tuple[float, ...]) -> str:
    return f'"{" ".join(f"{value:g}" for value in values)}"'


def _others(count: int) -> str:
    return f" and {count} more" if count else ""


def geom_name(model: mujoco.MjModel, geom_id: int) -> str:
    """Returns the name of a geom for a message, or its number if it has no name."""
    name = model.geom(geom_id).name
    return f"geom '{name}'" if name else f"geom {geom_id}"
