"""A rig: a free tool with three moments of inertia, held by its centre, behind a handle that spins.

The handle's motion is prescribed, so that speed and angle are what a map asks for, and not what a
hand's dynamics make of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.options import run_parameters
from hapticbridge.pose import IDENTITY_POSE
from hapticbridge.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.rendering import METHODS, prepare
from hapticbridge.scene import Scene
from hapticbridge.study.maps.bisection import largest_stable
from hapticbridge.study.maps.rigs import free_body, loop_in, scene_of
from hapticbridge.study.maps.tumbling import INERTIA, MIDDLE, OBLIQUE, PERIOD, TICKS
from hapticbridge.summary import Ledger

MASS = 0.3
"""In kg."""

STIFFNESS, DAMPING = 2000.0, 0.5
"""K in N/m and B in N s/m of the coupling's translation: it only keeps the tool in its place."""

ROTATIONAL_DAMPING = 5e-4
"""B_r in N m s/rad; none where K_r = 0."""

DIVERGED = 1e3
"""Kinetic energy in J that ends a run: ten times what the tool has at 200 rad/s, so that it has
diverged beyond doubt, and before MuJoCo warns of numbers that are not finite."""

CHUNK = 2
"""Ticks after which that is looked at; five beyond it, MuJoCo would warn."""


@dataclass(frozen=True, slots=True, eq=False)
class Spin:
    """What a run with a spinning handle came to.

    Attributes:
        ticks: How many were done; fewer than ``TICKS`` where it diverged.
        environment: ``strict``, ``within slack`` or ``active``.
        created: The largest Σ E_k so far at any tick, in J.
        slack_share: Largest share of the slack that was used, without unit.
        first_active: Tick of the first violation of the slack, −1 for none.
        largest_angle: Between handle and tool in rad, at most π.
        crossed: Tick at which the angle had passed π since the tick before, −1 for never.
        torque_jump: Largest change of the torque on the tool within a tick in N m.
    """

    ticks: int
    environment: str
    created: float
    slack_share: float
    first_active: int
    largest_angle: float
    crossed: int
    torque_jump: float


def spin(
    method: str,
    coupling: Coupling,
    speed: float,
    *,
    angle: float = 0.0,
    axis: NDArray[np.float64] = OBLIQUE,
    spins_at_start: bool = True,
) -> Spin:
    """Turns the handle at a constant speed for 1 s, with the tool behind it.

    Args:
        method: One of ``rendering.METHODS`` that has a coupling.
        coupling: K and B.
        speed: Of the handle in rad/s.
        angle: By which the handle is ahead of the tool at the start, about x, in rad.
        axis: Of the handle's turning, in the world frame, shape (3,), of any length > 0.
        spins_at_start: Whether the tool turns with the handle from the start, or is at rest.

    Raises:
        HapticBridgeError: A value is out of range, or the method cannot render a free tool.
    """
    scene = loop_in(spinning_scene).scene
    chosen = METHODS[method]
    felt = prepare(scene, coupling, PERIOD, 1, chosen)
    quaternions = turning(speed, angle=angle, axis=axis)
    samples = np.zeros(TICKS, SAMPLE_DTYPE)
    samples["quaternion"] = quaternions[1:]
    if spins_at_start:
        _set_spin(scene, speed * axis / np.linalg.norm(axis))
    first = np.zeros(1, SAMPLE_DTYPE)
    first["quaternion"] = quaternions[0]
    parameters = run_parameters(scene, coupling, chosen, first, period=PERIOD, felt=felt)
    # the grip is where the device would be without the angle, not where it starts
    parameters = replace(parameters, device_origin=IDENTITY_POSE)
    binding = BoundKernel(scene.model, scene.data, parameters)
    records = np.zeros(TICKS, TICK_DTYPE)
    done = _run(binding, samples, records)
    return _read(binding, records[:done])


def turning(
    speed: float, *, angle: float = 0.0, axis: NDArray[np.float64] = OBLIQUE
) -> NDArray[np.float64]:
    """Returns the handle's unit quaternions (w, x, y, z) at the ticks, shape (``TICKS`` + 1, 4).

    Args:
        speed: In rad/s.
        angle: By which it is turned about x at the start, in rad.
        axis: Of the turning, in the world frame, shape (3,), of any length > 0.
    """
    time = PERIOD * np.arange(TICKS + 1)
    about = axis / np.linalg.norm(axis)
    turns = Rotation.from_rotvec(np.outer(speed * time, about)) * Rotation.from_rotvec(
        [angle, 0.0, 0.0]
    )
    return np.asarray(turns.as_quat(canonical=True)[:, [3, 0, 1, 2]])


def coupling_of(stiffness: float) -> Coupling:
    """Returns the coupling with a K_r in N m/rad; with 0 it does not hold the tool's turning."""
    return Coupling(STIFFNESS, DAMPING, stiffness, ROTATIONAL_DAMPING if stiffness else 0.0)


def sudden(method: str, stiffness: float, speed: float) -> Spin:
    """Turns the handle suddenly about the middle axis, with the tool at rest."""
    return spin(method, coupling_of(stiffness), speed, axis=MIDDLE, spins_at_start=False)


def speed_of_cut(method: str, stiffness: float) -> float:
    """Returns the speed in rad/s, 1 to 1000, at which a sudden turn winds the angle past π."""
    return largest_stable(
        lambda speed: sudden(method, stiffness, speed).crossed < 0, 1.0, 1000.0
    ).middle


def spinning_scene() -> Scene:
    """Loads the tool, floating free of gravity."""
    return scene_of(free_body(MASS, INERTIA))


def _set_spin(scene: Scene, omega: NDArray[np.float64]) -> None:
    scene.data.qvel[3:6] = omega  # the body's axes are the world's at the start
    mujoco.mj_forward(scene.model, scene.data)


def _run(binding: BoundKernel, samples: NDArray[np.void], records: NDArray[np.void]) -> int:
    for first in range(0, TICKS, CHUNK):
        part = slice(first, first + CHUNK)
        done = simulate(binding.state, samples[part], binding.row, records[part])
        if done < CHUNK or not binding.state["kinetic"][0] < DIVERGED:
            return first + done
    return TICKS


def _read(binding: BoundKernel, records: NDArray[np.void]) -> Spin:
    ledger = Ledger.of(binding.state)
    handle = Rotation.from_quat(records["handle_quaternion"][:, [1, 2, 3, 0]])
    tool = Rotation.from_quat(records["tool_quaternion"][:, [1, 2, 3, 0]])
    between = (handle * tool.inv()).as_rotvec()
    angles = np.linalg.norm(between, axis=1)
    # just before the cut and just behind it the rotation vectors point opposite ways
    opposite = np.sum(between[1:] * between[:-1], axis=1) < 0
    crossed = np.flatnonzero(opposite & (angles[1:] > np.pi / 2) & (angles[:-1] > np.pi / 2))
    jumps = np.linalg.norm(np.diff(records["wrench_on_tool"][:, 3:], axis=0), axis=1)
    return Spin(
        ticks=records.size,
        environment=ledger.environment,
        created=float(records["environment_energy"].max(initial=0.0)),
        slack_share=ledger.slack_share,
        first_active=-1 if ledger.first_active is None else ledger.first_active,
        largest_angle=float(angles.max(initial=0.0)),
        crossed=int(crossed[0]) + 1 if crossed.size else -1,
        torque_jump=float(jumps.max(initial=0.0)),
    )
