"""Faults of contact settings: too soft, too stiff, too slippery."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from hapticbridge.check.case import SceneUnderCheck
from hapticbridge.check.observe import clearances
from hapticbridge.kernel.colliders import MAX_VERTICES
from hapticbridge.scene.checks import MAXIMUM_START_PENETRATION, REFUSED_PENETRATION
from hapticbridge.scene.compile import find_start
from hapticbridge.scene.contacts import (
    MUJOCO_SOLREF,
    REFERENCE_STEPS,
    ROUNDING,
    SOFT_STEPS,
    ContactSetting,
    bounce_of,
    contact_concerns,
    contact_numbers,
    meeting_pairs,
    settings_among,
    suggested_solref,
    tool_geoms,
)
from hapticbridge.scene.fault import Fault, length, number, numbers, others
from hapticbridge.scene.physics import body_inertia, constraint_stiffness, depth_under
from hapticbridge.scene.source_map import Place

MIN_PUSH = 1.0
"""Smallest force in N that contacts are tested with: a light touch. A motion without contact does
not stretch the coupling, so it gives no test force."""

_MIN_FRICTION = float(mujoco.mjMINMU)
_TYPICAL_INERTIA = 0.1  # kg; for pairs of which neither side moves by itself


def contact_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields faults of the tool's possible contacts and of every contact in the motion.

    Rigid contact replaces these settings, so that it has none.
    """
    if case.is_rigid:
        return
    model, option = case.model, case.model.opt
    meetings = case.observation.meetings if case.observation else {}
    is_tool = tool_geoms(model, case.scene.grip)
    where: dict[ContactSetting, list[tuple[int, int]]] = {}
    for first, second, setting in settings_among(model):
        pair = min(first, second), max(first, second)
        if is_tool[first] or is_tool[second] or pair in meetings:
            where.setdefault(setting, []).append(pair)
    push, is_cone_reported = push_of(case), False
    case.scene.reset()
    rooms = _rooms(case, [pair for pairs in where.values() for pair in pairs])
    active = {
        geom
        for setting, pairs in where.items()
        if contact_numbers(setting.solref, setting.solimp, case.step).grade == "active"
        for pair in pairs
        for geom in pair
    }
    for setting, pairs in where.items():
        place, also = _place(case, pairs[0], is_soft=False)
        names = pair_names(case, pairs)
        if fault := _soft(case, setting, pairs, push, rooms, active):
            yield fault
        for concern in contact_concerns(
            setting,
            case.step,
            cone="elliptic" if option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else "pyramidal",
        ):
            clause, change, is_cone = concern
            if is_cone and is_cone_reported:
                continue  # one option changes it for all contacts
            is_cone_reported |= is_cone
            yield Fault(
                "pyramidal cone" if is_cone else "not passive",
                case.places.option("cone") if is_cone else place,
                f'the contact of {names} (solref "{numbers(setting.solref)}") {clause}',
                change if is_cone else change + also,
            )


_FLAT = (int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_MESH))


def shape_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields pairs of flat shapes whose contact points MuJoCo drops or tilts (``colliders``)."""
    model = case.model
    is_tool = tool_geoms(model, case.scene.grip)
    boxes, meshes = list[tuple[int, int]](), list[tuple[int, int]]()
    for first, second, _ in meeting_pairs(model, is_tool):
        kinds = {int(model.geom_type[first]), int(model.geom_type[second])}
        if kinds == {_FLAT[0]} and not case.is_rigid:
            boxes.append((first, second))
        is_flat = kinds <= {*_FLAT} and _FLAT[1] in kinds
        parts = (*_corners_and_faces(model, first), *_corners_and_faces(model, second))
        if is_flat and (not case.is_rigid or max(parts) > MAX_VERTICES):
            meshes.append((first, second))
    if boxes:
        yield Fault(
            "box edges",
            case.places.find("geom", _tool_geom(boxes[0], is_tool)),
            f"{pair_names(case, boxes)} are boxes, of whose contact MuJoCo drops points from step "
            "to step where an edge is touched; a peg of 30 g sank 5 mm in that way",
            "--contact rigid for the run, whose boxes keep all points",
        )
    if meshes:
        counts = [_corners_and_faces(model, geom) for pair in meshes for geom in pair]
        corners, faces = (max(each) for each in zip(*counts, strict=True))
        also = "" if case.is_rigid else " and --contact rigid for the run"
        yield Fault(
            "mesh faces",
            case.places.find("geom", _tool_geom(meshes[0], is_tool)),
            f"{pair_names(case, meshes)} meet with the normal of either face, up to 84 mrad off "
            "the one that is touched; a tilted tool without friction sank 2.5 mm in that way",
            f"boxes, spheres and capsules instead, or meshes of at most {MAX_VERTICES} corners and "
            f"as many faces (now {corners} and {faces}){also}",
        )


def _tool_geom(pair: tuple[int, int], is_tool: np.ndarray) -> int:
    return pair[0] if is_tool[pair[0]] else pair[1]


def _corners_and_faces(model: mujoco.MjModel, geom: int) -> tuple[int, int]:
    """Returns the numbers of corners and of faces of a mesh geom; those of a box for others."""
    if model.geom_type[geom] != _FLAT[1]:
        return 8, 6
    mesh = int(model.geom_dataid[geom])
    return int(model.mesh_vertnum[mesh]), int(model.mesh_polynum[mesh])


def push_of(case: SceneUnderCheck) -> float:
    """Returns the force in N that contacts are tested with.

    It is the largest coupling force in the motion, at least ``MIN_PUSH`` and at most the device's
    force limit.
    """
    largest = float(case.observation.force.max()) if case.observation else 0.0
    return min(max(largest, MIN_PUSH), max(case.info.force_limit, MIN_PUSH))


def _rooms(case: SceneUnderCheck, pairs: list[tuple[int, int]]) -> dict[tuple[int, int], float]:
    if case.observation is None:
        return {}
    is_tool = tool_geoms(case.model, case.scene.grip)
    tool_pairs = [pair for pair in pairs if is_tool[pair[0]] != is_tool[pair[1]]]
    return clearances(case.model, tool_pairs, is_tool, case.observation.postures)


def _soft(
    case: SceneUnderCheck,
    setting: ContactSetting,
    pairs: list[tuple[int, int]],
    push: float,
    rooms: dict[tuple[int, int], float],
    active: set[int],
) -> Fault | None:
    """Returns a contact that is too soft; what to write suits ``active`` geoms' other contacts."""
    step = case.step
    depths = {
        pair: depth_under(
            push, setting.solref, setting.solimp, inertia_of(case, pair, setting), step
        )
        for pair in pairs
    }
    resolved = contact_numbers(setting.solref, setting.solimp, step).resolved
    if resolved <= REFERENCE_STEPS * (1 + ROUNDING):
        return None  # as stiff as the settings that were passive with light tools
    tight = [pair for pair in pairs if depths[pair] > rooms.get(pair, np.inf)]
    if not tight and resolved <= SOFT_STEPS * (1 + ROUNDING):
        return None
    pair = max(tight or pairs, key=lambda each: depths[each])
    stiffness = constraint_stiffness(
        setting.solref, setting.solimp, inertia_of(case, pair, setting), step, depths[pair]
    )
    is_default = np.allclose(setting.solref, MUJOCO_SOLREF)
    default = "MuJoCo's default " if is_default else ""
    sentence = (
        f"the contact of {pair_names(case, [pair])}{others(len(pairs) - 1)} amounts to "
        f"{number(stiffness)} N/m ({default}solref "
        f'"{numbers(setting.solref)}"): {number(push)} N sink in by {length(depths[pair])}'
    )
    if pair in rooms:
        sentence += f", into a clearance of {length(rooms[pair])}"
    solref = f'solref="{REFERENCE_STEPS * step:g} 1"'
    if active & set(pair):
        solref = suggested_solref(step)
    change = f'{solref} solimp="0.9 0.95 0.001"'
    kind = "default contact" if is_default else "soft contact"
    place, also = _place(case, pair, is_soft=True)
    if is_default and len(pairs) > 1:
        also += f"; for all geoms at once: <geom {change}/> in <default>"
    if bounce := bounce_of(setting.solref):
        also += f" (which ends its bounce, e = {bounce:.2g})"
    return Fault(kind, place, sentence, change + also)


def inertia_of(case: SceneUnderCheck, pair: tuple[int, int], setting: ContactSetting) -> float:
    """Returns the smallest effective inertia in kg that the contact of two geoms had in the motion.

    For geoms that did not meet it follows from the bodies' centres at the start: 1/m = Σ 1/m_i. The
    tool's inertia includes the coupling's share h B' + h² K. A pyramidal cone multiplies the result
    by the factor of its edges.
    """
    model = case.model
    seen = case.observation.meetings.get(pair) if case.observation else None
    if seen is not None and np.isfinite(seen.inertia):
        return seen.inertia
    is_tool = tool_geoms(model, case.scene.grip)
    step, inverse = case.step, 0.0
    share = step * case.law.damping + step**2 * case.law.stiffness
    for geom in pair:
        inertia = body_inertia(model, case.scene.data, int(model.geom_bodyid[geom]))
        inverse += 1.0 / (inertia + (share if is_tool[geom] else 0.0))
    return _edges(model, setting) / inverse if inverse > 0 else _TYPICAL_INERTIA


def _edges(model: mujoco.MjModel, setting: ContactSetting) -> float:
    """Returns the stiffness of a pyramidal cone's edges together, relative to an elliptic cone.

        (dim − 1)/(μ² (1 + μ²))

    for friction μ and a contact with equal inertia along the normal and the tangents: 198 at μ =
    0.1, 1 at μ = 1 and dim = 3. Measured with MuJoCo at rest, to 9 digits.
    """
    friction = max(setting.friction, _MIN_FRICTION)
    if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL or setting.condim == 1:
        return 1.0
    return (setting.condim - 1) / (friction**2 * (1 + friction**2))


def _place(case: SceneUnderCheck, pair: tuple[int, int], *, is_soft: bool) -> tuple[Place, str]:
    """Returns the place to change a contact's setting, and a note on a second place to change.

    An explicit pair comes first, then the geom with the higher priority. Otherwise it is the geom
    with the softer ``solref`` (for ``is_soft``) or the stiffer one. If both are equal it is the
    tool's geom, and the other must change too, because MuJoCo averages the two.
    """
    model = case.model
    for p in range(model.npair):
        if {int(model.pair_geom1[p]), int(model.pair_geom2[p])} == set(pair):
            return case.places.find("pair", p), ""
    is_tool = tool_geoms(model, case.scene.grip)
    if model.geom_priority[pair[0]] != model.geom_priority[pair[1]]:
        return case.places.find("geom", max(pair, key=lambda geom: model.geom_priority[geom])), ""
    softness = [_softness(model.geom_solref[geom]) for geom in pair]
    if softness[0] == softness[1]:
        own, other = pair if is_tool[pair[0]] else pair[::-1]
        also = case.places.find("geom", other)
        return case.places.find(
            "geom", own
        ), f" there and at {also.file}:{also.line}, {also.element}"
    extreme = max(softness) if is_soft else min(softness)
    return case.places.find("geom", pair[softness.index(extreme)]), ""


def _softness(solref: np.ndarray) -> float:
    first, second = (float(value) for value in solref)
    if first > 0 and second > 0:
        return first * second
    return 1.0 / np.sqrt(-first) if first < 0 else np.inf


def pair_names(case: SceneUnderCheck, pairs: list[tuple[int, int]]) -> str:
    """Returns the names of the first pair of geoms, and the number of further pairs."""
    first, second = (case.places.find("geom", geom).element for geom in pairs[0])
    return f"{first} with {second}{others(len(pairs) - 1)}"


# Faults of contacts at the start, and of contact margins


def margin_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields geoms and pairs whose contacts push, or rest if they are rigid, before they touch."""
    model, places = case.model, case.places
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        return
    meeting = {geom for first, second, _ in settings_among(model) for geom in (first, second)}
    found = [
        (places.find("geom", geom), float(model.geom_margin[geom])) for geom in sorted(meeting)
    ]
    found += [(places.find("pair", p), float(model.pair_margin[p])) for p in range(model.npair)]
    does = "it pushes that far before it is touched, and the force jumps where it begins"
    if case.is_rigid:
        does = (
            "its contacts rest, and bounce, that far before they touch; margins of two geoms add "
            "up, and a gap changes nothing"
        )
    for place, margin in found:
        if margin > 0:
            yield Fault(
                "margin",
                place,
                f"{place.element} has a margin of {1e3 * margin:g} mm: {does}",
                'margin="0"',
            )


def start_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields starts that are not finite, and overlapping geoms, whose energy is not metered."""
    case.scene.reset()
    model, data = case.model, case.scene.data
    beyond = [
        name
        for name in ("qpos", "qvel", "qacc")
        if not np.all(np.abs(getattr(data, name)) <= mujoco.mjMAXVAL)
    ]
    if beyond:
        yield Fault(
            "start not finite",
            case.places.start(),
            f"at the start {' and '.join(beyond)} are not finite or beyond {mujoco.mjMAXVAL:g}",
            "numbers of this scene's size",
        )
    seen = set()
    for contact in data.contact:
        first, second = (int(geom) for geom in contact.geom)
        if (
            first < 0
            or second < 0
            or (first, second) in seen
            or contact.dist >= -REFUSED_PENETRATION
        ):
            continue
        seen.add((first, second))
        mover = second if model.body_treeid[model.geom_bodyid[second]] >= 0 else first
        body = int(model.geom_bodyid[mover])
        out = -contact.dist * contact.frame[:3] * (1 if mover == second else -1)
        effect = (
            "they are held there, and eased out as far as joints and the energy that the scene has "
            "dissipated allow"
        )
        if not case.is_rigid:
            effect = (
                f"more than {length(MAXIMUM_START_PENETRATION)} release energy that is not metered"
            )
        yield Fault(
            "starts in contact",
            case.places.find("geom", mover),
            f"{pair_names(case, [(first, second)])} overlap by {length(-contact.dist)} at the "
            f"start; {effect}",
            _moved_out(case, body, out),
        )


def _moved_out(case: SceneUnderCheck, body: int, out: np.ndarray) -> str:
    model = case.model
    by = " ".join(f"{value:.4g}" for value in 1e3 * out)
    has_keyframe = find_start(model) >= 0
    name = model.body(body).name or body
    if has_keyframe or model.body_parentid[body] != 0:
        start = "keyframe 'home'" if has_keyframe else "its pos"
        return f"move body '{name}' in {start} by {by} mm"
    position = " ".join(f"{value:.6g}" for value in model.body_pos[body] + 1.01 * out)
    return f"pos=\"{position}\" in body '{name}' (moved by {by} mm)"
