"""Motion of a scene without a hand: as its file describes it, and as the bridge runs it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from hapticbridge.check.observe import Setting, quiet, rehearsal_parameters
from hapticbridge.coupling import Coupling
from hapticbridge.jit import direct
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.parameters import MAX_SUBSTEPS
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.record import SAMPLE_DTYPE
from hapticbridge.rendering import RIGID
from hapticbridge.scene import Scene, SceneSource, compile_scene, plain_model
from hapticbridge.scene.compile import START_KEYFRAME
from hapticbridge.units import format_si

SECONDS = 0.5
"""Time in s that is compared. Later, contacts and chains amplify any difference."""

LEAST, SHARE = 1e-3, 0.07
"""Just noticeable difference of a place: 1 mm, or 7 % of the distance moved if that is more."""

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
    """

    body: str
    apart: float
    moved: float
    step: float

    @property
    def jnd(self) -> float:
        """Difference in just noticeable differences of a place."""
        return self.apart / max(LEAST, SHARE * self.moved)

    def __str__(self) -> str:
        """The difference as a sentence."""
        if math.isinf(self.apart):
            return (
                f"without a hand, the scene diverges here within {SECONDS:g} s, and not under the "
                f"file's own options (time step {format_si(self.step, 's')})"
            )
        return (
            f"without a hand, '{self.body}' is after {SECONDS:g} s {format_si(self.apart, 'm')} "
            f"from where the file's own options take it ({format_si(self.moved, 'm')} from its "
            f"start, time step {format_si(self.step, 's')}): {self.jnd:.2g} just noticeable "
            "differences"
        )

    def remedy(self, setting: Setting) -> str:
        """Returns advice for a run with a setting."""
        period = setting.period
        if self.step > (1.0 + ROUNDING) * period:
            return f"--rate {1.0 / self.step:g} takes the file's own time step"
        if self.step < (1.0 - ROUNDING) * period:
            return f"--substeps {_substeps(self.step, period)} keeps the file's own time step"
        if setting.contact == RIGID:
            return "--contact scene keeps the file's own contacts"
        return "a shorter time step (--rate or --substeps) brings the two closer"


def own_motion(source: SceneSource, grip: str, setting: Setting) -> OwnMotion | None:
    """Compares the first half second without a hand with that of the file's own options.

        JND = ‖p − q‖ / max(1 mm, 0.07 ‖p − p_0‖)

    with a body's centre of mass p under the file's own integrator, time step, solver and contacts,
    q in the bridge, and p_0 at the start. The body with the largest JND counts.

    Args:
        source: The scene; it is not changed.
        grip: Site, ``BODY`` or ``BODY@x,y,z``.
        setting: Rate and substeps; the coupling is not used.

    Returns:
        The comparison, or None if the file's own options let the scene diverge.

    Raises:
        SceneError: The scene does not compile.

    References:
        Durlach, Delhorne, Wong, Ko, Rabinowitz & Hollerbach, Perception & Psychophysics 46, 1989:
        1 mm for lengths of 10 to 20 mm between the fingers, 2.2 mm for 80 mm.
    """
    model = plain_model(source)
    data = mujoco.MjData(model)
    home = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, START_KEYFRAME)
    if home >= 0:
        mujoco.mj_resetDataKeyframe(model, data, home)
    mujoco.mj_forward(model, data)
    start = data.xipos.copy()
    step = float(model.opt.timestep)
    with quiet():
        mujoco.mj_step(model, data, max(round(SECONDS / step), 1))
        if any(warning.number for warning in data.warning):
            return None
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        alone = data.xipos.copy()
        scene = compile_scene(source, grip, warns=False, checks_start=False)
        if not _has_moved_alone(scene, replace(setting, coupling=NO_HAND)):
            return OwnMotion("", math.inf, 0.0, step)
    data.qpos[:] = scene.data.qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    apart = np.linalg.norm(data.xipos - alone, axis=1)
    moved = np.linalg.norm(alone - start, axis=1)
    most = int(np.argmax(apart / np.maximum(LEAST, SHARE * moved)))
    name = str(model.body(most).name) or str(most)
    return OwnMotion(name, float(apart[most]), float(moved[most]), step)


def _has_moved_alone(scene: Scene, setting: Setting) -> bool:
    """Moves a scene by its ticks in the bridge; returns False if it diverges."""
    binding = BoundKernel(scene.model, scene.data, rehearsal_parameters(scene, setting))
    state, row, step = binding.state, binding.row, binding.step
    still, period = np.zeros(1, SAMPLE_DTYPE), setting.period
    still["quaternion"][:, 0] = 1.0
    before = direct(before_step, state, still, row, 0, period)
    after = direct(after_step, state, row, 0)
    try:
        for _ in range(max(round(SECONDS / period), 1)):
            for substep in range(setting.substeps):
                if before(state, still, row, substep, period) != OK:
                    return False
                step(scene.model, scene.data)
                if after(state, row, substep) != OK:
                    return False
    finally:
        binding.release()
    return True


def own_substeps(source: SceneSource, grip: str, setting: Setting) -> tuple[int, OwnMotion | None]:
    """Returns the substeps that keep the file's own time step, and the motion with them.

    There is one if the file's step is not shorter than T, or if its motion does not differ
    noticeably with one, or not less with more.

    Args:
        source: The scene; it is not changed.
        grip: Site, ``BODY`` or ``BODY@x,y,z``.
        setting: Period and contact; coupling and substeps are not used.

    Raises:
        SceneError: The scene does not compile.
    """
    one = own_motion(source, grip, replace(setting, substeps=1))
    count = _substeps(source.spec.option.timestep, setting.period)
    if one is None or one.jnd <= 1.0 or count <= 1:
        return 1, one
    more = own_motion(source, grip, replace(setting, substeps=count))
    return (count, more) if more is not None and more.jnd < one.jnd else (1, one)


def _substeps(step: float, period: float) -> int:
    return min(math.ceil(period / step - ROUNDING), MAX_SUBSTEPS)
