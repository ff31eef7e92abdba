"""The start of a run, rehearsed: what holds the tool at rest, and whether the device can.

A tool has a weight, and springs, motors or other parts of the scene may push it. The coupling has
to carry that from the first tick on, or the tool would sag, kick or topple in the hand.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import (
    WARNINGS,
    Scheme,
    added_actuators,
    coupling_ids,
    handle_ids,
    held_body,
    warning_words,
)
from hapticbridge.kernel.jit import direct, source_of
from hapticbridge.kernel.law import Spring, secant_stiffness
from hapticbridge.kernel.lossless import tree_of_tool
from hapticbridge.kernel.mujoco_c import quiet, warning_at
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.pose import IDENTITY_POSE
from hapticbridge.kernel.rigid_contact import finish_contacts
from hapticbridge.kernel.state import BoundKernel, Place
from hapticbridge.scene import Scene
from hapticbridge.scene.compile import clause
from hapticbridge.scene.handle import PROBE
from hapticbridge.scene.physics import quaternion_of

AT_REST = 1e-6
"""Largest acceleration in m/s² or rad/s² of a tool that rests without a hand. Rounding leaves less;
a smaller value would start every scene by looking for a load of nothing."""

SETTLING_STEPS = 3000
"""Largest number of steps in which a tool settles on its coupling. A tool of 1 kg on 2400 N/m takes
a tenth of it."""

SETTLED = 1e-3
"""Largest relative change of the coupling's wrench over the last steps of a tool that has
settled; no unit."""

LIGHT = 0.1
"""Wrench in N and N m below which changes are measured against it. A tool that rests on a table
has no load to compare with."""

MAX_WORK, MIN_STEPS = 6e5, 100
"""Largest work of one rehearsal in degrees of freedom and constraint rows, summed over its steps,
and the steps that it always takes. A unit costs 3 to 7 µs: a scene of 130 takes all steps, one of
400 half of them. More would let heavy scenes start later; a limit in seconds would give another
start on another machine, and the audit could not repeat it."""

TRIAL_STEPS = 50
"""Steps in which a load must prove better than none. A longer trial would judge the motion of a
tool that hangs on its grip, not its start."""


class Rehearsal:
    """The start of a run on a copy of the scene's data, with the handle held still.

    Contacts and limits are those of the run: rigid ones that are violated at the start hold the
    tool, but do not push it out.

    Args:
        scene: The prepared scene, at its start; its model is set back at the end of ``steps``.
        parameters: Parameters of the run.
    """

    def __init__(self, scene: Scene, parameters: RunParameters) -> None:
        self.model, self.data = scene.model, mujoco.MjData(scene.model)
        mujoco.mj_copyData(self.data, scene.model, scene.data)
        self._parameters = replace(parameters, scheme=Scheme.IMPLICIT, substeps=1)
        self._place, self._joint = Place(scene.hand), scene.joint
        own = coupling_ids(self.model, scene.hand)
        self._actuator, first = own[0], self.model.actuator_outadr[own[0]]
        self._outputs = slice(first, first + len(own))
        self._handle = handle_ids(self.model).get(scene.hand, -1)

    def steps(self, handle: tuple[float, ...], count: int) -> Generator[NDArray[np.float64]]:
        """Yields the coupling's wrench (6,) on the tool in each step, in the handle's axes.

        It ends early if the scene diverges, or after ``MAX_WORK``.

        Args:
            handle: Pose of the handle.
            count: Largest number of steps.

        Raises:
            SceneError: MuJoCo stopped, or warned (``codes.WARNINGS``).
        """
        data, bias = self.data, self.model.actuator_biasprm[self._actuator].copy()
        if self._joint < 0:
            mocap = self.model.body_mocapid[self._handle]
            data.mocap_pos[mocap], data.mocap_quat[mocap] = handle[:3], handle[3:]
        else:
            self.model.actuator_biasprm[self._actuator, 0] = -bias[1] * handle[0]
        bound = BoundKernel(self.model, data, self._parameters, place=self._place)
        record, step = bound.state[0], bound.step
        finish, work = direct(finish_contacts, record), 0
        address = int(record["mj"]["warnings"])
        warning = direct(warning_at, address)
        try:
            for done in range(count):
                with quiet():
                    step(self.model, data)
                code = warning(address)
                if code in WARNINGS:
                    raise SceneError(f"while the tool settles {warning_words(code)}")
                finish(record)
                work += self.model.nv + data.nefc
                is_long = work > MAX_WORK and done >= MIN_STEPS
                if is_long or not np.all(np.abs(data.qvel) <= mujoco.mjMAXVAL):
                    return
                wrench, forces = np.zeros(6), data.actuator_force[self._outputs]
                wrench[: len(forces)] = forces
                yield wrench
        except mujoco.FatalError as error:
            raise SceneError(f"MuJoCo stopped while the tool settled: {clause(error)}") from None
        finally:
            bound.release()
            self.model.actuator_biasprm[self._actuator] = bias


def static_load(
    scene: Scene, parameters: RunParameters, *, has_weight: bool = True, is_lifted: bool = False
) -> NDArray[np.float64]:
    """Returns the wrench that holds the tool of a prepared scene at rest, (6,) in N and N m.

    World frame, about the grip. The tool settles on the coupling with the handle at its grip; its
    motion is stopped whenever its kinetic energy has passed a peak (dynamic relaxation with kinetic
    damping). The scene itself is not changed. Zero if the tool rests without a hand, or does not
    settle because the scene moves it.

    Args:
        scene: The prepared scene, at its start.
        parameters: Parameters of the run.
        has_weight: If false, gravity is left out.
        is_lifted: If true, contacts, limits and dry friction hold nothing.
    """
    with _gravity(scene.model, is_on=has_weight), _holders(scene.model, is_on=not is_lifted):
        return _settled_load(scene, parameters)


_HOLDERS = int(
    mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_LIMIT
    | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
)


@contextmanager
def _holders(model: mujoco.MjModel, *, is_on: bool) -> Iterator[None]:
    """Lets contacts, limits and dry friction hold what they can, or nothing, for a while."""
    flags = model.opt.disableflags
    try:
        model.opt.disableflags |= 0 if is_on else _HOLDERS
        yield
    finally:
        model.opt.disableflags = flags


@contextmanager
def _gravity(model: mujoco.MjModel, *, is_on: bool) -> Iterator[None]:
    """Lets a model have its gravity, or none, for a while."""
    gravity = model.opt.gravity.copy()
    try:
        model.opt.gravity *= is_on
        yield
    finally:
        model.opt.gravity = gravity


@contextmanager
def _motors(model: mujoco.MjModel, *, is_on: bool) -> Iterator[None]:
    """Lets a model's own actuators give forces, or none, for a while."""
    limited, limits = model.actuator_forcelimited.copy(), model.actuator_forcerange.copy()
    own = [i for i in range(model.nactuator) if i not in added_actuators(model) and not is_on]
    try:
        model.actuator_forcelimited[own], model.actuator_forcerange[own] = 1, 0.0
        yield
    finally:
        model.actuator_forcelimited[:], model.actuator_forcerange[:] = limited, limits


def _settled_load(scene: Scene, parameters: RunParameters) -> NDArray[np.float64]:
    rehearsal, grip = Rehearsal(scene, parameters), scene.grip_pose()
    model, data = rehearsal.model, rehearsal.data
    dofs = tree_of_tool(model, held_body(model, scene.grip)).dofs
    momentum, last, load = np.zeros(model.nv), 0.0, np.zeros(6)
    with closing(rehearsal.steps(grip, SETTLING_STEPS)) as steps:
        for count, wrench in enumerate(steps):
            if np.abs(data.qvel).max(initial=0.0) < AT_REST * model.opt.timestep:
                return _turned(grip, wrench)
            velocity = np.where(dofs, data.qvel, 0.0)
            mujoco.mj_mulM(model, data, momentum, velocity)
            kinetic = 0.5 * float(velocity @ momentum)
            if kinetic < last:
                data.qvel[dofs], kinetic = 0.0, 0.0
            last = kinetic
            if count % 100 == 99:
                change, load = np.linalg.norm(wrench - load), wrench
                if change <= SETTLED * max(float(np.linalg.norm(load)), LIGHT):
                    return _turned(grip, wrench)
    return np.zeros(6)


def _turned(pose: tuple[float, ...], wrench: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a wrench in the axes of a pose, in those of the world."""
    result, orientation = np.zeros((2, 3)), np.array(pose[3:])
    for half, part in zip(result, wrench.reshape(2, 3), strict=True):
        mujoco.mju_rotVecQuat(half, part, orientation)
    return result.ravel()


def start_handle(
    scene: Scene, parameters: RunParameters, load: NDArray[np.float64]
) -> tuple[float, ...]:
    """Returns the handle pose (7,) at which the coupling carries the tool from the start on.

    The coupling carries a load as far as its force level goes. A tool that can move far while its
    grip is held, such as a robot that falls beside its foot, needs another wrench at its start than
    when it has come to rest. The handle then starts at the grip: of both poses the one is taken
    from which the coupling's energy strays less at first.

    Args:
        scene: The prepared scene, at its start.
        parameters: Parameters of the run.
        load: Result of ``static_load``.
    """
    coupling, grip = parameters.coupling, scene.grip_pose()
    levels = np.array(parameters.levels_on_tool)
    carried = load * np.repeat(levels / np.maximum(wrench_sizes(load), levels), 3)
    poses = loaded_handle(grip, carried, parameters), grip
    if poses[0] == grip:
        return grip
    stiffness = np.repeat([coupling.stiffness, coupling.rotational_stiffness], 3)
    has_spring, strays = stiffness > 0.0, []
    for pose in poses:
        wrenches = np.array(list(Rehearsal(scene, parameters).steps(pose, TRIAL_STEPS)))
        change = (wrenches - wrenches[:1]).reshape(-1, 6)[:, has_spring]
        strayed = (change**2 / stiffness[has_spring]).sum(axis=1)
        strays.append(float(strayed.max()) if len(wrenches) == TRIAL_STEPS else math.inf)
    return poses[int(np.argmin(strays))]


HOLDING_STEPS = 1000
"""Steps in which a device must hold a tool with a still hand. A longer trial would also find tools
that tip over slowly, and delay every start."""


def holding_wrench(
    scene: Scene, parameters: RunParameters, *, has_weight: bool = True, has_motors: bool = True
) -> NDArray[np.float64]:
    """Returns the largest force in N and torque in N m with which a still handle holds the tool.

    They are those of the first ``HOLDING_STEPS``, about the grip, shape (2,). The coupling is not
    limited, and the tool moves freely on it. The scene is not changed.

    Args:
        scene: The prepared scene, at its start.
        parameters: Parameters of the run; a handle with absolute poses is taken at the grip.
        has_weight: If false, gravity is left out.
        has_motors: If false, the scene's own actuators give no force.
    """
    handle = parameters.handle_origin
    if handle == IDENTITY_POSE or not (has_weight and has_motors):
        handle = scene.grip_pose()
    with _gravity(scene.model, is_on=has_weight), _motors(scene.model, is_on=has_motors):
        steps = Rehearsal(scene, parameters).steps(handle, HOLDING_STEPS)
        sizes = np.array([(0.0, 0.0), *map(wrench_sizes, steps)])
    return np.asarray(sizes.max(axis=0))


TIPPED = 0.1
"""Distance in m by which the grip of a tool that topples is moved, that of a hand that lets it go.
Farther away a tool pulls more, and one that a device can hold longer would be carried."""

SLOWEST_TOPPLING = 1.0
"""Rate in 1/s from which a tool topples. A hand leads a slower one, such as a pole of 15 m."""

MIN_LEVER = 1e-3
"""Way of the grip over the way of the joints in a mode, in m, below which the mode leaves the grip
where it is, and the hand cannot feel it."""

RESTING = 1.0
"""Acceleration in m/s² of a grip, a tenth of gravity's, below which a tool without hand stands."""


def toppling_force(scene: Scene, parameters: RunParameters) -> float:
    """Returns the force in N with which a still hand holds a tool that has toppled in it.

    A tool stands without a hand if no contact or other constraint holds it and its grip hardly
    accelerates. It topples if the stiffness of its tree, of gravity, springs and servos but without
    the coupling,

        K_t = −∂Q/∂q,    K_t φ = λ M φ,    rate = √−λ

    has a rate above ``SLOWEST_TOPPLING``; Q are the generalised forces, M the inertia matrix. K_t
    is not symmetric where a motor's force turns with the tool, as the thrust of a rotor does. The
    handle then holds the grip at ``TIPPED`` along the fastest mode φ. Zero if it does not topple,
    or the mode does not move the grip, or a joint is held.

    Args:
        scene: The prepared scene, at its start; it is not changed.
        parameters: Parameters of the run.
    """
    if scene.joint >= 0:
        return 0.0
    rehearsal, site = Rehearsal(scene, parameters), scene.model.site(scene.grip).id
    model, data = rehearsal.model, rehearsal.data
    dofs = np.flatnonzero(tree_of_tool(model, int(model.site_bodyid[site])).dofs)
    jacobian, mass = np.zeros((3, model.nv)), np.zeros((model.nv, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, site)
    is_held = np.any(data.qfrc_constraint[dofs])
    if is_held or np.linalg.norm(jacobian[:, dofs] @ data.qacc[dofs]) > RESTING:
        return 0.0
    mujoco.mj_fullM(model, data, mass)
    stiffness = stiffness_without_hand(model, data, dofs)
    squares, modes = np.linalg.eig(np.linalg.solve(mass[np.ix_(dofs, dofs)], stiffness))
    fastest = int(np.argmin(squares.real))
    mode = np.zeros(model.nv)
    mode[dofs] = modes[:, fastest].real
    way = float(np.linalg.norm(jacobian @ mode))
    is_slow = squares[fastest].real > -(SLOWEST_TOPPLING**2)
    if is_slow or way < MIN_LEVER * float(np.linalg.norm(mode)):
        return 0.0
    mujoco.mj_integratePos(model, data.qpos, mode, TIPPED / way)
    mujoco.mj_kinematics(model, data)
    orientation = quaternion_of(data.site_xmat[site])
    handle = (*data.site_xpos[site].tolist(), *orientation.tolist())
    wrenches = np.array(list(rehearsal.steps(handle, HOLDING_STEPS)))
    return float(np.linalg.norm(wrenches.reshape(-1, 6)[:, :3].mean(axis=0)))  # it swings


def stiffness_without_hand(
    model: mujoco.MjModel, data: mujoco.MjData, dofs: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Returns −∂Q/∂q of some degrees of freedom at rest, without coupling and constraints.

    Args:
        model: The prepared scene; it is not changed.
        data: Its state at rest; the positions are kept.
        dofs: Degrees of freedom q.
    """
    start, own, columns = data.qpos.copy(), list(added_actuators(model)), []
    bias = model.actuator_biasprm[own].copy()
    model.actuator_biasprm[own] = 0.0
    try:
        for unit in np.eye(model.nv)[dofs]:
            forces = []
            for size in (-PROBE, PROBE):
                data.qpos[:] = start
                mujoco.mj_integratePos(model, data.qpos, unit, size)
                for stage in (mujoco.mj_fwdKinematics, mujoco.mj_transmission):
                    stage(model, data)
                mujoco.mj_fwdVelocity(model, data)
                mujoco.mj_fwdActuation(model, data)
                forces.append((data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator)[dofs])
            columns.append((forces[0] - forces[1]) / (2.0 * PROBE))
    finally:
        model.actuator_biasprm[own] = bias
        data.qpos[:] = start
    return np.array(columns).T


def loaded_handle(
    grip: tuple[float, ...], load: NDArray[np.float64], parameters: RunParameters
) -> tuple[float, ...]:
    """Returns the handle pose (7,) at which the coupling carries a load on a tool at rest.

        h = x + f/K,    R_h = exp(τ/K_r) R_x

    K and K_r are those of the law at the load (``law.secant_stiffness``). ``grip`` is the tool's
    pose (7,), ``load`` the wrench (6,) in N and N m, up to the levels.
    """
    coupling, (force, torque) = parameters.coupling, wrench_sizes(load)
    secant, (level, level_r) = source_of(secant_stiffness), parameters.levels_on_tool
    position = np.array(grip[:3]) + load[:3] / secant(Spring(coupling.stiffness, level), force)
    orientation, turn = np.array(grip[3:]), np.zeros(4)
    if torque > 0.0 and coupling.rotational_stiffness > 0.0:
        angular = Spring(coupling.rotational_stiffness, level_r)
        twist = min(torque / secant(angular, torque), MAX_START_TWIST)
        mujoco.mju_axisAngle2Quat(turn, load[3:] / torque, twist)
        mujoco.mju_mulQuat(orientation, turn, np.array(grip[3:]))
    return (*position.tolist(), *orientation.tolist())


def wrench_sizes(wrench: NDArray[np.float64]) -> tuple[float, float]:
    """Returns the norms of a wrench's force and torque, in N and N m."""
    return float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))


def along(wrench: NDArray[np.float64], load: NDArray[np.float64]) -> tuple[float, float]:
    """Returns the parts of a wrench's force and torque along those of a load, in N and N m.

    Negative where the wrench is against the load, as a motor that lifts what the load is of.
    """
    sizes = np.maximum(wrench_sizes(load), np.finfo(float).tiny)
    force, torque = (wrench * load).reshape(2, 3).sum(axis=1) / sizes
    return float(force), float(torque)


MAX_START_TWIST = 1.0
"""Largest angle in rad by which the handle is turned at the start to carry the tool's weight. A
heavier tool sags; beyond a right angle the spring would lose its grip."""
