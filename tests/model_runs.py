"""Runs scenes of models/ behind a coupling, and meters them, without using the package.

The coupling is attached here by hand, wrench and works are computed from the recorded poses with
NumPy and SciPy: so this is a reference for the package, not a repetition of it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from hapticbridge.kernel.codes import HANDLE
from hapticbridge.scene import scene_names
from hapticbridge.scene.parameters import apply_parameters

Array: TypeAlias = NDArray[np.float64]
Edit: TypeAlias = Callable[[Any], object]

ROOT = Path(__file__).resolve().parent.parent
MODELS = ROOT / "models"

SLOW_SCENES = ("beads",)
"""Scenes too slow to step in every tick: 8 s of the beads at 1 kHz take a minute, and they are not
meant to run so. ``test_slow_scene`` runs them beside the loop."""

LOOP_SCENES = tuple(name for name in scene_names(1) if name not in SLOW_SCENES)

T = 1e-3
K, B = 2400.0, 0.5
K_R, B_R = 2.4, 5e-4

# height of the peg's centre above the mouth of the hole, in m
HOME_HEIGHT, BOTTOMED_HEIGHT = 0.04, -0.01


def spec_of(name: str) -> Any:
    return mujoco.MjSpec.from_file(str(MODELS / name / f"{name}.xml"))


def scene_set_to(name: str, **values: float) -> tuple[Any, Any]:
    """Returns a scene with a handle, in which the package wrote the values of parameters."""
    path = MODELS / name / f"{name}.xml"
    return scene_with_handle(name, lambda spec: apply_parameters(spec, path, values))


def scene_with_handle(name: str, edit: Edit | None = None) -> tuple[Any, Any]:
    """Compiles a scene with a handle at its grip and the coupling as site actuators."""
    spec = spec_of(name)
    if edit is not None:
        edit(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    position = data.site("grip").xpos.copy()
    handle = spec.worldbody.add_body(name=HANDLE, mocap=True, pos=position)
    handle.add_site(name=HANDLE)
    for axis in range(6):
        stiffness, damping = (K, B) if axis < 3 else (K_R, B_R)
        kind = mujoco.mjtTrn.mjTRN_SITE
        actuator = spec.add_actuator(trntype=kind, target="grip", refsite=HANDLE)
        actuator.gear = np.eye(6)[axis]
        actuator.gainprm[0] = damping
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm[1:3] = (-stiffness, -damping)
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY.value
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = model.key("home").qpos
    data.mocap_pos[0] = position
    mujoco.mj_forward(model, data)
    return model, data


@dataclass
class Run:
    """One run of a scene along handle poses; row k is tick k + 1."""

    handle: Array
    tool: Array
    rotation: Rotation
    force: Array
    torque: Array
    gained: Array  # E_k summed, in J
    slack: Array  # summed, in J
    work: Array  # |f·δx| + |τ·δφ| summed, in J
    touched: dict[str, NDArray[np.bool_]]  # per geom other than the tool's: in contact in tick k
    deepest: Array
    joints: Array  # qpos
    warnings: int
    data: Any


def stored_energy(model: Any, data: Any) -> float:
    """Kinetic plus potential energy of the present state (mj_step leaves the previous one's)."""
    for name in ("kinematics", "comPos", "crb", "comVel", "energyPos", "energyVel"):
        getattr(mujoco, f"mj_{name}")(model, data)
    return float(data.energy[0] + data.energy[1])


def run_along(model: Any, data: Any, handle: Array, turn: Rotation) -> Run:
    """Steps the scene once per handle pose, then computes wrench and energies from the poses."""
    start = data.mocap_pos[0].copy()
    d_handle = np.diff(handle, axis=0, prepend=start[None])
    before = Rotation.concatenate([Rotation.identity(), turn[:-1]])
    d_turn = (turn * before.inv()).as_rotvec()
    ctrl = np.hstack([turn.inv().apply(d_handle), turn.inv().apply(d_turn)]) / T
    quaternion = turn.as_quat(scalar_first=True)

    site = model.site("grip").id
    count = len(handle)
    tool, matrix = np.empty((count + 1, 3)), np.empty((count + 1, 9))
    energy, deepest = np.empty(count + 1), np.zeros(count)
    joints = np.empty((count, model.nq))
    tool[0], matrix[0] = data.site_xpos[site], data.site_xmat[site]
    energy[0] = stored_energy(model, data)
    names = [model.geom(i).name for i in range(model.ngeom)]
    touched = {name: np.zeros(count, dtype=bool) for name in names}
    for k in range(count):
        data.mocap_pos[0], data.mocap_quat[0], data.ctrl[:] = handle[k], quaternion[k], ctrl[k]
        mujoco.mj_step(model, data)
        if data.ncon:
            deepest[k] = -data.contact.dist.min()
            for geom in np.unique(data.contact.geom):
                touched[names[geom]][k] = True
        joints[k] = data.qpos
        energy[k + 1] = stored_energy(model, data)
        tool[k + 1], matrix[k + 1] = data.site_xpos[site], data.site_xmat[site]

    rotation = Rotation.from_matrix(matrix.reshape(-1, 3, 3))
    d_tool = np.diff(tool, axis=0)
    d_rotation = (rotation[1:] * rotation[:-1].inv()).as_rotvec()
    force = K * (handle - tool[1:]) + B / T * (d_handle - d_tool)
    torque = K_R * (turn * rotation[1:].inv()).as_rotvec() + B_R / T * (d_turn - d_rotation)
    by_force, by_torque = (force * d_tool).sum(axis=1), (torque * d_rotation).sum(axis=1)
    moved, turned = (d_tool**2).sum(axis=1), (d_rotation**2).sum(axis=1)
    return Run(
        handle=handle,
        tool=tool[1:],
        rotation=rotation[1:],
        force=force,
        torque=torque,
        gained=np.cumsum(np.diff(energy) - by_force - by_torque),
        slack=np.cumsum(0.5 * (K + B / T) * moved + 0.5 * (K_R + B_R / T) * turned),
        work=np.cumsum(np.abs(by_force) + np.abs(by_torque)),
        touched=touched,
        deepest=deepest,
        joints=joints,
        warnings=sum(warning.number for warning in data.warning),
        data=data,
    )


def path_of(name: str) -> Array:
    return np.loadtxt(MODELS / name / f"{name}.csv", delimiter=",", skiprows=1)


@functools.cache
def run_of_own_path(name: str) -> Run:
    return run_along_own_path(name, *scene_with_handle(name))


def run_along_own_path(name: str, model: Any, data: Any) -> Run:
    rows = path_of(name)
    times = np.arange(1, round(rows[-1, 0] / T) + 1) * T
    offset = np.stack([np.interp(times, rows[:, 0], rows[:, i]) for i in (1, 2, 3)], axis=1)
    turned = Slerp(rows[:, 0], Rotation.from_quat(rows[:, 4:], scalar_first=True))
    turn = turned(np.minimum(times, rows[-1, 0]))
    return run_along(model, data, data.mocap_pos[0] + offset, turn)


def moved_through(
    model: Any, data: Any, poses: Sequence[tuple[float, tuple[float, ...], tuple[float, ...]]]
) -> Run:
    """Moves the handle smoothly through (seconds, offset in m, rotation vector) and stops there."""
    last = np.zeros(6)
    pieces = []
    for seconds, offset, vector in poses:
        target = np.array([*offset, *vector])
        s = np.linspace(0.0, 1.0, round(seconds / T))[:, None]
        pieces.append(last + s**3 * (10 - 15 * s + 6 * s**2) * (target - last))
        last = target
    motion = np.vstack(pieces)
    turn = Rotation.from_rotvec(motion[:, 3:])
    return run_along(model, data, data.mocap_pos[0] + motion[:, :3], turn)


def swung(*angles: float) -> list[tuple[float, tuple[float, ...], tuple[float, ...]]]:
    """Poses of a handle 100 mm from a z axis, angle to angle in degrees, half a second each."""
    poses: list[tuple[float, tuple[float, ...], tuple[float, ...]]] = []
    for begin, end in pairwise((0.0, *angles)):
        # in short chords, because moved_through goes straight from pose to pose
        for angle in np.radians(np.linspace(begin, end, 11)[1:]):
            offset = (0.1 * (np.cos(angle) - 1), 0.1 * np.sin(angle), 0.0)
            poses.append((0.05, offset, (0.0, 0.0, float(angle))))
    return poses


def moment_about_axis(run: Run) -> Array:
    """Moment of the coupling's wrench about the world's z axis, in N m."""
    moment: Array = np.cross(run.tool, run.force)[:, 2] + run.torque[:, 2]
    return moment
