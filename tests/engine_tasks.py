"""Tasks whose outcome is known in closed form, for every engine alike."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from closed_forms import swing_from_rest
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device.trajectory import Motion
from hapticbridge.lab.engines.base import Body, Engine, Shape, Simulation, Task, available_engines

HERE = available_engines()
"""Engines of this installation; tests are collected for these alone."""

COUPLING = Coupling(
    stiffness=1000.0, damping=5.0, rotational_stiffness=2.0, rotational_damping=2e-3
)
AMPLITUDE, FREQUENCY, SECONDS = 0.01, 2.0, 0.5
MASS = 1.0
GRAVITY = 9.81


@contextmanager
def opened(engine: Engine, task: Task, timestep: float) -> Iterator[Simulation]:
    simulation = engine.open(task, timestep)
    try:
        yield simulation
    finally:
        simulation.close()


def driven_mass(timestep: float, mass: float = MASS) -> tuple[Task, NDArray[np.float64]]:
    """A mass at rest behind the coupling, whose handle begins to swing; and the handle's path."""
    times = np.arange(round(SECONDS / timestep) + 1) * timestep
    handle = AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * times)
    motion = Motion(times, np.column_stack([handle, 0 * handle, 0 * handle]))
    return Task("driven_mass", Body(mass, (1e-3,) * 3), coupling=COUPLING, handle=motion), handle


def driven_path(engine: Engine, timestep: float, mass: float = MASS) -> NDArray[np.float64]:
    task, _ = driven_mass(timestep, mass)
    poses = task.handle_poses(timestep, round(SECONDS / timestep))
    path = [0.0]
    with opened(engine, task, timestep) as simulation:
        for pose in poses[1:]:
            simulation.step(*pose)
            path.append(simulation.pose().position[0])
    return np.array(path)


def driven_error(engine: Engine, timestep: float, mass: float = MASS) -> float:
    """RMS error of the driven mass's position as a share of the handle's amplitude."""
    path = driven_path(engine, timestep, mass) / AMPLITUDE
    times = np.arange(path.size) * timestep
    return float(np.sqrt(np.mean(np.subtract(path, swing_from_rest(times, COUPLING, MASS)) ** 2)))


FLOOR = Shape("box", (0.2, 0.2, 0.05), (0.0, 0.0, -0.05))
EDGE = 0.02
LYING = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * EDGE
RESTING = {
    "box": (Shape("box", (0.03, 0.025, EDGE)), EDGE),
    "sphere": (Shape("sphere", (EDGE,)), EDGE),
    "capsule": (Shape("capsule", (EDGE, 0.03), quaternion=LYING), EDGE),
    "mesh": (Shape("mesh", (), vertices=CORNERS), EDGE),
}
"""A shape, and the height of its centre where it lies on the floor."""
