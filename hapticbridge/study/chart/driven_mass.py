"""Workload ``point_mass``: a free mass moved and turned through the coupling, in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.record import TICK_DTYPE
from hapticbridge.scene import load_scene
from hapticbridge.study.chart.engine_run import PeerWork, work_of
from hapticbridge.study.chart.scene_run import Stage, Stages, Take
from hapticbridge.study.chart.score import Score, diverged, score_of
from hapticbridge.study.chart.staged import Staged
from hapticbridge.study.chart.workload import Panel
from hapticbridge.theory.rigid_body import exact_mass_response

MASS, INERTIA = 0.1, 9e-6
"""Of the ball in ``models/point_mass`` in kg, and about any axis in kg m²."""

FREQUENCY = 3.0
"""Of the motion in Hz: brisk for a hand, far below the mass's resonance behind the coupling."""

AMPLITUDE, TURN = 0.02, 0.3
"""Half of the way in m, and half of the angle in rad."""

DURATION = 1.0
"""In s: three periods."""

DIRECTION = np.array([0.6, 0.0, 0.8])
AXIS = np.array([0.0, 0.6, 0.8])
"""Unit vectors, along which it moves and about which it turns; none is a coordinate axis."""

PANEL = Panel(
    "driven",
    "a mass moved and turned through the coupling",
    "closed form of a mass and of an inertia behind an unsampled spring and damper",
)


def handle_path(
    times: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns where the handle is: A (1 − cos ωt) along and about fixed axes, from rest."""
    wave = 1 - np.cos(2 * np.pi * FREQUENCY * times)
    turned = Rotation.from_rotvec(np.outer(TURN * wave, AXIS)).as_quat()[:, [3, 0, 1, 2]]
    return np.outer(AMPLITUDE * wave, DIRECTION), turned


def exact_response(
    stiffness: float, damping: float, mass: float, grid: float, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the exact motion behind an unsampled coupling whose handle does 1 − cos ωt.

        m x'' = K (h − x) + B (h' − x'),   x(0) = x'(0) = 0
        x = 1 − Re(H e^{jωt}) + x_h,   H = (K + jωB)/(K + jωB − m ω²)

    x_h is the free vibration that makes the start right.

    Args:
        stiffness: K in N/m, or N m/rad.
        damping: B.
        mass: m in kg, or kg m².
        grid: Time between samples in s, > 0.
        count: Samples at grid, 2 grid, …

    Returns:
        x and the force f = m x'' of the coupling, per unit of the handle's motion, shape (count,).
    """
    coupling = Coupling(stiffness, damping, 0.0, 0.0)
    response = complex(exact_mass_response(coupling, mass, FREQUENCY))
    omega = 2 * np.pi * FREQUENCY
    dynamics = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]])
    onward = np.asarray(expm(grid * dynamics))
    free = np.zeros((count, 2))
    state = -np.array([1 - response.real, (omega * response.imag)])
    for k in range(count):
        state = onward @ state
        free[k] = state
    wave = response * np.exp(1j * omega * grid * np.arange(1, count + 1))
    position = 1 - wave.real + free[:, 0]
    acceleration = omega**2 * wave.real + free @ dynamics[1]
    return position, mass * acceleration


def exact_records(coupling: Coupling, grid: float, mass: float = MASS) -> NDArray[np.void]:
    """Returns what an exact simulation would record at whole multiples of ``grid`` s."""
    count = round(DURATION / grid)
    x, force = exact_response(coupling.stiffness, coupling.damping, mass, grid, count)
    angle, torque = exact_response(
        coupling.rotational_stiffness, coupling.rotational_damping, INERTIA, grid, count
    )
    records = np.zeros(count, TICK_DTYPE)
    records["tool_position"] = np.outer(AMPLITUDE * x, DIRECTION)
    turned = Rotation.from_rotvec(np.outer(TURN * angle, AXIS))
    records["tool_quaternion"] = turned.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    records["wrench_on_tool"][:, :3] = np.outer(AMPLITUDE * force, DIRECTION)
    records["wrench_on_tool"][:, 3:] = np.outer(TURN * torque, AXIS)
    return records


class DrivenMass(Staged):
    """The workload.

    Args:
        coupling: K and B.
        grid: Longest period T in s; records are compared at its multiples.
        finest: Shortest in s.
    """

    name = "point_mass"
    about = "a free mass moved and turned by the handle, without contact"
    panels: Sequence[Panel] = (PANEL,)
    has_contact = False

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        self._grid = grid
        self._reference = exact_records(coupling, grid)
        self._finest = finest
        self._duration = grid * self._reference.size
        super().__init__(
            coupling,
            Stages(lambda: Stage(load_scene("point_mass"), handle_path, self._duration, coupling)),
        )

    def peer_work(self) -> PeerWork:
        """Describes the mass to other engines."""
        scene = load_scene("point_mass")
        return work_of(scene, handle_path, self._duration, self._finest, self.coupling, self._judge)

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        if take.has_diverged:
            return {PANEL.key: diverged(take.created, take.ended)}
        records = take.at(self._grid)
        return {
            PANEL.key: score_of(
                self._reference, records, created=take.created, verdict=take.environment
            )
        }
