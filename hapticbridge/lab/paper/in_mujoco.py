"""Runs with MuJoCo in the loop: a free body behind the coupling, or under an applied force."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import IMPLICIT, prepare
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.run.options import RunSetup
from hapticbridge.scene import load_scene
from hapticbridge.theory.sampled_loop import WorstHand, threshold

_Array = NDArray[np.float64]

HEAVY = 1e9
"""Mass in kg of a tool that stands for a wall. A wall of 1e9 kg moves by 1e-12 of the handle."""

TICKS = 3000
"""Ticks of a run that must grow or decay. At Nyquist a device 0.1 % below the bound grows by e^6 in
them."""

KICK = 1e-3
"""First displacement of the handle in m; the loop is linear, so it only scales what follows."""

DIVERGED = 1e6
"""Force in N at which a run ends as unstable: a billion times what the kick causes."""

DECAYED = 1e-7
"""Share of its largest value below which a force counts as decayed, without unit. MuJoCo's step
with a free light tool keeps about 3e-8 N alive, which neither grows nor falls."""

TOLERANCE = 1e-4
"""Relative width at which a bisection ends. It is below the resolution of ``TICKS``."""


class ImplicitMass:
    """The scene ``point_mass`` behind its coupling actuators, one tick per call, along x.

    Args:
        coupling: K and B; the rotation is not excited.
        period: T in s.
        mass: Mass of the tool in kg.
    """

    def __init__(self, coupling: Coupling, period: float, mass: float) -> None:
        scene = load_scene("point_mass")
        body = scene.model.site_bodyid[scene.model.site(scene.grip).id]
        scene.model.body_inertia[body] *= mass / scene.model.body_mass[body]
        scene.model.body_mass[body] = mass
        mujoco.mj_setConst(scene.model, scene.data)
        prepare(scene, coupling, period, 1)
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._sample["quaternion"][:, 0] = 1.0
        setup = RunSetup(scene=scene, coupling=coupling, method=IMPLICIT, period=period)
        self._scene, self._period = scene, period
        parameters = setup.parameters(self._sample, None)
        self._binding = BoundKernel(scene.model, scene.data, parameters)

    def tick(self, handle: float) -> NDArray[np.void]:
        """Moves the handle to a position in m and returns the tick's record, shape (1,).

        Raises:
            SceneError: MuJoCo left a number that is not finite.
        """
        self._sample["position"][0, 0] = handle
        state, row = self._binding.state, self._binding.row
        if before_step(state, self._sample, row, 0, self._period) != OK:
            raise SceneError(f"the handle's position {handle!r} m is not finite")
        self._binding.step(self._scene.model, self._scene.data)
        if after_step(state, row, 0) != OK:
            raise SceneError("MuJoCo's step left a number that is not finite")
        return row

    def force(self, handle: float) -> float:
        """Runs ``tick`` and returns the force on the tool along x in N."""
        return float(self.tick(handle)["wrench_on_tool"][0, 0])


class AppliedForceMass:
    """A free mass on a slide, its coupling written as an applied force before an ``Euler`` step.

    Args:
        coupling: K and B.
        period: T in s.
        mass: Mass in kg.
    """

    def __init__(self, coupling: Coupling, period: float, mass: float) -> None:
        self._model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="{period!r}" integrator="Euler" gravity="0 0 0"/>
            <worldbody><body><joint type="slide" axis="1 0 0"/>
            <geom type="sphere" size="0.01" mass="{mass!r}"/></body></worldbody></mujoco>"""
        )
        self._data = mujoco.MjData(self._model)
        self._k, self._rate = coupling.stiffness, coupling.damping / period
        self._stretch = 0.0

    @property
    def motion(self) -> tuple[float, float]:
        """Present position in m and velocity in m/s."""
        return float(self._data.qpos[0]), float(self._data.qvel[0])

    def force(self, handle: float) -> float:
        """Computes the coupling's force at this handle, makes a step with it, and returns it."""
        stretch = handle - self.motion[0]
        force = self._k * stretch + self._rate * (stretch - self._stretch)
        self._stretch = stretch
        self._data.qfrc_applied[0] = force
        mujoco.mj_step(self._model, self._data)
        return float(force)


def drive(mass: ImplicitMass, handle: _Array) -> NDArray[np.void]:
    """Moves a handle along a path (n,) in m and returns the records, shape (n,)."""
    rows = np.zeros(len(handle), TICK_DTYPE)
    for k, position in enumerate(handle):
        rows[k] = mass.tick(float(position))[0]
    return rows


def hold(respond: Callable[[float], float], hand: WorstHand, ticks: int) -> _Array:
    """Runs an environment with the worst hand, from a displaced handle.

    Args:
        respond: Returns the force on the tool in N for the handle's next position in m.
        hand: Device and hand.
        ticks: Number of ticks; fewer where the force exceeds a million newtons.

    Returns:
        The force on the tool in N, one per tick.
    """
    carried, now, before = hand.recursion()
    force = np.zeros(ticks)
    handle, velocity, last = KICK, 0.0, 0.0
    for k in range(ticks):
        force[k] = respond(handle)
        if abs(force[k]) > DIVERGED:
            return force[: k + 1]
        velocity = carried * velocity - now * force[k] + before * last
        last = -force[k]
        handle += hand.period * velocity
    return force


def decays(force: _Array, ticks: int) -> bool:
    """Returns True if a run reached its last tick with a falling force."""
    if force.size < ticks:
        return False
    third = ticks // 3
    late, last = (np.abs(part).max() for part in (force[-2 * third : -third], force[-third:]))
    return bool(last < max(late, DECAYED * np.abs(force).max()))


def limit_of(
    make_environment: Callable[[], Callable[[float], float]], hand: Callable[[float], WorstHand]
) -> float:
    """Finds the smallest device damping at which a loop is stable.

    Powers of ten from 1 N s/m on enclose it, so that no bound of the theory enters the search.

    Args:
        make_environment: Makes a new environment.
        hand: The worst hand for a device damping in N s/m.

    Returns:
        b in N s/m.
    """

    def is_stable(damping: float) -> bool:
        return decays(hold(make_environment(), hand(damping), TICKS), TICKS)

    return threshold(is_stable, 1.0, TOLERANCE)


def wall_limit(coupling: Coupling, period: float) -> float:
    """Returns the limit of device damping in N s/m for a tool that is too heavy to move."""

    def hand(damping: float) -> WorstHand:
        return WorstHand(damping, np.pi / period, period)

    def fresh() -> Callable[[float], float]:
        return ImplicitMass(coupling, period, HEAVY).force

    return limit_of(fresh, hand)
