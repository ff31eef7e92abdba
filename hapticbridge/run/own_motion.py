"""Motion of a scene without a hand: as its file describes it, and as the bridge runs it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import RIGID
from hapticbridge.demand.rehearsal import RunPoint, rehearsal_parameters
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.kernel.parameters import MAX_SUBSTEPS
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.scene import Scene, SceneSource, plain_model
from hapticbridge.scene.compile import reset
from hapticbridge.units import format_si

SECONDS = 0.5
"""Time in s that is compared. Later, contacts and chains amplify any difference."""

MAX_WORK = 3e5
"""Largest work of a comparison in degrees of freedom and constraint rows, summed over the steps of
the file's own motion. Heavier scenes are compared over less than ``SECONDS``: 60 degrees of freedom
at 0.1 ms take 1 s."""

LEAST, SHARE = 1e-3, 0.07
"""Just noticeable difference of a place: 1 mm, or 7 % of the distance moved if that is more."""

NOTABLE_ENERGY = 1e-4
"""Energy in J that a scene may create without a hand and without a word: a tenth of what a hand
puts in when it taps."""

ROUNDING = 1e-9
"""Relative error of a time step as it is written."""

NO_HAND = Coupling(1e-6, 0.0)
"""Coupling that carries nothing: 1 N at 1000 km."""


@dataclass(frozen=True, slots=True)
class OwnMotion:
    """Body that moves most differently under the file's own options and in the bridge.

    Attributes:
        body: Name of the body, or its number if it has none.
        apart: Distance in m between its two places at the end; inf if it diverges in the bridge.
        moved: Distance in m that it moves under the file's own options.
        step: The file's own time step in s.
        seconds: Time in s that was compared.
        created: Energy in J that the scene created meanwhile in the bridge.
    """

    body: str
    apart: float
    moved: float
    step: float
    seconds: float = SECONDS
    created: float = 0.0

    @property
    def jnd(self) -> float:
        """Difference in just noticeable differences of a place."""
        return self.apart / max(LEAST, SHARE * self.moved)

    def __str__(self) -> str:
        """The difference as a sentence."""
        if math.isinf(self.apart):
            return (
                f"without a hand, the scene diverges here within {self.seconds:.2g} s, and not "
                f"under the file's own options (time step {format_si(self.step, 's')})"
            )
        return (
            f"without a hand, '{self.body}' is after {self.seconds:.2g} s "
            f"{format_si(self.apart, 'm')} from where the file's own options take it "
            f"({format_si(self.moved, 'm')} from its start, time step "
            f"{format_si(self.step, 's')}): {self.jnd:.2g} just noticeable differences"
        )

    @property
    def creation(self) -> str:
        """Sentence on energy that the scene creates; empty if there is hardly any.

        Fast joints create it in MuJoCo's steps. It is taken back (``kernel.ledger``) unless
        contacts of the scene's own act.
        """
        if not NOTABLE_ENERGY < self.created < math.inf:
            return ""
        return (
            f"without a hand, the scene creates {format_si(self.created, 'J')} within "
            f"{self.seconds:.2g} s, as fast joints do in MuJoCo's steps, and the audit may call it "
            "active; --contact rigid takes it back, and more --substeps create less"
        )

    def remedy(self, setting: RunPoint) -> str:
        """Returns advice for a run with a setting."""
        period = setting.period
        if self.step > (1.0 + ROUNDING) * period:
            return f"--rate {1.0 / self.step:g} takes the file's own time step"
        if self.step < (1.0 - ROUNDING) * period:
            return f"--substeps {_substeps(self.step, period)} keeps the file's own time step"
        if setting.contact == RIGID:
            return "--contact scene keeps the file's own contacts"
        return "a shorter time step (--rate or --substeps) brings the two closer"


def own_motion(source: SceneSource, scene: Scene, setting: RunPoint) -> OwnMotion | None:
    """Compares the first half second without a hand with that of the file's own options.

        JND = ‖p − q‖ / max(1 mm, 0.07 ‖p − p_0‖)

    with a body's centre of mass p under the file's own integrator, time step, solver and contacts,
    q in the bridge, and p_0 at the start. The body with the largest JND counts; a tool with a free
    joint does not, because without a hand it falls, and with one the hand moves it.

    Args:
        source: The scene; it is not changed.
        scene: Result of ``compile_scene`` from it; prepared here, and not at its start afterwards.
        setting: Rate and substeps; the coupling is not used.

    Returns:
        The comparison, or None if the file's own options let the scene diverge.

    Raises:
        SceneError: The scene does not compile.

    References:
        Durlach, Delhorne, Wong, Ko, Rabinowitz & Hollerbach, Perception & Psychophysics 46, 1989:
        1 mm for lengths of 10 to 20 mm between the fingers, 2.2 mm for 80 mm.
    """
    with quiet():
        alone = _FileMotion.simulate(source, scene)
        return None if alone is None else alone.against(scene, setting)


@dataclass(frozen=True, slots=True, eq=False)
class _FileMotion:
    """Motion of a scene's bodies under the file's own options: centres of mass (nbody, 3) in m."""

    data: mujoco.MjData
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    seconds: float

    @classmethod
    def simulate(cls, source: SceneSource, scene: Scene) -> Self | None:
        """Moves the scene from the bridge's start; returns None if it diverges.

        A mocap body that the hand replaces holds nothing here either.
        """
        model = plain_model(source)
        model.eq_active0[:] = scene.model.eq_active0[: model.neq]
        data = mujoco.MjData(model)
        reset(model, data)
        scene.reset()
        data.qpos[:] = scene.data.qpos
        mujoco.mj_forward(model, data)
        start, step = data.xipos.copy(), float(model.opt.timestep)
        most = MAX_WORK / max(model.nv + data.nefc, 1)
        count = max(int(min(round(SECONDS / step), most)), 1)
        mujoco.mj_step(model, data, count)
        if any(warning.number for warning in data.warning):
            return None
        _place_bodies(data)
        return cls(data, start, data.xipos.copy(), min(count * step, SECONDS))

    def against(self, scene: Scene, setting: RunPoint) -> OwnMotion:
        """Compares with the motion in the bridge."""
        data, step = self.data, float(self.data.model.opt.timestep)
        setting = replace(setting, coupling=NO_HAND)
        created = _energy_of_motion_alone(scene, setting, self.seconds)
        if math.isinf(created):
            return OwnMotion("", math.inf, 0.0, step, self.seconds)
        data.qpos[:] = scene.data.qpos
        _place_bodies(data)
        apart = np.linalg.norm(data.xipos - self.end, axis=1)
        apart[_free_tool(scene)[: apart.size]] = 0.0
        moved = np.linalg.norm(self.end - self.start, axis=1)
        most = int(np.argmax(apart / np.maximum(LEAST, SHARE * moved)))
        name = str(data.model.body(most).name) or str(most)
        motion = float(apart[most]), float(moved[most])
        return OwnMotion(name, *motion, step, self.seconds, created)


def _free_tool(scene: Scene) -> NDArray[np.bool_]:
    """Returns True for each body of a tool that only the hand holds: it falls without one."""
    model = scene.model
    trees = model.body_treeid
    tree = trees[model.site(scene.grip).bodyid[0]]
    root = np.flatnonzero(trees == tree)[0]
    is_free = model.jnt_type[model.body_jntadr[root]] == mujoco.mjtJoint.mjJNT_FREE
    return np.asarray((trees == tree) & is_free, dtype=bool)


def _place_bodies(data: mujoco.MjData) -> None:
    mujoco.mj_kinematics(data.model, data)
    mujoco.mj_comPos(data.model, data)


def _energy_of_motion_alone(scene: Scene, setting: RunPoint, seconds: float) -> float:
    """Moves a scene by its ticks in the bridge.

    Returns:
        The energy in J that it created; inf if it diverges.
    """
    binding = BoundKernel(scene.model, scene.data, rehearsal_parameters(scene, setting))
    state, row, step = binding.state, binding.row, binding.step
    still, period = np.zeros(1, SAMPLE_DTYPE), setting.period
    still["quaternion"][:, 0] = 1.0
    before = direct(before_step, state, still, row, 0, period)
    after = direct(after_step, state, row, 0)
    try:
        for _ in range(max(round(seconds / period), 1)):
            for substep in range(setting.substeps):
                if before(state, still, row, substep, period) != OK:
                    return math.inf
                step(scene.model, scene.data)
                if after(state, row, substep) != OK:
                    return math.inf
        return float(state[0]["energy"]["environment_energy"])
    finally:
        binding.release()


def own_substeps(
    source: SceneSource, scene: Scene, setting: RunPoint
) -> tuple[int, OwnMotion | None]:
    """Returns the substeps that keep the file's own time step, and the motion with them.

    There is one if the file's step is not shorter than T, or if its motion does not differ
    noticeably with one, or not less with more.

    Args:
        source: The scene; it is not changed.
        scene: As for ``own_motion``.
        setting: Period and contact; coupling and substeps are not used.

    Raises:
        SceneError: The scene does not compile.
    """
    with quiet():
        alone = _FileMotion.simulate(source, scene)
        if alone is None:
            return 1, None
        one = alone.against(scene, replace(setting, substeps=1))
        count = _substeps(source.spec.option.timestep, setting.period)
        if one.jnd <= 1.0 or count <= 1:
            return 1, one
        more = alone.against(scene, replace(setting, substeps=count))
    return (count, more) if more.jnd < one.jnd else (1, one)


def _substeps(step: float, period: float) -> int:
    return min(math.ceil(period / step - ROUNDING), MAX_SUBSTEPS)
