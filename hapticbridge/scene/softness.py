"""Softness, bounce and options of a scene that rigid contacts and constraints replace."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.jit import source_of
from hapticbridge.kernel.restitution import rigid_restitution
from hapticbridge.scene.contacts import MUJOCO_SOLREF, contact_numbers
from hapticbridge.scene.treatment import SceneChange
from hapticbridge.units import format_number, format_si

SOFT_FREQUENCY = 15.0
"""Natural frequency in Hz below which a constraint is meant as a spring. MuJoCo's default holds at
24 Hz. A hand moves at up to 10 Hz, and would feel a softer one yield."""


class _Springs(NamedTuple):
    """Constraints of one kind, each with MuJoCo's ``solref`` and ``solimp``."""

    subject: str
    kind: str
    names: list[str]
    solref: NDArray[np.float64]
    solimp: NDArray[np.float64]


class Bounce(NamedTuple):
    """Contacts or limits of one kind that bounce.

    Attributes:
        subject: Key of ``TREATMENTS``.
        names: Name of the one that bounces most, and the number of the others.
        e: Its coefficient of restitution, without unit; beside another geom it may be less.
    """

    subject: str
    names: str
    e: float

    def __str__(self) -> str:
        return f"{self.names}, e at most {self.e:.2g}"


def announce_rigid(model: mujoco.MjModel, options: Mapping[str, Any]) -> tuple[SceneChange, ...]:
    """Returns what rigid contacts and constraints change, each as ``name: old → new``.

    Args:
        model: The compiled scene with its own options.
        options: Options that rigid contacts need, by name.
    """
    springs = tuple(_springs(model))
    bouncing = (
        SceneChange(
            f"bounce of {each.names}: of a spring → of an impact, e at most {each.e:.2g}",
            each.subject,
        )
        for each in _bounces(springs)
    )
    changes = (*_softened(springs), *bouncing, *_options(model.opt, options))
    is_flex = (model.eq_type > int(mujoco.mjtEq.mjEQ_TENDON)) & (model.eq_active0 != 0)
    is_soft = any(map(np.any, (model.dof_frictionloss, model.tendon_frictionloss, is_flex)))
    if is_soft and not model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_DIAGEXACT:
        changes += (SceneChange("flag diagexact: disable → enable", "diagonal"),)
    return changes


def _springs(model: mujoco.MjModel) -> Iterator[_Springs]:
    """Yields the constraints that rigid ones replace.

    MuJoCo's spring follows the inertia and its energy is in no account: of 14 settings of equality
    constraints, 8 were active after a stretch of 5 mm at the start (45 nJ to 10 mJ), and one at
    rest was not strict (8.7 mJ, within slack).
    """
    obj, everywhere = mujoco.mjtObj, np.ones(model.npair, dtype=bool)
    is_rigid = (model.eq_type <= int(mujoco.mjtEq.mjEQ_TENDON)) & (model.eq_active0 != 0)
    touches = (model.geom_contype | model.geom_conaffinity) != 0
    flex_touches = (model.flex_contype | model.flex_conaffinity) != 0
    kinds: tuple[tuple[str, str, mujoco.mjtObj, str, NDArray[np.bool_]], ...] = (
        ("equality's softness", "equality", obj.mjOBJ_EQUALITY, "eq_sol{}", is_rigid),
        ("softness", "geom", obj.mjOBJ_GEOM, "geom_sol{}", touches),
        ("softness", "pair", obj.mjOBJ_PAIR, "pair_sol{}", everywhere),
        ("softness", "flex", obj.mjOBJ_FLEX, "flex_sol{}", flex_touches),
        ("limit's softness", "limit of joint", obj.mjOBJ_JOINT, "jnt_sol{}", model.jnt_limited),
        (
            "limit's softness",
            "limit of tendon",
            obj.mjOBJ_TENDON,
            "tendon_sol{}_lim",
            model.tendon_limited,
        ),
    )
    is_overridden = bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE)
    if is_overridden:
        one = model.opt.o_solref[None], model.opt.o_solimp[None]
        yield _Springs("override softness", "contact", ["o_solref"], *one)
    for subject, kind, number, fields, among in kinds:
        if is_overridden and subject == "softness":
            continue
        ids = np.flatnonzero(among).tolist()
        names = [mujoco.mj_id2name(model, int(number), i) or str(i) for i in ids]
        values = (getattr(model, fields.format(part))[ids] for part in ("ref", "imp"))
        yield _Springs(subject, kind, names, *values)


def _softened(springs: Sequence[_Springs]) -> Iterator[SceneChange]:
    """Yields constraints that are meant as springs: ω² = κ/h² of ``scene.contacts``."""
    for each in springs:
        rows = zip(each.solref.tolist(), each.solimp.tolist(), strict=True)
        # the frequency does not depend on the step
        numbers = [contact_numbers(ref, imp, 1.0, refsafe=False) for ref, imp in rows]
        frequency = np.sqrt([one.stiffness for one in numbers]) / (2.0 * math.pi)
        if named := _first(each, frequency < SOFT_FREQUENCY):
            words = f"{named}: a spring of {format_number(frequency.min(), 2)} Hz → rigid"
            yield SceneChange(words, each.subject)


def mixed_forms(model: mujoco.MjModel) -> Iterator[str]:
    """Yields the constraints whose ``solref`` MuJoCo replaces, as one number alone is > 0."""
    usual = " ".join(f"{value:g}" for value in MUJOCO_SOLREF)
    for each in _springs(model):
        is_positive = each.solref > 0.0
        is_mixed = is_positive[:, 0] != is_positive[:, 1]
        if named := _first(each, is_mixed):
            first, second = each.solref[np.argmax(is_mixed)].tolist()
            yield (
                f"solref {first:g} {second:g} of {named} mixes MuJoCo's two forms, so its default "
                f"{usual} counts; write two positive numbers or two that are not"
            )


def bounces(model: mujoco.MjModel) -> tuple[Bounce, ...]:
    """Returns the contacts and limits that bounce, by kind (``kernel.restitution``)."""
    return tuple(_bounces(tuple(_springs(model))))


def _bounces(springs: Sequence[_Springs]) -> Iterator[Bounce]:
    law = source_of(rigid_restitution)
    for each in springs:
        e = np.array([law(*one) for one in each.solref.tolist()])
        if each.subject != "equality's softness" and e.any():
            order = np.argsort(-e, kind="stable")
            bouncing = each._replace(names=[each.names[i] for i in order])
            yield Bounce(each.subject, _first(bouncing, e[order] > 0.0), float(e.max()))


def _first(springs: _Springs, mask: NDArray[np.bool_]) -> str:
    """Returns the kind and name of the first that a mask names, and the number of the others."""
    names = [name for name, is_named in zip(springs.names, mask, strict=True) if is_named]
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"{springs.kind} '{names[0]}'{more}" if names else ""


_SUBJECTS = {
    "impratio": "impratio",
    "iterations": "precision",
    "ls_iterations": "precision",
    "tolerance": "precision",
    "ls_tolerance": "precision",
}
_USUAL = {"impratio": 1.0}
"""MuJoCo's defaults of options that a file seldom sets. Their replacement is not said."""


def _options(option: mujoco.MjOption, needed: Mapping[str, Any]) -> Iterator[SceneChange]:
    if option.cone != needed["cone"]:
        yield SceneChange("cone: pyramidal → elliptic", "cone")
    for name, subject in _SUBJECTS.items():
        own = getattr(option, name)
        if own not in (needed[name], _USUAL.get(name)):
            yield SceneChange(f"{name}: {own:g} → {needed[name]:g}", subject)
    if option.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE and option.o_margin > 0.0:
        words = f"o_margin: {format_si(option.o_margin, 'm')} → 0"
        yield SceneChange(words, "override margin")
