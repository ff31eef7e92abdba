"""Workloads without contact: a driven mass, a spinning body, and an arm on a spring."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from hapticbridge.check.perception import LEVER, tool_angles
from hapticbridge.coupling import Coupling
from hapticbridge.demand.pulse import FORCE_FLOOR
from hapticbridge.errors import StudyError
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.lab.chart.engine_run import work_of
from hapticbridge.lab.chart.scene_run import Prepared, Stages, Workload
from hapticbridge.lab.chart.score import Panel, PeerWork, Score, Take, diverged, score_of
from hapticbridge.lab.engines.base import Velocity
from hapticbridge.lab.maps.base import free_body, scene_of
from hapticbridge.scene import Scene, load_scene
from hapticbridge.theory.rigid_body import exact_mass_response, integrate_rotation

DRIVEN_MASS, DRIVEN_INERTIA = 0.1, 9e-6
"""Mass in kg and moment of inertia in kg m², about any axis, of the ball in
``models/point_mass``."""

FREQUENCY = 3.0
"""Frequency of the motion in Hz: brisk for a hand, far below the mass's resonance behind the
coupling."""

AMPLITUDE, TURN = 0.02, 0.3
"""Half of the stroke in m, and half of the angle in rad."""

DRIVEN_DURATION = 1.0
"""Duration in s: three periods."""

DIRECTION = np.array([0.6, 0.0, 0.8])
AXIS = np.array([0.0, 0.6, 0.8])
"""Unit vectors of translation and rotation; neither is a coordinate axis."""

DRIVEN_PANEL = Panel(
    "driven",
    "a mass moved and turned through the coupling",
    "closed form of a mass and of an inertia behind an unsampled spring and damper",
)


def handle_path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the pose of the handle: A (1 − cos ωt) along and about fixed axes, from rest."""
    wave = 1 - np.cos(2 * np.pi * FREQUENCY * times)
    turned = Rotation.from_rotvec(np.outer(TURN * wave, AXIS)).as_quat()[:, [3, 0, 1, 2]]
    return np.outer(AMPLITUDE * wave, DIRECTION), turned


def exact_response(
    stiffness: float, damping: float, mass: float, grid: float, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the exact motion behind an unsampled coupling whose handle does 1 − cos ωt.

        m x'' = K (h − x) + B (h' − x'),   x(0) = x'(0) = 0
        x = 1 − Re(H e^{jωt}) + x_h,   H = (K + jωB)/(K + jωB − m ω²)

    x_h is the free vibration that satisfies the initial conditions.

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


def exact_records(coupling: Coupling, grid: float) -> NDArray[np.void]:
    """Returns the records of an exact simulation at whole multiples of ``grid`` s."""
    count = round(DRIVEN_DURATION / grid)
    x, force = exact_response(coupling.stiffness, coupling.damping, DRIVEN_MASS, grid, count)
    angle, torque = exact_response(
        coupling.rotational_stiffness, coupling.rotational_damping, DRIVEN_INERTIA, grid, count
    )
    records = np.zeros(count, TICK_DTYPE)
    records["tool_position"] = np.outer(AMPLITUDE * x, DIRECTION)
    turned = Rotation.from_rotvec(np.outer(TURN * angle, AXIS))
    records["tool_quaternion"] = turned.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    records["wrench_on_tool"][:, :3] = np.outer(AMPLITUDE * force, DIRECTION)
    records["wrench_on_tool"][:, 3:] = np.outer(TURN * torque, AXIS)
    return records


class DrivenMass(Workload):
    """The driven point mass as a workload.

    Args:
        coupling: K and B.
        grid: Longest period T in s; records are compared at its multiples.
        finest: Shortest in s.
    """

    name = "point_mass"
    about = "a free mass moved and turned by the handle, without contact"
    panels: Sequence[Panel] = (DRIVEN_PANEL,)
    has_contact = False

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        self._grid = grid
        self._reference = exact_records(coupling, grid)
        self._finest = finest
        self._duration = grid * self._reference.size
        super().__init__(
            coupling,
            Stages(
                lambda: Prepared(load_scene("point_mass"), handle_path, self._duration, coupling)
            ),
        )

    def peer_work(self) -> PeerWork:
        """Describes the mass to other engines."""
        scene = load_scene("point_mass")
        return work_of(scene, handle_path, self._duration, self._finest, self.coupling, self._judge)


SPINNING_MASS = 0.3
"""Mass in kg."""
SPINNING_INERTIA = (1.5e-3, 3.63e-3, 4.53e-3)
"""Principal moments in kg m², all different: near those of a hand tool with a long handle."""

SPIN = (3.0, 20.0, 3.0)
"""Angular velocity at the start in rad/s, near the middle axis, about which the body tumbles."""

SPINNING_DURATION = 1.0
"""Duration in s: three turns and a flip."""

COUPLING = Coupling(1000.0, 1.0, 0.0, 0.0)
"""Coupling that holds the position, in N/m and N s/m, and leaves the rotation free."""

FELT_STIFFNESS = 1.0
"""Stiffness K_r in N m/rad, that of the other workloads, by which an error of angle is felt."""

FINE_STEP = 2e-6
"""T in s of the reference. The midpoint rule errs by some (ωT)²/12 of the angle: some 1e-9 rad."""

SPINNING_PANEL = Panel(
    "torque-free",
    "a body that tumbles without torque",
    f"mechanics' midpoint rule at {1e6 * FINE_STEP:g} µs, checked against SciPy's DOP853; the "
    f"angle counts as the torque that {FELT_STIFFNESS:g} N m/rad would make of it",
)


def spinning_scene() -> Scene:
    """Returns the body as a scene, at rest."""
    return scene_of(free_body(SPINNING_MASS, SPINNING_INERTIA))


def set_spinning(scene: Scene) -> None:
    """Gives the body its angular velocity; its axes are the world's at the start."""
    scene.data.qvel[3:6] = SPIN
    mujoco.mj_forward(scene.model, scene.data)


def still(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns a handle at rest."""
    quaternions = np.zeros((times.size, 4))
    quaternions[:, 0] = 1.0
    return np.zeros((times.size, 3)), quaternions


def exact_orientations(grid: float, count: int) -> NDArray[np.float64]:
    """Returns orientations at grid, 2 grid, … in s by the midpoint rule, shape (count, 4), w >= 0.

    Raises:
        StudyError: ``grid`` is no multiple of ``FINE_STEP``.
    """
    every = round(grid / FINE_STEP)
    if abs(every * FINE_STEP / grid - 1) > 1e-9:
        raise StudyError(f"{grid:g} s is no multiple of the reference's {FINE_STEP:g} s")
    motion = integrate_rotation(SPINNING_INERTIA, SPIN, FINE_STEP, every * count, "midpoint")
    orientation = motion.orientation[every::every]
    return np.where(orientation[:, :1] < 0, -orientation, orientation)


class SpinningBody(Workload):
    """The tumbling body as a workload.

    Args:
        coupling: K and B. K_r and B_r must be 0, because they would cause a torque.
        grid: Longest period T in s.
        finest: Shortest in s.

    Raises:
        StudyError: The coupling would turn the body.
    """

    name = "spinning_body"
    about = "a body with three moments of inertia tumbles freely, held in its place by the coupling"
    panels: Sequence[Panel] = (SPINNING_PANEL,)
    needs_tool = "lets no tool turn by itself"
    has_contact = False

    def __init__(self, coupling: Coupling, grid: float, finest: float) -> None:
        if coupling.rotational_stiffness or coupling.rotational_damping:
            raise StudyError("the spinning body must be free to turn: K_r and B_r must be 0")
        self._grid = grid
        self._finest = finest
        count = round(SPINNING_DURATION / grid)
        self._reference = np.zeros(count, TICK_DTYPE)
        self._reference["tool_quaternion"] = exact_orientations(grid, count)
        self._energy = 0.5 * float(np.sum(np.array(SPINNING_INERTIA) * np.square(SPIN)))
        super().__init__(
            coupling,
            Stages(
                lambda: Prepared(
                    spinning_scene(), still, grid * count, coupling, starts=(set_spinning,)
                )
            ),
        )

    def peer_work(self) -> PeerWork:
        """Describes the body to other engines, with its spin."""
        duration = self._grid * self._reference.size
        work = work_of(spinning_scene(), still, duration, self._finest, self.coupling, self._judge)
        spin = Velocity(angular=SPIN)
        return replace(work, tasks=(replace(work.tasks[0], start_velocity=spin),))

    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        (take,) = takes
        if take.has_diverged:
            return {SPINNING_PANEL.key: diverged(take.created, take.ended)}
        records = take.records_at(self._grid)
        score = score_of(
            self._reference,
            records,
            created=take.created,
            verdict=take.environment,
            energy=float(np.max(np.abs(records["kinetic"] - self._energy))),
        )
        torque = FELT_STIFFNESS * tool_angles(self._reference, records)
        turned = float(np.sqrt(np.mean(torque**2))) / (LEVER * FORCE_FLOOR)
        return {SPINNING_PANEL.key: replace(score, jnd=max(score.jnd, turned))}


ARM_LENGTH, ARM_INERTIA = 0.25, 0.0104
"""Length in m, and moment of inertia about the hinge in kg m², of a uniform arm of 0.5 kg."""

ARM_STIFFNESS, ARM_DAMPING = 31.0, 0.02
"""Stiffness in N m/rad and damping in N m s/rad of the hinge: 500 N/m at the grip."""

ARM_DURATION = 1.0
"""Duration in s: three strokes of the handle."""

ARM_PANEL = Panel(
    "swinging",
    "an arm on a hinge with a spring, led by its end",
    "SciPy's DOP853 of the hinge and an unsampled coupling, to 1e-10",
)

_ARM = f"""
<mujoco model="spring_arm">
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="arm">
      <joint type="hinge" axis="0 0 1" stiffness="{ARM_STIFFNESS!r}" damping="{ARM_DAMPING!r}"/>
      <inertial pos="0 0 0" mass="0.5"
        diaginertia="{ARM_INERTIA!r} {ARM_INERTIA!r} {ARM_INERTIA!r}"/>
      <geom type="sphere" size="0.01" mass="0" contype="0" conaffinity="0"/>
      <site name="grip" pos="{ARM_LENGTH!r} 0 0"/>
    </body>
  </worldbody>
</mujoco>"""


def led_across(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns a handle that moves along y, A (1 − cos ωt), and does not turn."""
    positions, quaternions = still(times)
    positions[:, 1] = AMPLITUDE * (1 - np.cos(2 * np.pi * FREQUENCY * times))
    return positions, quaternions


def exact_arm(coupling: Coupling, grid: float, count: int) -> NDArray[np.void]:
    """Returns the records of an exact simulation of the arm at grid, 2 grid, … in s.

    I q'' = −k q − d q' + (p × f)_z,    f = K (h − p) + B (h' − p'),    p = L (cos q, sin q)
    """
    omega = 2 * np.pi * FREQUENCY

    def force(time: float, angle: float, rate: float) -> tuple[NDArray[np.float64], ...]:
        place = ARM_LENGTH * np.array([np.cos(angle), np.sin(angle)])
        speed = rate * np.array([-place[1], place[0]])
        handle = np.array([ARM_LENGTH, AMPLITUDE * (1 - np.cos(omega * time))])
        handle_speed = np.array([0.0, AMPLITUDE * omega * np.sin(omega * time)])
        stretch, closing = handle - place, handle_speed - speed
        return place, coupling.stiffness * stretch + coupling.damping * closing

    def rates(time: float, state: NDArray[np.float64]) -> list[float]:
        angle, rate = state
        place, pull = force(time, angle, rate)
        torque = place[0] * pull[1] - place[1] * pull[0]
        torque -= ARM_STIFFNESS * angle + ARM_DAMPING * rate
        return [rate, torque / ARM_INERTIA]

    times = grid * np.arange(1.0, count + 1)
    solution = solve_ivp(
        rates, (0.0, times[-1]), [0.0, 0.0], "DOP853", t_eval=times, rtol=1e-10, atol=1e-12
    ).y
    records = np.zeros(count, TICK_DTYPE)
    for k, (time, angle, rate) in enumerate(zip(times, *solution, strict=True)):
        place, pull = force(time, angle, rate)
        records["tool_position"][k, :2], records["wrench_on_tool"][k, :2] = place, pull
    turned = Rotation.from_rotvec(np.outer(solution[0], (0.0, 0.0, 1.0))).as_quat(
        canonical=True, scalar_first=True
    )
    records["tool_quaternion"] = turned
    return records


class SpringArm(Workload):
    """The arm as a workload.

    Args:
        coupling: K and B. K_r and B_r must be 0, because the handle does not turn.
        grid: Longest period T in s.
    """

    name = "spring_arm"
    about = "an arm on a hinge with a spring, led across by its end"
    panels: Sequence[Panel] = (ARM_PANEL,)
    needs_tool = "lets no arm swing by itself"
    has_contact = False

    def __init__(self, coupling: Coupling, grid: float) -> None:
        self._grid, count = grid, round(ARM_DURATION / grid)
        self._reference = exact_arm(coupling, grid, count)
        super().__init__(
            coupling,
            Stages(lambda: Prepared(scene_of(_ARM), led_across, grid * count, coupling)),
        )

    def peer_work(self) -> PeerWork:
        """Refuses other engines, whose tasks have one free body.

        Raises:
            StudyError: Always.
        """
        raise StudyError("the arm has a hinge, and other engines are given free bodies alone")
