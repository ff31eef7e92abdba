"""Contacts of a scene, checked against the measured rule."""

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
    """MuJoCo's parameters of a contact; ``friction`` is the coefficient of sliding."""

    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    condim: int
    friction: float


class _GeomSetting(NamedTuple):
    """Contact parameters of one geom, before mixing; the fields are MuJoCo's."""

    priority: int
    solmix: float
    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    condim: int
    friction: float


def warn_of_contacts(model: mujoco.MjModel, grip: str, scene: object) -> None:
    """Warns of contacts that are likely to generate more energy than the slack allows."""
    for concern in check_contacts(model, grip):
        warnings.warn(f"scene '{scene}': {concern}", UserWarning, stacklevel=3)


def check_contacts(
    model: mujoco.MjModel,
    grip: str,
    *,
    is_thorough: bool = False,
    only: Collection[frozenset[int]] | None = None,
) -> list[str]:
    """Returns the concerns about all contacts that the tool can have.

    Flexes, and the ``solreffriction`` of pairs, are not checked.

    Args:
        model: The compiled scene with the time step of the run.
        grip: Name of the site on the tool.
        is_thorough: If true, soft contacts and the approximate diagonal are reported too; both are
            MuJoCo's defaults. Otherwise only contacts that are likely to generate more energy than
            the slack allows.
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
        f"the contact of {names[0]}{_others(len(names) - 1)} (solref {_words(setting.solref)}, "
        f"solimp {_words(setting.solimp[:3])}, time step {step:g} s) {concern}"
        for setting, names in names_by_setting.items()
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
    """Yields pairs of geoms that may collide, at least one of the tool, with their setting.

    The tool consists of everything that moves with the grip: the bodies below one child of the
    world. Distances are ignored, so a pair may never meet.
    """
    yield from settings_among(model, tool_geoms(model, grip))


def tool_geoms(model: mujoco.MjModel, grip: str) -> NDArray[np.bool_]:
    """Returns a mask of the geoms that move with the grip, shape (ngeom,)."""
    root = model.body_rootid[model.site(grip).bodyid[0]]
    return np.asarray(model.body_rootid[model.geom_bodyid] == root, dtype=bool)


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
