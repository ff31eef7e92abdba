"""A version of a scene under simplification, and its trace along a motion."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import samples_of
from hapticbridge.check.observe import WITHOUT_DISTANCE, Playback, may_be_near, not_finite, rehearse
from hapticbridge.demand.rehearsal import RunPoint, rehearsal_parameters
from hapticbridge.device import Motion
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.scene import Scene, SceneSource, compile_scene
from hapticbridge.scene.contacts import meeting_pairs
from hapticbridge.scene.physics import pose_in, rotation_vector


@dataclass(slots=True)
class SceneVariant:
    """A version of a scene.

    Attributes:
        source: Scene source whose specification belongs to this draft alone and may be changed.
        grip: Name of the site on the tool.
        setting: Coupling and rate.
    """

    source: SceneSource
    grip: str
    setting: RunPoint

    @property
    def spec(self) -> mujoco.MjSpec:
        """MuJoCo's specification, without handle and coupling."""
        return self.source.spec

    def copy(self) -> SceneVariant:
        """Returns a draft with a specification of its own."""
        return SceneVariant(self.with_spec(self.spec.copy()), self.grip, self.setting)

    def with_spec(self, spec: mujoco.MjSpec) -> SceneSource:
        """Returns the source with another specification."""
        return replace(self.source, spec=spec)

    def compiled(self) -> Scene:
        """Returns the scene with handle and coupling.

        Raises:
            SceneError: It does not compile or cannot be coupled to a device.
        """
        return compile_scene(self.source, self.grip, warns=False)

    def samples(self, motion: Motion) -> NDArray[np.void]:
        """Returns the motion sampled at this draft's rate."""
        return samples_of(motion, self.setting.period)

    def rehearsed(self, motion: Motion) -> Playback:
        """Compiles the scene and leads it through a motion.

        Raises:
            SceneError: It does not compile, or a result is not finite.
        """
        return rehearse(self.compiled(), self.samples(motion), self.setting)


def name_everything(spec: mujoco.MjSpec) -> None:
    """Names every unnamed body, joint and geom, so that a later edit finds it.

    Ids change as soon as an earlier element is deleted. The name of a joint or geom starts with its
    body's name.
    """
    for kind, elements in (("body", spec.bodies), ("joint", spec.joints), ("geom", spec.geoms)):
        taken = {element.name for element in elements}
        for number, element in enumerate(elements):
            if not element.name:
                stem = f"{kind}_{number}" if kind == "body" else f"{element.parent.name}_{kind}"
                numbered = (f"{stem}_{k}" for k in itertools.count(2))
                free = (name for name in itertools.chain([stem], numbered) if name not in taken)
                element.name = next(free)
                taken.add(element.name)


def model_of(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a copy of a specification, without checks of its start."""
    return spec.copy().compile()


def census(model: mujoco.MjModel) -> tuple[int, ...]:
    """Counts the elements that MuJoCo drops together with a body, joint or geom they refer to."""
    kinds = (
        "sensor",
        "actuator",
        "eq",
        "tendon",
        "pair",
        "exclude",
        "tuple",
        "skin",
        "flex",
        "site",
        "cam",
        "light",
    )
    return tuple(int(getattr(model, f"n{kind}")) for kind in kinds)


# Motion trace: pairs that came near, joint travel, start pose

CLEARANCE = 2e-3
"""Distance in m that geoms must keep throughout to count as never meeting. A larger value
simplifies less, and the result holds for motions that differ more."""

LOOK_EVERY = 5e-3
"""Time in s between distance checks; contacts are checked in every tick. A tool that crosses
``CLEARANCE`` unseen would have to move at 0.4 m/s or more."""

Pair = frozenset[str]


@dataclass(slots=True)
class MotionTrace:
    """Motion trace, by name.

    Attributes:
        possible: Pairs of geoms that MuJoCo's filters let collide.
        near: Pairs that met or came nearer than ``CLEARANCE``; with a flex also each geom alone.
        travel: Displacement from the start, by joint: m or rad, shape (looks, 1); ball joint:
            rotation vectors (looks, 3); free joint: displacements in m and rotation vectors in the
            world frame (looks, 6).
        start: Joint values at the start of the motion, by joint.
        pose: Position in m and quaternion in the parent's frame at the start, shape (7,), by body.
        solver_iterations: Largest number of iterations in a step.
    """

    possible: set[Pair] = field(default_factory=set)
    near: set[Pair] = field(default_factory=set)
    travel: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    start: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    pose: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    solver_iterations: int = 0

    @property
    def near_geoms(self) -> set[str]:
        """Geoms that met another or came near it."""
        return {name for pair in self.near for name in pair}


def witness(draft: SceneVariant, motion: Motion) -> MotionTrace:
    """Leads a scene through a motion tick by tick and records its trace.

    All bodies, joints and geoms of the draft need names.

    Raises:
        SceneError: The scene does not compile, or a result is not finite.
    """
    scene, setting = draft.compiled(), draft.setting
    model, data = scene.model, scene.data
    binding = BoundKernel(model, data, rehearsal_parameters(scene, setting))
    samples = draft.samples(motion)
    row = np.zeros(1, TICK_DTYPE)
    seen = MotionTrace(start=_joint_values(model, data), pose=_poses(model, data))
    pairs = np.array([pair[:2] for pair in meeting_pairs(model)], np.int64).reshape(-1, 2)
    names = [model.geom(g).name for g in range(model.ngeom)]
    seen.possible = {frozenset((names[a], names[b])) for a, b in pairs}
    if model.nflex:  # distances to a flex are not measured: every geom counts as near to it
        seen.near |= {frozenset((name,)) for name in names}
    looks: dict[str, list[NDArray[np.float64]]] = {name: [] for name in seen.start}
    every = max(1, round(LOOK_EVERY / setting.period))
    for k in range(samples.size):
        if not simulate(binding.state, samples[k : k + 1], binding.row, row):
            raise not_finite(scene, k, samples.size)
        seen.solver_iterations = max(seen.solver_iterations, int(row["solver_iterations"][0]))
        if data.ncon:
            touching = [pair for pair in data.contact.geom.tolist() if min(pair) >= 0]
            seen.near |= {frozenset((names[a], names[b])) for a, b in touching}
        if k % every == 0:
            pairs = _look_at_pairs(model, data, pairs, names, seen.near)
            for name, values in _joint_values(model, data).items():
                looks[name].append(_way(seen.start[name], values))
    seen.travel = {name: np.array(ways) for name, ways in looks.items()}
    return seen


def _look_at_pairs(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    pairs: NDArray[np.int64],
    names: list[str],
    near: set[Pair],
) -> NDArray[np.int64]:
    """Adds the pairs that are near each other now; returns those that never were."""
    is_far = np.ones(len(pairs), dtype=bool)
    for i in np.flatnonzero(may_be_near(data, pairs, CLEARANCE)).tolist():
        a, b = pairs[i].tolist()
        pair = frozenset((names[a], names[b]))
        if pair in near or _distance(model, data, a, b) < CLEARANCE:
            near.add(pair)
            is_far[i] = False
    return pairs[is_far]


def _distance(model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int) -> float:
    """Returns the distance of two geoms in m; 0 where MuJoCo has no function for it."""
    if any(model.geom_type[geom] in WITHOUT_DISTANCE for geom in (a, b)):
        return 0.0
    return float(mujoco.mj_geomDistance(model, data, a, b, 2.0 * CLEARANCE, None))


def _joint_values(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, NDArray[np.float64]]:
    names = [model.joint(j).name for j in range(model.njnt)]
    values = np.split(data.qpos.copy(), model.jnt_qposadr[1:])
    return dict(zip(names, values[: len(names)], strict=True))


def _poses(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, NDArray[np.float64]]:
    world = [np.concatenate([data.xpos[b], data.xquat[b]]) for b in range(model.nbody)]
    return {
        model.body(b).name: pose_in(world[model.body_parentid[b]], world[b])
        for b in range(1, model.nbody)
    }


def _way(start: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.float64]:
    if start.size == 1:
        return now - start
    vector = rotation_vector(start[-4:], now[-4:])
    return vector if start.size == 4 else np.concatenate([now[:3] - start[:3], vector])
