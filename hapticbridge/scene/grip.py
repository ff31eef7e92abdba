"""Grip of a scene: the site, or the point of a body, that the hand holds.

A grip is the name of a site, the name of a body, or ``BODY@x,y,z`` with a point in m in the body's
frame. A body alone is held at its centre of mass, or at its origin if it has no mass, and a body
without a name goes by its number. For a body, a site is added whose name is the grip as written, so
a recording and a what-if find it by that name. If a site and a body share a name, the site is the
grip.

``joint:NAME`` is a hinge or slide, which a hand moves along its one axis, as a grip axis does. No
site is held by a name that begins so.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import number_from
from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.codes import Grip
from hapticbridge.scene.compile import reset, unfused_model
from hapticbridge.scene.physics import matrix_of

MAX_OFFERED = 4
"""Number of grips that a refusal names. More would make its sentence too long to read."""

_LIKELY = (
    (re.compile(r"grip(_?site)?$|grasp|handle|tool|tcp|stylus|probe|end_?eff|attach|pinch"), 3.0),
    (re.compile(r"(^|_)ee|gripper|hand|palm|wrist|flange|finger|tip"), 2.0),
)
"""Patterns of the names of what hands hold, with points; the first pattern that is found counts."""

_HELD_MASS = 0.005, 5.0
"""Range in kg of what a hand holds without a support, for a point."""


ON_AXIS = 1e-9
"""Way of a centre of mass in m/rad below which it lies on the axes that turn it. Rounding leaves
1e-17; a body farther off follows a hand that pulls it."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Something in a scene that a hand could hold.

    Attributes:
        name: Value for ``grip=`` and ``--grip``.
        kind: ``site`` or ``body``.
        body: Name of the body, or its number if it has none.
        mass: Mass in kg of the body and of all that hangs on it.
        freedom: Directions and axes, 0 to 6, that its joints leave free at the start.
        points: Plausibility, without unit: up to 3 for the name, 2 for freedom, 1 for a way of the
            point, 1 for a mass that a hand holds, 0.5 for a site and 0.5 for depth in the tree.
    """

    name: str
    kind: str
    body: str
    mass: float
    freedom: int
    points: float

    def __str__(self) -> str:
        """Name and reason, as in ``'tcp' (site of 'hand', 0.63 kg, 6 of 6 free)``."""
        kind = f"site of '{self.body}'" if self.kind == "site" else "body"
        return f"'{self.name}' ({kind}, {self.mass:.3g} kg, {self.freedom} of 6 free)"


def grips(model: mujoco.MjModel) -> tuple[Candidate, ...]:
    """Returns all that a hand could hold, the most plausible first.

    These are the named sites and the bodies that joints can move; mocap bodies are none of them. A
    body that turns about its centre of mass is offered at its rim too.

    Args:
        model: The scene without a handle.
    """
    data = mujoco.MjData(model)
    reset(model, data)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    depths = np.zeros(model.nbody)
    for body_id in range(1, model.nbody):
        depths[body_id] = depths[model.body_parentid[body_id]] + 1
    names = [model.body(i).name or str(i) for i in range(model.nbody)]
    sites = {model.site(i).name for i in range(model.nsite)}
    found = []
    for kind, name, body_id, point in _points(model, data):
        if kind == "body" and names[body_id] in sites:
            continue  # the site of that name is the grip
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], point, body_id)
        freedom = int(np.linalg.matrix_rank(jacobian))
        if not freedom:
            continue
        mass = float(model.body_subtreemass[body_id])
        points = (
            next((points for pattern, points in _LIKELY if pattern.search(name.lower())), 0.0)
            + freedom / 3
            + bool(np.abs(jacobian[:3]).max() > ON_AXIS)
            + (_HELD_MASS[0] <= mass <= _HELD_MASS[1])
            + 0.5 * (kind == "site")
            + 0.5 * float(depths[body_id] / depths.max())
        )
        found.append(Candidate(name, kind, names[body_id], mass, freedom, points))
    return tuple(sorted(found, key=lambda grip: -grip.points))


def _points(
    model: mujoco.MjModel, data: mujoco.MjData
) -> Iterator[tuple[str, str, int, NDArray[np.float64]]]:
    """Yields kind, name, body and place in the world of each site and body."""
    for site_id in range(model.nsite):
        name = model.site(site_id).name
        if name and not Grip.from_text(name).is_joint:
            yield "site", name, int(model.site_bodyid[site_id]), data.site_xpos[site_id]
    for body_id in range(1, model.nbody):
        if model.body_weldid[body_id] == 0:
            continue
        name, jacobian = model.body(body_id).name or str(body_id), np.zeros((3, model.nv))
        matrix = data.xmat[body_id].reshape(3, 3)
        yield "body", name, body_id, data.xpos[body_id] + matrix @ _centre(model, body_id)
        mujoco.mj_jacBodyCom(model, data, jacobian, None, body_id)
        if (
            np.abs(jacobian).max(initial=0.0) < ON_AXIS
            and (rim := _rim(model, body_id)) is not None
        ):
            text = ",".join(f"{value:.3g}" for value in rim)
            yield "body", f"{name}@{text}", body_id, data.xpos[body_id] + matrix @ rim


def _rim(model: mujoco.MjModel, body_id: int) -> NDArray[np.float64] | None:
    """Returns the point in m, in a body's frame, by which a dial or valve on an axis is turned.

    It is as far from the axis of the body's first joint as its largest geom reaches, across it.
    """
    geoms = np.flatnonzero(model.geom_bodyid == body_id)
    if not len(geoms) or not model.body_jntnum[body_id]:
        return None
    largest = geoms[np.argmax(model.geom_rbound[geoms])]
    axis = model.jnt_axis[model.body_jntadr[body_id]]
    across = np.eye(3)[np.argmin(np.abs(axis))]
    across = across - axis * (axis @ across)
    across /= np.linalg.norm(across)
    reach = np.abs(matrix_of(model.geom_quat[largest]).T @ across) @ model.geom_aabb[largest, 3:]
    return np.asarray(_centre(model, body_id) + reach * across) if reach > 0.0 else None


def _centre(model: mujoco.MjModel, body_id: int) -> NDArray[np.float64]:
    """Returns the centre of mass in m in a body's frame, or its origin if it has no mass.

    For a body without mass MuJoCo's ``body_ipos`` is the place of the body in its parent.
    """
    has_mass = model.body_mass[body_id] > 0.0
    return np.array(model.body_ipos[body_id] if has_mass else np.zeros(3))


def add_grip(spec: mujoco.MjSpec, grip: str) -> list[str]:
    """Adds a site for a grip that is a body or a point of one; returns warnings.

    Args:
        spec: The user's scene; unchanged if the grip is one of its sites.
        grip: Name of a site, ``BODY``, ``BODY@x,y,z`` or ``joint:NAME``.

    Raises:
        SceneError: The scene has no such site, body or joint; the message offers others. Or the
            point is not three finite numbers.
    """
    bodies = {body.name: body for body in spec.bodies if body.name}
    held = Grip.from_text(grip)
    if held.is_joint:
        _check_joint(spec, held.name)
        return []
    if grip and any(site.name == grip for site in spec.sites):
        if grip not in bodies:
            return []
        return [
            f"'{grip}' is a site and a body, and the hand holds the site; '{grip}@0,0,0' is the "
            "body at its origin"
        ]
    if not spec.compiler.fusestatic:  # which changes their numbers
        bodies |= {str(i): body for i, body in enumerate(spec.bodies) if not body.name}
    name, is_point, text = (grip, "", "") if grip in bodies else grip.rpartition("@")
    if name not in bodies:
        raise SceneError(_offer(spec.copy().compile(), grip, bodies))
    body, model = bodies[name], unfused_model(spec)
    body_id = model.body(name).id if body.name else int(name)
    point = _point_of(grip, text) if is_point else _centre(model, body_id).tolist()
    site = body.add_site(name=grip)
    # every field that places it, so that no <default> of the scene applies
    site.pos, site.quat, site.fromto = point, (1.0, 0.0, 0.0, 0.0), np.full(6, np.nan)
    site.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    return []


def _check_joint(spec: mujoco.MjSpec, name: str) -> None:
    kinds = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    held = [joint.name for joint in spec.joints if joint.type in kinds and joint.name]
    if name not in held:
        offered = f"its hinges and slides are {choices(held)}" if held else "it has none"
        raise SceneError(f"the scene has no hinge or slide '{name}' to hold; {offered}")


def _point_of(grip: str, text: str) -> list[float]:
    try:
        point = [number_from(number) for number in text.split(",")]
    except ValueError:
        point = []
    if len(point) != 3 or not all(map(math.isfinite, point)):
        raise SceneError(
            f"grip '{grip}' has no point after @; write BODY@x,y,z with three finite numbers in m "
            "in the body's frame"
        )
    return point


def _offer(model: mujoco.MjModel, grip: str, bodies: Container[str]) -> str:
    offered = [
        each
        for each in grips(model)
        if each.kind == "site" or each.name in bodies or each.name.rpartition("@")[0] in bodies
    ]
    head = f"the scene has no site or body '{grip}' to hold"
    if not offered:
        return f"{head}, and nothing in it can move; give a body a joint"
    named = ", ".join(map(str, offered[:MAX_OFFERED]))
    more = f" and {len(offered) - MAX_OFFERED} more" if len(offered) > MAX_OFFERED else ""
    return (
        f"{head}; choose one (--grip, or grip= in Python; BODY@x,y,z for a point in m): "
        f"{named}{more}"
    )
