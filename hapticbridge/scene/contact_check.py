"""Which contacts of a scene the measured rule has concerns about, by name."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import mujoco

from hapticbridge.scene.contact_rule import contact_concerns

USUAL_PERIOD = 1e-3
"""The bridge's default period in s. A scene runs at the rate that the user asks for, not at the
time step of its file; MuJoCo's default of 2 ms is taken for no opinion."""

Cone = Literal["elliptic", "pyramidal"]


class _Setting(NamedTuple):
    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    condim: int
    friction: float


def check_contacts(model: mujoco.MjModel, grip: str, *, is_thorough: bool = False) -> list[str]:
    """Returns what ``contact_concerns`` says about the contacts that the tool can have.

    A geom is judged by its own setting; where two are of equal priority MuJoCo mixes them, and the
    mixture of two good settings is taken as good. Geoms whose priority yields to every partner's
    have no say and are passed over. The global override, where it is on, is judged instead.

    Args:
        model: The compiled scene; settings are judged by its time step, or by 1 ms if that is less.
        grip: Name of the site on the tool.
        is_thorough: Whether to say too where a contact is soft or solved with the approximate
            diagonal: MuJoCo's defaults, for which nobody asked. Otherwise only what is likely to
            create more energy than the slack allows.
    """
    option = model.opt
    timestep = min(float(option.timestep), USUAL_PERIOD)
    is_elliptic = option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    cone: Cone = "elliptic" if is_elliptic else "pyramidal"
    is_exact = bool(option.enableflags & mujoco.mjtEnableBit.mjENBL_DIAGEXACT)
    where: dict[_Setting, list[str]] = {}
    for name, setting in _settings(model, grip):
        where.setdefault(setting, []).append(name)
    return [
        f"the contact of {names[0]}{_others(len(names) - 1)} (solref "
        f'"{setting.solref[0]:g} {setting.solref[1]:g}", time step {timestep:g} s) {concern}'
        for setting, names in where.items()
        for concern in contact_concerns(
            setting.solref,
            setting.solimp,
            timestep,
            cone=cone,
            diagexact=is_exact,
            condim=setting.condim,
            friction=setting.friction,
            only_active=not is_thorough,
        )
    ]


def _others(count: int) -> str:
    return f" and {count} more" if count else ""


def _settings(model: mujoco.MjModel, grip: str) -> Iterator[tuple[str, _Setting]]:
    root = model.body_rootid[model.site(grip).bodyid[0]]
    can_touch = [g for g in range(model.ngeom) if model.geom_contype[g] | model.geom_conaffinity[g]]
    tool = [g for g in can_touch if model.body_rootid[model.geom_bodyid[g]] == root]
    others = [g for g in can_touch if model.body_rootid[model.geom_bodyid[g]] != root]
    # a tool of several links may touch itself too; such scenes are judged by the same settings
    for mine, theirs in ((tool, others), (others, tool)):
        if not theirs:
            continue
        priority = int(model.geom_priority[theirs].min())
        smoothest = float(model.geom_friction[theirs, 0].min())
        for g in mine:
            if model.geom_priority[g] >= priority:
                # of two geoms the rougher counts
                friction = max(smoothest, float(model.geom_friction[g, 0]))
                solref, solimp = model.geom_solref[g], model.geom_solimp[g]
                condim = int(model.geom_condim[g])
                yield _geom_name(model, g), _setting(model, solref, solimp, condim, friction)
    for p in range(model.npair):
        first, second = int(model.pair_geom1[p]), int(model.pair_geom2[p])
        if root in (model.body_rootid[model.geom_bodyid[g]] for g in (first, second)):
            name = f"pair {_geom_name(model, first)} and {_geom_name(model, second)}"
            solref, solimp = model.pair_solref[p], model.pair_solimp[p]
            condim, friction = int(model.pair_dim[p]), float(model.pair_friction[p, 0])
            yield name, _setting(model, solref, solimp, condim, friction)


def _setting(
    model: mujoco.MjModel, solref: object, solimp: object, condim: int, friction: float
) -> _Setting:
    option = model.opt
    if option.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        solref, solimp, friction = option.o_solref, option.o_solimp, float(option.o_friction[0])
    return _Setting(_floats(solref), _floats(solimp), condim, friction)


def _floats(values: object) -> tuple[float, ...]:
    return tuple(float(v) for v in values)  # type: ignore[attr-defined]


def _geom_name(model: mujoco.MjModel, geom_id: int) -> str:
    name = model.geom(geom_id).name
    return f"geom '{name}'" if name else f"geom {geom_id}"
