"""Simplifications of joints: fixed joints, and free joints replaced by their used axes."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.draft import Draft, census, model_of
from hapticbridge.check.frames import IDENTITY, matrix_of, pose_in, rotation_vector
from hapticbridge.check.simplifications import OTHER_MOTIONS, Simplification
from hapticbridge.check.witness import Witness

HARDLY_FAR, HARDLY_TURNED = 5e-4, 1e-2
"""Travel in m and rad up to which fixing a joint is tried. With a grip held by the default coupling
(2400 N/m, 2.4 N m/rad) it amounts to 1.2 N and 24 mN m. The felt error decides; larger values would
be tried in vain."""

MOST_JOINTS = 8
"""Largest number of nearly still joints that are fixed one by one; more are fixed together."""

_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
_AXES = "xyz"

Array = NDArray[np.float64]
Keys = list[dict[str, tuple[Array, Array]]]
"""Position and velocity by joint, for each keyframe."""


def freedom_simplifications(draft: Draft, seen: Witness) -> list[Simplification]:
    """Returns the joints to fix and the free joints to replace, as the motion allows."""
    still, simpler = [], []
    for joint in draft.spec.joints:
        way = np.abs(seen.travel[joint.name]).max(axis=0)
        if joint.type == _FREE:
            far, turned = way[:3] > HARDLY_FAR, way[3:] > HARDLY_TURNED
            if not far.any() and not turned.any():
                still.append(str(joint.name))
            else:
                simpler += _replacements(str(joint.name), far, turned, seen)
        elif way.max() <= (HARDLY_FAR if joint.type == _SLIDE else HARDLY_TURNED):
            still.append(str(joint.name))
    groups = [[name] for name in still] if len(still) <= MOST_JOINTS else [still]
    return [_fixed(group, seen) for group in groups] + simpler


def _fixed(names: list[str], seen: Witness) -> Simplification:
    def fix(spec: mujoco.MjSpec, keys: Keys) -> bool:
        fixed = [_fix(spec, keys, name, seen) for name in names]
        return any(fixed)

    what = f"'{names[0]}'" if len(names) == 1 else f"{len(names)} joints"
    return Simplification(
        f"{what} fixed",
        f"{what} hardly moved and stays where it started",
        lambda draft: _edit_joints(draft, fix),
        loses=OTHER_MOTIONS,
    )


def _fix(spec: mujoco.MjSpec, keys: Keys, name: str, seen: Witness) -> bool:
    joint = spec.joint(name)
    if joint is None:
        return False
    body = joint.parent
    if len(list(body.joints)) > 1:
        # fixing it away from its reference would turn the axes of the joints before it
        if joint.type == _BALL or abs(seen.start[name][0] - joint.ref) > 1e-12:
            return False
    else:
        _place(spec, body, seen.pose[body.name])
    spec.delete(joint)
    for key in keys:
        key.pop(name)
    return True


def _replacements(name: str, far: Array, turned: Array, seen: Witness) -> list[Simplification]:
    """Returns replacements by the used axes alone, and by all three slides with the used hinge."""
    if turned.sum() > 1:
        return []
    hinge = [int(axis) for axis in np.flatnonzero(turned)]
    slides = [int(axis) for axis in np.flatnonzero(far)]
    choices = [slides] if len(slides) == 3 else [slides, [0, 1, 2]]
    return [_replaced(name, each, hinge, seen) for each in choices]


def _replaced(name: str, slides: list[int], hinges: list[int], seen: Witness) -> Simplification:
    def replace(spec: mujoco.MjSpec, keys: Keys) -> bool:
        joint = spec.joint(name)
        if joint is None or joint.type != _FREE or _is_special(spec, joint):
            return False
        body, start = joint.parent, seen.start[name]
        _place(spec, body, seen.pose[body.name])
        spec.delete(joint)
        turn = matrix_of(start[3:])
        new = [(f"{name}_{_AXES[a]}", _SLIDE, a) for a in slides]
        new += [(f"{name}_turn_{_AXES[a]}", _HINGE, a) for a in hinges]
        for new_name, kind, axis in new:
            _add_joint(body, new_name, kind, turn.T @ np.eye(3)[axis])
        for key in keys:
            position, velocity = _in_world(*key.pop(name), start)
            for new_name, kind, axis in new:
                at = axis + 3 * (kind == _HINGE)
                key[new_name] = position[at : at + 1], velocity[at : at + 1]
        return True

    words = [f"slides along {''.join(_AXES[a] for a in slides)}"] if slides else []
    words += [f"turns about {_AXES[a]}" for a in hinges]
    return Simplification(
        f"'{name}' {' and '.join(words)}",
        f"the free joint has only the axes it used: it {' and '.join(words)}",
        lambda draft: _edit_joints(draft, replace),
        loses=OTHER_MOTIONS,
    )


def _is_special(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> bool:
    """Returns True for a free joint with properties that slides and hinges cannot take over."""
    loads = (joint.stiffness, joint.damping, [joint.armature, joint.frictionloss])
    aligned = mujoco.mjtAlignFree.mjALIGNFREE_TRUE
    return (
        any(np.any(np.asarray(load)) for load in loads)
        or joint.align == aligned
        or bool(spec.compiler.alignfree)
        or len(list(joint.parent.joints)) > 1
    )


def _add_joint(body: mujoco.MjsBody, name: str, kind: mujoco.mjtJoint, axis: Array) -> None:
    """Adds a joint with every field set; a user's ``<default>`` class would fill unset fields."""
    joint = body.add_joint(name=name)
    plain = mujoco.MjSpec().worldbody.add_body().add_joint()
    for field in dir(plain):
        value = getattr(plain, field)
        if isinstance(value, float | np.ndarray) and field not in ("userdata",):
            setattr(joint, field, value)
    joint.limited = joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    joint.actgravcomp = False
    joint.type, joint.axis = kind, axis


def _in_world(position: Array, velocity: Array, start: Array) -> tuple[Array, Array]:
    """Returns displacement and rotation vector from the start, and velocity, in the world frame."""
    vector = rotation_vector(start[3:], position[3:])
    spin = matrix_of(position[3:]) @ velocity[3:]  # MuJoCo stores it in the body's frame
    return np.concatenate([position[:3] - start[:3], vector]), np.concatenate([velocity[:3], spin])


def _place(spec: mujoco.MjSpec, body: mujoco.MjsBody, pose: Array) -> None:
    """Moves a body to a pose in its parent's frame, even if it is written in another frame."""
    body.pos, body.quat = np.zeros(3), IDENTITY
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    model = model_of(spec)
    at = model.body(body.name).id
    written = pose_in(np.concatenate([model.body_pos[at], model.body_quat[at]]), pose)
    body.pos, body.quat = written[:3], written[3:]


def _edit_joints(draft: Draft, change: Callable[[mujoco.MjSpec, Keys], bool]) -> bool:
    """Changes joints and carries keyframes over; refuses if other elements refer to the joints."""
    spec, before = draft.spec.copy(), model_of(draft.spec)
    keys = _read_keys(before)
    if not change(spec, keys):
        return False
    bare = spec.copy()
    for key in list(bare.keys):
        bare.delete(key)
    after = model_of(bare)
    if census(after) != census(before):
        return False
    order = [after.joint(j).name for j in range(after.njnt)]
    for key, values in zip(spec.keys, keys, strict=True):
        key.qpos = np.concatenate([np.zeros(0), *(values[name][0] for name in order)])
        key.qvel = np.concatenate([np.zeros(0), *(values[name][1] for name in order)])
    draft.source = draft.with_spec(spec)
    return True


def _read_keys(model: mujoco.MjModel) -> Keys:
    ends = [*model.jnt_qposadr[1:], model.nq], [*model.jnt_dofadr[1:], model.nv]
    return [
        {
            model.joint(j).name: (
                model.key_qpos[k, model.jnt_qposadr[j] : ends[0][j]].copy(),
                model.key_qvel[k, model.jnt_dofadr[j] : ends[1][j]].copy(),
            )
            for j in range(model.njnt)
        }
        for k in range(model.nkey)
    ]
