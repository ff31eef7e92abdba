"""Inventory of the user's model, without the parts that the bridge adds."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.observe import Observation
from hapticbridge.kernel.codes import COUPLING_ACTUATORS, HANDLE
from hapticbridge.scene.checks import reached_trees
from hapticbridge.scene.contacts import meeting_pairs
from hapticbridge.scene.softness import Bounce, bounces
from hapticbridge.scene.source_map import Place, Places

VISUAL = "only visual"
TOOL = "of the tool"
MEETS_TOOL = "that meet the tool"
MEETS_OTHER = "that meet something else"
MOVING = "moving that meet nothing"
FIXED = "fixed that meet nothing"
USES = (TOOL, MEETS_TOOL, MEETS_OTHER, MOVING, FIXED, VISUAL)
"""Roles of a geom, in the order in which they are printed."""


@dataclass(frozen=True, slots=True)
class Idle:
    """An element that cannot influence the grip.

    Attributes:
        place: Line on which it is written.
        reason: Why it has no influence.
    """

    place: Place
    reason: str


@dataclass(frozen=True, slots=True)
class Inventory:
    """Counts of a scene's parts.

    Attributes:
        bodies: Bodies without the world.
        moving_bodies: Bodies moved by their own joint or by one further up.
        degrees_of_freedom: Degrees of freedom of the whole scene.
        tool_degrees_of_freedom: Degrees of freedom of the grip's kinematic tree.
        tool_mass: Mass in kg of the grip's kinematic tree.
        geoms: Number of geoms by role, see ``USES``; with a motion, only contacts that occurred
            count.
        triangles: Triangles of the convex hulls of all meshes that collide.
        possible_pairs: Pairs of geoms that may collide.
        met_pairs: Pairs that collided in the motion; None without a motion.
        rows: Largest and median number of constraint rows per step, by kind; None without a motion.
        stiffness: Smallest and largest contact stiffness of the tool in N/m under a perceptible
            force; None without such a contact.
        deepest: Largest penetration of the tool in m; 0 without a contact.
        bounces: Contacts and limits that bounce.
        actuators: Actuators of the scene itself.
        equalities: Equality constraints.
        tendons: Tendons.
        flexes: Flexes; contacts with them are not counted by geom.
        idle: Elements that cannot influence the grip.
    """

    bodies: int
    moving_bodies: int
    degrees_of_freedom: int
    tool_degrees_of_freedom: int
    tool_mass: float
    geoms: dict[str, int]
    triangles: int
    possible_pairs: int
    met_pairs: int | None
    rows: dict[str, tuple[int, float]] | None
    stiffness: tuple[float, float] | None
    deepest: float
    bounces: tuple[Bounce, ...]
    actuators: int
    equalities: int
    tendons: int
    flexes: int
    idle: tuple[Idle, ...]


def take_inventory(
    model: mujoco.MjModel, grip: str, places: Places, observation: Observation | None = None
) -> Inventory:
    """Counts the parts of a scene.

    Args:
        model: The compiled scene; the bridge's handle, if present, is not counted.
        grip: Name of the site on the tool.
        places: Lines of the files on which elements are written.
        observation: Result of a motion; None counts every possible contact as met.
    """
    own = np.array([model.body(i).name != HANDLE for i in range(model.nbody)])
    own[0] = False
    tool = int(model.body_treeid[model.site(grip).bodyid[0]])
    is_tool = (model.body_treeid == tool) if tool >= 0 else np.zeros(model.nbody, dtype=bool)
    possible = {(min(a, b), max(a, b)) for a, b, _ in meeting_pairs(model)}
    met = possible if observation is None else set(observation.meetings)
    uses = _uses(model, is_tool, possible, met)
    of_tool = is_tool[model.geom_bodyid]
    touching = [
        meeting
        for pair, meeting in (observation.meetings if observation else {}).items()
        if of_tool[list(pair)].any()
    ]
    carried = [meeting for meeting in touching if np.isfinite(meeting.softest)]
    names = [model.actuator(i).name for i in range(model.nactuator)]
    return Inventory(
        bodies=int(own.sum()),
        moving_bodies=int((own & (model.body_treeid >= 0)).sum()),
        degrees_of_freedom=int(model.nv),
        tool_degrees_of_freedom=int(model.body_dofnum[is_tool].sum()),
        tool_mass=float(model.body_mass[is_tool].sum()),
        geoms={use: uses.count(use) for use in USES},
        triangles=_hull_triangles(model, uses),
        possible_pairs=len(possible),
        met_pairs=None if observation is None else len(met),
        rows=None if observation is None else _rows(observation),
        stiffness=(
            min(meeting.softest for meeting in carried),
            max(meeting.stiffest for meeting in carried),
        )
        if carried
        else None,
        deepest=max((meeting.deepest for meeting in touching), default=0.0),
        bounces=bounces(model),
        actuators=sum(name not in COUPLING_ACTUATORS for name in names),
        equalities=int(model.neq),
        tendons=int(model.ntendon),
        flexes=int(model.nflex),
        idle=_idle(model, tool, places, uses, met, "" if observation is None else " in the motion"),
    )


def geom_uses(model: mujoco.MjModel) -> list[str]:
    """Returns the role of every geom by its collision masks and pairs, without regard to a tool."""
    possible = {(min(a, b), max(a, b)) for a, b, _ in meeting_pairs(model)}
    return _uses(model, np.zeros(model.nbody, dtype=bool), possible, possible)


def _uses(
    model: mujoco.MjModel,
    is_tool: NDArray[np.bool_],
    possible: set[tuple[int, int]],
    met: set[tuple[int, int]],
) -> list[str]:
    of_tool = is_tool[model.geom_bodyid]
    meets_tool, meets = np.zeros((2, model.ngeom), dtype=bool)
    for first, second in met:
        meets[[first, second]] = True
        meets_tool[second] |= of_tool[first]
        meets_tool[first] |= of_tool[second]
    paired = {geom for pair in possible for geom in pair}
    masks = (model.geom_contype | model.geom_conaffinity) != 0
    moves = model.body_treeid[model.geom_bodyid] >= 0
    uses = []
    for geom in range(model.ngeom):
        if not masks[geom] and geom not in paired:
            uses.append(VISUAL)
        elif of_tool[geom]:
            uses.append(TOOL)
        elif meets_tool[geom]:
            uses.append(MEETS_TOOL)
        elif meets[geom]:
            uses.append(MEETS_OTHER)
        else:
            uses.append(MOVING if moves[geom] else FIXED)
    return uses


def _rows(observation: Observation) -> dict[str, tuple[int, float]]:
    rows = observation.rows.items()
    return {kind: (int(each.max()), float(np.median(each))) for kind, each in rows}


def _hull_triangles(model: mujoco.MjModel, uses: list[str]) -> int:
    """Counts triangles of the convex hulls, which are what MuJoCo collides."""
    meshes = {
        int(model.geom_dataid[geom])
        for geom in range(model.ngeom)
        if uses[geom] != VISUAL and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
    }
    graphs = [int(model.mesh_graphadr[mesh]) for mesh in meshes]
    # a graph begins with its numbers of vertices and of faces
    return sum(int(model.mesh_graph[adr + 1]) for adr in graphs if adr >= 0)


def _idle(
    model: mujoco.MjModel,
    tool: int,
    places: Places,
    uses: list[str],
    met: set[tuple[int, int]],
    when: str,
) -> tuple[Idle, ...]:
    """Lists the elements without a chain of contacts, equality constraints or tendons to the tool.

    A fixed body ends a chain: two things on one table do not influence each other through it.
    """
    tree = model.body_treeid
    reached = reached_trees(model, tool, met)
    idle = [
        Idle(places.find("body", body), f"never touches the tool, nor what moves it{when}")
        for body in range(1, model.nbody)
        if tree[body] >= 0 and int(tree[body]) not in reached
    ]
    touched = {
        geom
        for pair in met
        for geom in pair
        if any(int(tree[model.geom_bodyid[other]]) in reached for other in pair)
    }
    for geom, use in enumerate(uses):
        group = int(tree[model.geom_bodyid[geom]])
        if use == VISUAL:
            idle.append(Idle(places.find("geom", geom), VISUAL))
        elif not model.nflex and geom not in touched and (group < 0 or group in reached):
            still = "never meets anything"
            if group < 0:
                still = "fixed, and never met by the tool, nor by what moves it"
            idle.append(Idle(places.find("geom", geom), f"{still}{when}"))
    return tuple(idle)
