"""Which contacts of a scene the measured rule has concerns about, by name."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Collection, Iterator
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.scene.contact_concerns import contact_concerns


class ContactSetting(NamedTuple):
    """What MuJoCo gives a contact: solref, solimp, condim, and the coefficient of sliding."""

    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    condim: int
    friction: float


class _Say(NamedTuple):
    """What one geom has to say in the mixture; the fields are MuJoCo's."""

    priority: int
    solmix: float
    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    condim: int
    friction: float


def warn_of_contacts(model: mujoco.MjModel, grip: str, scene: object) -> None:
    """Warns of contacts that are likely to create more energy than the slack allows.

    Args:
        model: The compiled scene with the time step that it will run at.
        grip: Name of the site on the tool.
        scene: Its path, for the sentence.
    """
    for concern in check_contacts(model, grip):
        warnings.warn(f"scene '{scene}': {concern}", UserWarning, stacklevel=3)


def check_contacts(
    model: mujoco.MjModel,
    grip: str,
    *,
    is_thorough: bool = False,
    only: Collection[frozenset[int]] | None = None,
) -> list[str]:
    """Returns what ``contact_concerns`` says about the contacts that the tool can have.

    Flexes, and the ``solreffriction`` of pairs, are not looked at.

    Args:
        model: The compiled scene with the time step that it will run at.
        grip: Name of the site on the tool.
        is_thorough: Whether to say too where a contact is soft or solved with the approximate
            diagonal: MuJoCo's defaults, for which nobody asked. Otherwise only what is likely to
            create more energy than the slack allows.
        only: Pairs of geoms to look at; None: all that the tool can have.
    """
    option, where = model.opt, dict[ContactSetting, list[str]]()
    pairs = contact_settings(model, grip) if only is None else settings_among(model)
    for first, second, setting in pairs:
        if only is None or frozenset((first, second)) in only:
            names = f"{geom_name(model, first)} with {geom_name(model, second)}"
            where.setdefault(setting, []).append(names)
    step = float(option.timestep)
    return [
        f"the contact of {names[0]}{_others(len(names) - 1)} (solref {_words(setting.solref)}, "
        f"solimp {_words(setting.solimp[:3])}, time step {step:g} s) {concern}"
        for setting, names in where.items()
        for concern in contact_concerns(
            setting.solref,
            setting.solimp,
            step,
            cone="elliptic" if option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else "pyramidal",
            diagexact=bool(option.enableflags & mujoco.mjtEnableBit.mjENBL_DIAGEXACT),
            refsafe=not option.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE,
            condim=setting.condim,
            friction=setting.friction,
            only_active=not is_thorough,
        )
    ]


def contact_settings(model: mujoco.MjModel, grip: str) -> Iterator[tuple[int, int, ContactSetting]]:
    """Yields geoms that may collide, one of the tool at least, with their contact's setting.

    The tool is all that moves with the grip: the bodies below one child of the world. Whether two
    geoms are ever near each other is not asked.

    Args:
        model: The compiled scene.
        grip: Name of the site on the tool.
    """
    yield from settings_among(model, tool_geoms(model, grip))


def tool_geoms(model: mujoco.MjModel, grip: str) -> NDArray[np.bool_]:
    """Tells of every geom whether it is of the tool: whether it moves with the grip."""
    root = model.body_rootid[model.site(grip).bodyid[0]]
    return np.asarray(model.body_rootid[model.geom_bodyid] == root, dtype=bool)


def settings_among(
    model: mujoco.MjModel, among: NDArray[np.bool_] | None = None
) -> Iterator[tuple[int, int, ContactSetting]]:
    """Yields geoms that may collide with their contact's setting; ``among`` as in the pairs."""
    mixed = cache(_mixed)  # geoms of one class say the same
    says = [_say(model, g) for g in range(model.ngeom)]
    for first, second, pair in meeting_pairs(model, among):
        if pair < 0:
            setting = mixed(says[first], says[second])
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
    """Yields geoms that may collide, by masks, exclusions, parents and explicit pairs.

    Args:
        model: The compiled scene.
        among: Per geom, whether a pair with it counts; None counts all.

    Yields:
        Two geoms, and the explicit pair that they are, or -1.
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
    """Tells which geoms pass MuJoCo's filters of masks, welded bodies, and parents."""
    meets = (model.geom_contype[geom] & model.geom_conaffinity) | (
        model.geom_contype & model.geom_conaffinity[geom]
    )
    # bodies without joints between them are one
    group = model.body_weldid[model.geom_bodyid]
    parent = model.body_weldid[model.body_parentid[group]]
    can_meet = (meets != 0) & (group != group[geom])
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        is_near = (parent == group[geom]) | (group == parent[geom])
        # the world is no parent in this
        can_meet &= ~is_near | (group == 0) | (group[geom] == 0)
    return np.asarray(can_meet, dtype=bool)


def _excluded(model: mujoco.MjModel) -> set[frozenset[int]]:
    return {frozenset((int(s) >> 16, int(s) & 0xFFFF)) for s in model.exclude_signature}


def _mixed(one: _Say, other: _Say) -> ContactSetting:
    """Mixes as MuJoCo's ``mj_contactParam`` does."""
    if one.priority != other.priority:
        sole = max(one, other, key=lambda say: say.priority)
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


def _say(model: mujoco.MjModel, geom: int) -> _Say:
    return _Say(
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
    """Returns what a sentence calls a geom: its name, or its number where it has none."""
    name = model.geom(geom_id).name
    return f"geom '{name}'" if name else f"geom {geom_id}"
