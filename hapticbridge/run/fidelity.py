"""Fidelity of a scene: its motion without a hand in the bridge, against the one of its file."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import RIGID
from hapticbridge.demand.rehearsal import RunPoint, rehearsal_parameters
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import OK, added_actuators, held_body
from hapticbridge.kernel.elastic import has_elastic_flex
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.kernel.parameters import MAX_SUBSTEPS
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.rigid_contact import LAST_RIGID
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.scene import Scene, SceneSource, plain_model
from hapticbridge.scene.checks import ancestors
from hapticbridge.scene.compile import reset
from hapticbridge.scene.handle import constraint_rows, copy_values
from hapticbridge.scene.rehearsal import holding_wrench
from hapticbridge.scene.start import constraint_name
from hapticbridge.units import format_degrees, format_si

SECONDS = 1.0
"""Time in s that is compared. Later, contacts and chains amplify any difference."""

MAX_WORK = 1e5
"""Largest work of one motion at the start of a run, in degrees of freedom and constraint rows,
summed over its steps: 0.3 to 0.7 s. Heavier scenes are compared over less than ``SECONDS`` there,
and in full by a check."""

PLACE, TURN = 1e-3, 0.01
"""Largest distance in m and angle in rad between two places of a body that count as one: what
fingers just notice on 10 to 20 mm, and 1 mm at 0.1 m from an axis."""

SPREAD = 3.0
"""Difference that counts, relative to that between two motions of the file, one of them with half
its time step; no unit. MuJoCo's steps are of first order: with ever smaller ones the file's own
motion ends twice as far away, and there a finer step of the run may end too."""

CHAOS = 10.0
"""Difference between two motions of the file, relative to the limits, from which on none of them is
its motion; no unit. Where it grows to 1 cm, chance decides whether a third is farther away."""

DISTURBANCE = 1e-6
"""Disturbance in m or rad of the start in the file's other motion, far below what is seen."""

MORE = 1.0
"""Force in N of a still hand by which a remedy may exceed that without it. A remedy that lets the
hand bear more is none: it would begin with a push."""

NOTABLE_ENERGY = 1e-4
"""Energy in J that a scene may create with a remedy: a tenth of what a hand puts in when it
taps."""

NOTABLE_LOSS = 1e-3
"""Energy in J by which a scene may have less than under the file's own options: what a hand puts in
when it taps."""

PART = 0.25
"""Part of a deviation, no unit, from which on a replacement that makes it is a cause among others.
Smaller parts are found by chance where contacts open and close."""

ROUNDING = 1e-9
"""Relative error of a time step as it is written."""

HELD = 1e6
"""Inertia in kg and kg m² that a hand adds to a tool which it holds still. The tool then falls by
1 µm in a second; more would cost digits of the other bodies' accelerations."""

NO_HAND = Coupling(1e-6, 0.0)
"""Coupling that carries nothing: 1 N at 1000 km."""


NO_MEASURE = (
    "without a hand, the scene diverges or fills MuJoCo's limits within 1 s under the file's own "
    "options, so its motion here is compared with nothing"
)
"""Sentence on a scene whose file gives no motion to compare with, ``fidelity`` of which is None."""


class Cause(Enum):
    """Replacement of the bridge that makes a scene move differently.

    The value is its name.
    """

    TIME_STEP = "the time step"
    CONTACT = "rigid contacts, limits and equalities in place of the file's own"
    DIAGONAL = "flag diagexact, which rigid contacts need"
    LOAD = "what is changed in the scene as it is loaded"
    OPTIONS = "the integrator or the solver's options"


class Places(NamedTuple):
    """Centres of mass (n, 3) in m and orientations (n, 4) of all bodies."""

    position: NDArray[np.float64]
    orientation: NDArray[np.float64]

    def apart(self, other: Places) -> NDArray[np.float64]:
        """Returns distance in m and angle in rad between the places of each body, (2, n)."""
        lag = np.abs(np.einsum("ij,ij->i", self.orientation, other.orientation))
        angle = 2.0 * np.arccos(np.minimum(lag, 1.0))
        return np.array([np.linalg.norm(self.position - other.position, axis=1), angle])


def _size(apart: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns differences relative to ``PLACE`` and ``TURN``, the larger of both, (n,)."""
    return np.asarray((apart.T / (PLACE, TURN)).max(axis=1))


class Deviation(NamedTuple):
    """Body that moves differently in the bridge.

    Attributes:
        body: Name of the body, or its number if it has none.
        apart: Distance in m between its two places at the end; inf if the scene diverges here.
        turned: Angle in rad between its two orientations at the end.
        moved: Distance in m that it moves under the file's own options.
        number: Number of the body in the file's model.
    """

    body: str
    apart: float
    turned: float
    moved: float
    number: int = 0

    @property
    def size(self) -> float:
        """The difference relative to ``PLACE`` and ``TURN``, the larger of both."""
        return max(self.apart / PLACE, self.turned / TURN)


@dataclass(frozen=True, slots=True)
class Fidelity:
    """Comparison of two motions of a scene without a hand.

    Attributes:
        deviations: Bodies that move differently in the bridge, that with the largest size first.
        incomparable: Bodies whose place the file itself does not determine.
        bodies: Number of bodies that can move while a hand holds the tool.
        step: The file's own time step in s.
        seconds: Time in s that was compared.
        created: Energy in J that the scene created meanwhile in the bridge.
        causes: Replacements without which the first deviation is less than half as large. Where
            none is alone, those without which it is by ``PART`` smaller are among them.
        constraint: Name of the constraint of the file whose force does most of the work between
            both places of its body; empty if none does.
        remedy: Rate, substeps and contact with which no body deviates, tried; None without one.
        more: Force in N by which a still hand bears more with the remedy than without; at least 0.
        lost: Energy in J that the scene has less at the end than in both motions of the file, where
            these agree on it; else 0.
    """

    deviations: tuple[Deviation, ...]
    incomparable: tuple[str, ...]
    bodies: int
    step: float
    seconds: float
    created: float
    causes: tuple[Cause, ...] = ()
    constraint: str = ""
    remedy: RunPoint | None = None
    more: float = 0.0
    lost: float = 0.0

    @property
    def size(self) -> float:
        """Largest difference relative to ``PLACE`` and ``TURN``; 0 if no body deviates."""
        return self.deviations[0].size if self.deviations else 0.0

    def __str__(self) -> str:
        """The deviation as a sentence; empty if there is none."""
        if not self.deviations:
            return ""
        first, *others = self.deviations
        step = f"time step {format_si(self.step, 's')}"
        if math.isinf(first.apart):
            return (
                f"without a hand, the scene diverges here within {self.seconds:.2g} s, and not "
                f"under the file's own options ({step})"
            )
        ending = "ies deviate" if len(others) > 1 else "y deviates"
        more = f", and {len(others)} more bod{ending}" if others else ""
        cause = ", and ".join(each.value for each in self.causes)
        if self.constraint and {Cause.CONTACT, Cause.DIAGONAL} & set(self.causes):
            cause += f", here of {self.constraint}"
        return (
            f"without a hand, '{first.body}' is after {self.seconds:.2g} s "
            f"{format_si(first.apart, 'm')} and {format_degrees(first.turned, 2)} from where the "
            f"file's own options take it ({format_si(first.moved, 'm')} from its start, {step})"
            f"{more}; the cause is {cause}"
        )

    @property
    def doubt(self) -> str:
        """Sentence on bodies whose place the file does not determine; empty without."""
        if not self.incomparable:
            return ""
        first, *others = self.incomparable
        more = (
            f" and of {len(others)} more bod{'ies' if len(others) > 1 else 'y'}" if others else ""
        )
        then = format_si(self.lost, "J")
        less = (
            f"; but the scene then has {then} less than with either: fast swings and "
            "contacts lose more in a run"
        )
        return (
            f"without a hand, the place of '{first}'{more} after {self.seconds:.2g} s depends on "
            f"the file's time step of {format_si(self.step, 's')}: with half of it, it is about as "
            "far away as in a run"
        ) + (less if self.lost else "")

    def advice(self, setting: RunPoint) -> str:
        """Returns options of a run that mend a deviation, and what they gave; empty without."""
        if self.remedy is None:
            return ""
        return (
            f"{_flags(self.remedy, setting)} (tried: each body is then within "
            f"{format_si(PLACE, 'm')}, and the largest force on a still hand grows by "
            f"{format_si(self.more, 'N')})"
        )


def _flags(changed: RunPoint, setting: RunPoint) -> str:
    """Returns the options of ``hapticbridge run`` that change a setting into another one."""
    flags = {
        f"--rate {1.0 / changed.period:g}": changed.period != setting.period,
        f"--substeps {changed.substeps}": changed.substeps != setting.substeps,
        f"--contact {changed.contact}": changed.contact != setting.contact,
    }
    return " ".join(flag for flag, is_changed in flags.items() if is_changed)


def fidelity(
    source: SceneSource, scene: Scene, setting: RunPoint, *, max_work: float = math.inf
) -> Fidelity | None:
    """Compares the first second without a hand with that of the file's own options.

        size = max(‖p − q‖/1 mm, |θ_p − θ_q|/0.01 rad)

    with a body's centre of mass p under the file's own integrator, time step, solver and contacts,
    and q in the bridge. Both start as the run does, on the file's constraints, with its controls
    and without the mocap bodies that the hand replaces (``Scene.differences`` names both). A tool
    that the file lets move by ``CHAOS`` is held in both at the joints without a motor's force, as
    by a hand at rest.

    A body deviates if its size is above 1 and above ``SPREAD`` times that between the file's motion
    and a second one of it, with half the time step and a start disturbed by ``DISTURBANCE``, and if
    the latter is below ``CHAOS``. A body of size above 1 that does not is incomparable: the file
    does not determine its place.

    Args:
        source: The scene; it is not changed.
        scene: Result of ``compile_scene`` from it; it is not changed.
        setting: Rate, substeps and contact of both, and the coupling of a hand that tries a remedy.
        max_work: Largest work of one motion (``MAX_WORK``), which shortens it.

    Returns:
        The comparison, or None if the file's own options let the scene diverge, or fill a limit of
        MuJoCo.

    Raises:
        SceneError: The scene does not compile.

    References:
        Durlach, Delhorne, Wong, Ko, Rabinowitz & Hollerbach, Perception & Psychophysics 46, 1989:
        1 mm for lengths of 10 to 20 mm between the fingers.
    """
    scene = scene.for_trial()
    with quiet():
        alone = _FileMotion.simulate(source, scene, max_work)
        return None if alone is None else alone.against(scene, setting)


@dataclass(frozen=True, slots=True, eq=False)
class _FileMotion:
    """Motion of a scene's bodies under the file's own options, from the run's start.

    ``data`` is at the start, ``last`` at the end.
    """

    data: mujoco.MjData
    last: mujoco.MjData
    start: Places
    end: Places
    count: int
    held: NDArray[np.intp]

    @classmethod
    def simulate(cls, source: SceneSource, scene: Scene, max_work: float) -> Self | None:
        """Moves the scene; returns None if it diverges."""
        model = plain_model(source)
        model.eq_active0[:] = scene.model.eq_active0[: model.neq]
        data = mujoco.MjData(model)
        reset(model, data)
        scene.reset()
        data.qpos[:] = scene.data.qpos
        data.ctrl[:] = scene.data.ctrl[: data.ctrl.size]
        mujoco.mj_forward(model, data)
        most = max_work / max(model.nv + data.nefc, 1)
        count = max(int(min(round(SECONDS / model.opt.timestep), most)), 1)
        start, end = _places(copy.copy(data)), _moved(model, data, count)
        held = np.zeros(0, np.intp) if end is None else _loose_dofs(scene, start, end)
        if held.size:
            _hold(model, held)
            mujoco.mj_forward(model, data)
            end = _moved(model, data, count)
        return None if end is None else cls(data, end, start, _places(copy.copy(end)), count, held)

    @property
    def model(self) -> mujoco.MjModel:
        return self.data.model

    @property
    def step(self) -> float:
        return float(self.model.opt.timestep)

    @property
    def seconds(self) -> float:
        return self.count * self.step

    def against(self, scene: Scene, setting: RunPoint) -> Fidelity:
        """Compares with the motion in the bridge, and looks for causes and a remedy.

        The run's replacements are undone one after the other. Where that helps little, the changed
        scene moves under the file's own options, which tells changes at load from options.
        """
        found = self._compared(scene, setting)
        if not found.deviations:
            return found
        way = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, way, 1.0, scene.data.qpos, self.last.qpos)
        row = _working(self.last, found.deviations[0].number, way)
        causes: list[Cause] = []
        part: tuple[Cause, ...] = ()
        least = (1.0 - PART) * found.size
        remedy, more, force = None, 0.0, _force(scene, setting)
        for undone, other in self._settings(scene, setting):
            trial = self._tried(scene, other)
            if trial.size < 0.5 * found.size and not set(causes) & set(undone):
                causes += undone
            if trial.size < least:
                part, least = undone, trial.size
            is_calm = trial.created <= max(found.created, NOTABLE_ENERGY)
            if remedy is None and is_calm and not trial.deviations:
                more = max(_force(scene, other) - force, 0.0)
                remedy = other if more <= MORE else None
        causes = causes or [self._other_cause(scene, found.deviations[0]), *part]
        if row >= 0 and _is_soft_here(self.last, row):
            causes = [Cause.DIAGONAL if each is Cause.CONTACT else each for each in causes]
        return replace(
            found,
            causes=tuple(causes),
            constraint=constraint_name(self.model, self.last, row) if row >= 0 else "",
            remedy=remedy,
            more=more if remedy else 0.0,
        )

    def _other_cause(self, scene: Scene, worst: Deviation) -> Cause:
        """Tries the changed scene with the file's own options."""
        scene.set_contact(is_rigid=False)
        model = copy.copy(scene.model)
        model.actuator_gainprm[list(added_actuators(model))] = 0.0
        model.actuator_biasprm[list(added_actuators(model))] = 0.0
        _hold(model, self.held)
        copy_values(self.model.opt, model.opt)
        scene.reset()
        end = _moved(model, scene.data, self.count)
        if end is None:
            return Cause.LOAD
        apart = _places(copy.copy(self.data), end.qpos).apart(self.end)
        return Cause.LOAD if 2.0 * _size(apart)[worst.number] >= worst.size else Cause.OPTIONS

    def _tried(self, scene: Scene, setting: RunPoint) -> Fidelity:
        """Compares a remedy; one that the scene refuses counts as one with which it diverges."""
        try:
            return self._compared(scene, setting)
        except SceneError:  # its own contacts refuse a tool that starts inside something
            return replace(self._diverged, created=math.inf)

    def _compared(self, scene: Scene, setting: RunPoint) -> Fidelity:
        """Returns what deviates from this motion in the bridge."""
        created = self._moved_here(scene, replace(setting, coupling=NO_HAND))
        if math.isinf(created):
            return self._diverged
        found = Fidelity((), (), int(self._are_free().sum()), self.step, self.seconds, created)
        apart = _places(copy.copy(self.data), scene.data.qpos).apart(self.end)
        sizes = np.where(self._are_free(), _size(apart), 0.0)
        if sizes.max(initial=0.0) <= 1.0:
            return found
        moved, (spread, energies) = self.start.apart(self.end)[0], self._other_motion()
        lost = min(energies) - self._energy(scene.data)
        least = max(NOTABLE_LOSS, SPREAD * abs(energies[1] - energies[0]))
        if has_elastic_flex(self.model):  # its energy is not in MuJoCo's
            least = math.inf
        allowed = np.where(spread < CHAOS, SPREAD * spread, math.inf)
        names = [str(self.model.body(i).name) or str(i) for i in range(self.model.nbody)]
        worst = [int(i) for i in np.argsort(-sizes) if sizes[i] > 1.0]
        return replace(
            found,
            deviations=tuple(
                Deviation(names[i], float(apart[0, i]), float(apart[1, i]), float(moved[i]), i)
                for i in worst
                if sizes[i] > allowed[i]
            ),
            incomparable=tuple(names[i] for i in worst if sizes[i] <= allowed[i]),
            lost=lost if lost > least else 0.0,
        )

    @property
    def _diverged(self) -> Fidelity:
        lost = (Deviation("", math.inf, 0.0, math.inf),)
        return Fidelity(lost, (), int(self._are_free().sum()), self.step, self.seconds, math.inf)

    def _are_free(self) -> NDArray[np.bool_]:
        """Returns True for each body that can move while the tool is held."""
        model, free = self.model, np.zeros(self.model.nbody, bool)
        free[np.delete(model.dof_bodyid, self.held)] = True
        for body in range(1, model.nbody):  # parents come first
            free[body] |= free[model.body_parentid[body]]
        return free

    def _other_motion(self) -> tuple[NDArray[np.float64], tuple[float, float]]:
        """Returns the size of the difference to a second motion of the file, (nbody,).

        The energies in J are those at the end of both motions.
        """
        model = copy.copy(self.model)
        model.opt.timestep /= 2.0
        rng = np.random.default_rng(0)
        step = rng.uniform(-DISTURBANCE, DISTURBANCE, model.nv)
        other = _moved(model, self.data, 2 * self.count, step)
        if other is None:
            return np.full(model.nbody, math.inf), (-math.inf, math.inf)
        energies = self._energy(self.last), self._energy(other)
        return _size(_places(other).apart(self.end)), energies

    def _energy(self, moved: mujoco.MjData) -> float:
        """Returns the kinetic and potential energy in J of the file's scene in another's state."""
        model, data = self.model, copy.copy(self.data)
        data.qpos[:], data.qvel[:] = moved.qpos, moved.qvel
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        return float(data.energy.sum())

    def _settings(
        self, scene: Scene, setting: RunPoint
    ) -> Iterator[tuple[tuple[Cause, ...], RunPoint]]:
        """Yields settings of a run that undo one replacement or two, with what they undo."""
        own = _with_step(scene, setting, self.step)
        if own != setting:
            yield (Cause.TIME_STEP,), own
        if setting.contact == RIGID:
            yield (Cause.CONTACT,), replace(setting, contact="scene")
            if own != setting:
                yield (Cause.TIME_STEP, Cause.CONTACT), replace(own, contact="scene")

    def _moved_here(self, scene: Scene, setting: RunPoint) -> float:
        """Moves a scene by its ticks in the bridge.

        Returns:
            The energy in J that it created; inf if it diverges.
        """
        parameters, model = rehearsal_parameters(scene, setting), scene.model
        inertia = model.dof_armature.copy(), model.dof_M0.copy()
        _hold(model, self.held)
        binding = BoundKernel(scene.model, scene.data, parameters)
        state, row, step = binding.state, binding.row, binding.step
        still, period = np.zeros(1, SAMPLE_DTYPE), setting.period
        still["quaternion"][:, 0] = 1.0
        before = direct(before_step, state, still, row, 0, period)
        after = direct(after_step, state, row, 0)
        try:
            for _ in range(max(round(self.seconds / period), 1)):
                for substep in range(setting.substeps):
                    if before(state, still, row, substep, period) != OK:
                        return math.inf
                    step(scene.model, scene.data)
                    if after(state, row, substep) != OK:
                        return math.inf
            return float(state[0]["energy"]["environment_energy"])
        finally:
            binding.release()
            model.dof_armature[:], model.dof_M0[:] = inertia  # to the last bit, as a run follows


def _force(scene: Scene, setting: RunPoint) -> float:
    """Returns the largest force in N with which a still hand holds the tool; inf if it cannot."""
    try:
        return float(holding_wrench(scene, rehearsal_parameters(scene, setting))[0])
    except SceneError:
        return math.inf


def _is_soft_here(data: mujoco.MjData, row: int) -> bool:
    """Returns True for a row of a flex or of dry friction, which rigid contacts leave MuJoCo's."""
    kind, number = int(data.efc_type[row]), int(data.efc_id[row])
    if kind == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY):
        return int(data.model.eq_type[number]) > LAST_RIGID
    return kind <= int(mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON)


def _working(data: mujoco.MjData, body: int, way: NDArray[np.float64]) -> int:
    """Returns the constraint row whose force does the most work on a body's joints.

    ``way`` (nv,) is that of the joints from one place to another; -1 if there is no work.
    """
    model = data.model
    rows = constraint_rows(data)
    chain = np.isin(model.dof_bodyid, ancestors(model, body))
    work = np.abs(data.efc_force * (rows[:, chain] @ way[chain]))
    return int(np.argmax(work)) if work.any() else -1


def _loose_dofs(scene: Scene, start: Places, end: mujoco.MjData) -> NDArray[np.intp]:
    """Returns the degrees of freedom that carry tools which fall or swing without a hand."""
    found = np.zeros(0, np.intp)
    sizes = _size(_places(copy.copy(end)).apart(start))
    for grip in (scene.grip, *scene.other_grips):
        tool = held_body(scene.model, grip)
        chain = np.flatnonzero(np.isin(end.model.dof_bodyid, ancestors(scene.model, tool)))
        if sizes[tool] > CHAOS:
            found = np.union1d(found, chain[end.qfrc_actuator[chain] == 0.0])
    return found.astype(np.intp)


def _hold(model: mujoco.MjModel, dofs: NDArray[np.intp]) -> None:
    """Adds inertia to degrees of freedom; MuJoCo reads ``dof_M0`` for bodies alone in a tree."""
    model.dof_armature[dofs] += HELD
    model.dof_M0[dofs] += HELD


def _moved(
    model: mujoco.MjModel,
    start: mujoco.MjData,
    count: int,
    disturbance: NDArray[np.float64] | None = None,
) -> mujoco.MjData | None:
    """Returns the data after so many of MuJoCo's steps; None if it diverges."""
    data = copy.copy(start)
    if disturbance is not None:
        mujoco.mj_integratePos(model, data.qpos, disturbance, 1.0)
    mujoco.mj_step(model, data, count)
    return None if any(warning.number for warning in data.warning) else data


def _places(data: mujoco.MjData, positions: NDArray[np.float64] | None = None) -> Places:
    """Returns the places of all bodies, at the data's own or at other positions (nq,)."""
    if positions is not None:
        data.qpos[:] = positions
    mujoco.mj_kinematics(data.model, data)
    mujoco.mj_comPos(data.model, data)
    return Places(data.xipos.copy(), data.xquat.copy())


def own_substeps(
    source: SceneSource, scene: Scene, setting: RunPoint
) -> tuple[int, Fidelity | None]:
    """Returns the substeps that keep the file's own time step, and the motion with them.

    There is one if the file's step is not shorter than T, or if no body deviates with one, or not
    less with more.

    Args:
        source: The scene; it is not changed.
        scene: As for ``fidelity``.
        setting: Period and contact; coupling and substeps are not used.

    Raises:
        SceneError: The scene does not compile.
    """
    one = fidelity(source, scene, replace(setting, substeps=1), max_work=MAX_WORK)
    if one is None or not one.deviations:
        return 1, one
    own = _with_step(scene, setting, one.step)
    if own.substeps <= 1:
        return 1, one
    more = fidelity(source, scene, own, max_work=MAX_WORK)
    return (own.substeps, more) if more is not None and more.size < one.size else (1, one)


def _with_step(scene: Scene, setting: RunPoint, step: float) -> RunPoint:
    """Returns a setting whose scene has a time step in s, or as many substeps as there may be."""
    if step > (1.0 + ROUNDING) * setting.period:
        return replace(setting, period=step, substeps=1)
    most = 1 if scene.has_several_hands else MAX_SUBSTEPS
    return replace(setting, substeps=min(math.ceil(setting.period / step - ROUNDING), most))
