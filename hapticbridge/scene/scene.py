"""Compiled scene with a handle and a coupling."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.errors import SceneError, SceneWarning, choices
from hapticbridge.kernel.codes import (
    HANDLE,
    WARNINGS,
    WELD_NAME,
    coupling_ids,
    held_body,
    held_joint,
    warning_words,
)
from hapticbridge.kernel.colliders import use_exact_points
from hapticbridge.kernel.mujoco_c import warning_of
from hapticbridge.kernel.pose import IDENTITY_POSE
from hapticbridge.kernel.rigid_contact import (
    IMPRATIO,
    MARGIN,
    MAX_MARGIN,
    largest_margin,
    rigid_margins,
)
from hapticbridge.scene.checks import NOTABLE_OVERLAP, listed, overlaps, refuse_callbacks
from hapticbridge.scene.compile import PROGRAM_CREDIT, clause, custom_numbers, go_to_start
from hapticbridge.scene.handle import (
    add_weld,
    carry_over,
    hanging_loads,
    set_step,
    set_weld_gains,
    tied_trees,
)
from hapticbridge.scene.softness import announce_rigid
from hapticbridge.scene.source import SourceFile
from hapticbridge.scene.treatment import TREATMENTS, SceneChange
from hapticbridge.units import format_si

_MARGINS = ("geom_margin", "pair_margin", "flex_margin")
_GAPS = ("geom_gap", "pair_gap", "flex_gap")
_LIMIT_MARGINS = ("jnt_margin", "tendon_margin")
_PRECISE = {"iterations": 100, "ls_iterations": 50, "tolerance": 1e-8, "ls_tolerance": 0.01}
"""MuJoCo's own limits of its solver. Where a file's are laxer, the solver may stop so early that
the energy of contacts cannot be computed from its forces: with ``ls_iterations`` 10, three boxes
under a plate created 1.3 J."""


_RIGID = [subject for subject, treatment in TREATMENTS.items() if treatment.is_rigid]
_OF_RUN = ("time step", "adhesion", *_RIGID)
"""Subjects of changes that a run's settings make, and not the loading of the scene."""


def _place(change: SceneChange) -> int:
    return _OF_RUN.index(change.subject)


def iteration_limit(model: mujoco.MjModel, *, is_rigid: bool) -> int:
    """Returns the number of iterations at which the solver of a file's model stops in a run."""
    return max(int(model.opt.iterations), int(_PRECISE["iterations"]) if is_rigid else 0)


def _rigid_options(option: mujoco.MjOption) -> dict[str, Any]:
    """Returns the values of options that rigid contacts need."""
    return {
        "cone": mujoco.mjtCone.mjCONE_ELLIPTIC,
        "impratio": IMPRATIO,
        "noslip_iterations": 0,
        "enableflags": option.enableflags | int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT),
        # it stands for all margins where the file overrides them, and cannot follow the speed
        "o_margin": max(option.o_margin, MAX_MARGIN if _overrides(option) else MARGIN),
        **{
            name: (min if "tolerance" in name else max)(getattr(option, name), usual)
            for name, usual in _PRECISE.items()
        },
    }


def _overrides(option: mujoco.MjOption) -> bool:
    return bool(option.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE)


def has_rigid_contact(model: mujoco.MjModel) -> bool:
    """Returns True if a model has the options that ``Scene.set_contact`` sets for rigid ones."""
    margins = np.concatenate([getattr(model, name).ravel() for name in _MARGINS])
    needed = _rigid_options(model.opt)
    is_set = all(getattr(model.opt, name) == value for name, value in needed.items())
    return is_set and bool(np.all(margins >= MARGIN))


def _widen_bodies(model: mujoco.MjModel, more: float) -> None:
    """Lets MuJoCo compare bodies from the distance of their geoms' contacts, and more, in m."""
    model.body_margin[:] = 0.0
    reach = model.geom_margin + model.geom_gap + more
    np.maximum.at(model.body_margin, model.geom_bodyid, reach)


@dataclass(slots=True, repr=False)
class Scene:
    """A compiled scene with its handle, ready to be stepped.

    Attributes:
        path: The MJCF file.
        grip: Name of the site on the tool.
        model: MuJoCo's model, with the bridge's handle and coupling.
        data: State of the model. A run begins at the start, whatever was written here.
        sources: The original bytes of the file, its includes and its assets.
        parameters: Value of each of the scene's parameters, in the unit of its parameter file.
        differences: What differs from the file.
        as_is: True if the scene must not be changed to be felt.
        is_carried: True if the weight of the tool is compensated (``carry_tool``).
        other_grips: Names of the sites that further hands hold.
        held: Clauses on constraints that leave a grip few of its motions, or none.
        hand: Number of the hand that holds ``grip``, from 0 (``of_hand``).
        findings: Sentences on faults of the scene that the user was warned of. The recording keeps
            them as events.
    """

    path: Path
    grip: str
    model: mujoco.MjModel
    data: mujoco.MjData
    sources: tuple[SourceFile, ...]
    parameters: dict[str, float] = field(default_factory=dict)
    differences: tuple[SceneChange, ...] = ()
    as_is: bool = False
    is_carried: bool = False
    other_grips: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    hand: int = 0
    findings: tuple[str, ...] = ()

    _spec: mujoco.MjSpec | None = None
    _first_grip: str = ""
    _is_claimed: bool = False
    _reach: float = 0.0
    _period: float = 0.0
    _own_contact: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        bodies, freedom = self.model.nbody - 1, self.model.nv
        return f"<Scene '{self.name}' held at '{self.grip}', {bodies} bodies, {freedom} freedoms>"

    @property
    def changes(self) -> tuple[str, ...]:
        """Differences from the file, each as ``name: old → new``, some with a reason."""
        return tuple(map(str, self.differences))

    def claim(self) -> None:
        """Reserves the scene for one bridge, because two bridges would move one tool.

        Raises:
            SceneError: Another bridge uses it, or a callback of MuJoCo is set.
        """
        refuse_callbacks()
        if self._is_claimed:
            raise SceneError(f"scene '{self.name}' is in use by another bridge; load it again")
        self._is_claimed = True

    def of_hand(self, hand: int) -> Scene:
        """Returns the scene as one of its hands holds it; model and data are shared.

        It is outdated once the model is replaced (``carry_tool``).
        """
        if hand == 0:
            return self
        return replace(self, grip=self.other_grips[hand - 1], hand=hand, _first_grip=self.grip)

    @property
    def credit(self) -> float:
        """Energy in J that a scene of another program may give to a hand; 0 for another scene."""
        return next(iter(custom_numbers(self.model, PROGRAM_CREDIT)), 0.0)

    @property
    def has_several_hands(self) -> bool:
        """True if several hands hold the scene."""
        return bool(self.other_grips)

    @property
    def joint(self) -> int:
        """Id of the joint that the hand holds; -1 if it holds a site."""
        return held_joint(self.model, self.grip)

    def release(self) -> None:
        """Releases the scene for another bridge."""
        self._is_claimed = False

    @property
    def name(self) -> str:
        """The file's name without its suffix."""
        return self.path.stem

    def reset(self) -> None:
        """Resets the scene to ``home`` or ``qpos0``, with the handle at the grip.

        Raises:
            SceneError: MuJoCo stops there, or warns (``codes.WARNINGS``).
        """
        try:
            go_to_start(self.model, self.data, self._first_grip or self.grip)
        except mujoco.FatalError as error:
            raise SceneError(
                f"MuJoCo stops at the start of scene '{self.name}': {clause(error)}"
            ) from None
        code = warning_of(self.data)
        if code in WARNINGS:
            raise SceneError(f"at the start of scene '{self.name}' {warning_words(code)}")

    def tell_written_state(self) -> None:
        """Warns that a run begins at the start, if another state was written into the data.

        Of a scene that was stepped, as by an earlier run, nothing is said.
        """
        start = mujoco.MjData(self.model)
        go_to_start(self.model, start, self.grip)
        written = [
            name
            for name in ("qpos", "qvel", "act", "ctrl")
            if not np.array_equal(getattr(start, name), getattr(self.data, name))
        ]
        if written and self.data.time == start.time:
            words = (
                f"data.{written[0]} is not that of the scene's start, where a run begins; write it "
                "into keyframe 'home' of the scene"
            )
            warnings.warn(SceneWarning(self.path, words), stacklevel=3)

    def grip_pose(self) -> tuple[float, ...]:
        """Returns the grip's pose (x, y, z, qw, qx, qy, qz) in the world frame, positions in m.

        A joint at q, in m or rad, has the pose (q, 0, 0, 1, 0, 0, 0).
        """
        if self.joint >= 0:
            return (float(self.data.qpos[self.model.jnt_qposadr[self.joint]]), *IDENTITY_POSE[1:])
        site_id = self.model.site(self.grip).id
        position, quaternion = self.data.site_xpos[site_id], self.data.site_xquat[site_id]
        sign = 1.0 if quaternion[0] >= 0 else -1.0
        return tuple(float(value) for value in (*position, *(sign * quaternion)))

    def remaining_overlap(self) -> str:
        """Returns the pairs that overlap now, of a scene that began so; empty if none does."""
        if not any(change.subject == "overlap" for change in self.differences):
            return ""
        now = mujoco.MjData(self.model)  # another thread may step the scene's own
        for name in ("qpos", "mocap_pos", "mocap_quat"):
            getattr(now, name)[:] = getattr(self.data, name)
        if not np.isfinite(now.qpos).all():
            return ""
        mujoco.mj_fwdPosition(self.model, now)
        overlapping = overlaps(self.model, now, NOTABLE_OVERLAP)
        return listed(overlapping) if overlapping else ""

    def set_timestep(self, scene_period: float, substeps: int = 1) -> None:
        """Sets MuJoCo's timestep to scene_period / substeps, in s.

        ``scene_period`` is the time between two results: T, or n T of a slower scene. ``model`` and
        ``data`` are replaced if the scene has delays, which keep their time; a weld is then lost.

        Raises:
            SceneError: The period is not finite and positive, or substeps is below 1.
        """
        if not np.isfinite(scene_period) or scene_period <= 0:
            raise SceneError(f"period is {scene_period!r} s; it must be finite and > 0")
        if substeps < 1:
            raise SceneError(f"substeps is {substeps}; it must be 1 or more")
        before, step = self.model.opt.timestep, scene_period / substeps
        self.model.opt.timestep, self._period = step, scene_period
        own = self._spec.option.timestep if self._spec else step
        words = f"timestep: {format_si(own, 's')} → {format_si(step, 's')}"
        self._announce(["time step"], [] if math.isclose(own, step) else [words])
        if self._spec and self.model.nhistory and step != before:
            self._recompile(self._spec)

    def _announce(self, subjects: Collection[str], words: Iterable[str | SceneChange]) -> None:
        """Replaces the changes on some subjects, of which words belong to the first.

        The changes of a run's settings come first, in the order of the table, so that a run and its
        audit list them alike.
        """
        new = [SceneChange(each, *subjects) if isinstance(each, str) else each for each in words]
        of_run = [each for each in self.differences if each.subject in _OF_RUN]
        of_file = [each for each in self.differences if each.subject not in _OF_RUN]
        kept = [each for each in of_run if each.subject not in subjects]
        self.differences = (*sorted([*kept, *new], key=_place), *of_file)

    def set_reach(self, distance: float) -> None:
        """Lets MuJoCo detect contacts, without a force, from a distance in m before they touch.

        The distance is added to the gaps in the scene's file.
        """
        if distance == self._reach:
            return
        more, self._reach = distance - self._reach, distance
        self.model.geom_gap += more
        self.model.pair_gap += more
        self.model.flex_gap += more
        self._set_margins()
        pulls = self.model.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY  # adhesion alone has it
        if self.model.flg_adhesion or np.any(pulls):
            # each of two geoms has it
            words = (
                f"adhesion: from the file's gap on → from {format_si(2 * distance, 'm')} before it"
            )
            self._announce(["adhesion"], [words] if distance else [])

    def set_contact(self, *, is_rigid: bool) -> None:
        """Sets the options that rigid contacts need (``kernel.rigid_contact``), or the scene's own.

        Rigid contacts have an elliptic cone of friction, the regularisation of friction divided by
        ``IMPRATIO``, no pass of the solver ``noslip``, the exact diagonal, a margin beyond the
        file's, limits of the solver no laxer than MuJoCo's own, and the points of
        ``kernel.colliders``.
        """
        model, own = self.model, self._own_contact
        if is_rigid == bool(own):
            self._set_margins()
            return
        if not is_rigid:
            self._announce(_RIGID, [])
            self._restore_contact(model)
            self._own_contact = {}
            return
        needed = _rigid_options(model.opt)
        self._announce(_RIGID, announce_rigid(model, needed))
        own = {name: getattr(model.opt, name) for name in needed}
        own |= {name: getattr(model, name).copy() for name in (*_MARGINS, *_LIMIT_MARGINS)}
        own |= {name: getattr(model, name) - self._reach for name in _GAPS}
        self._own_contact = own  # a new object: copies of the scene share the old one
        for name, value in needed.items():
            setattr(model.opt, name, value)
        self._set_margins()
        use_exact_points(model)

    def _set_margins(self) -> None:
        """Sets the margins of rigid contacts at rest; in a run they follow the speed."""
        for name in _MARGINS if self._own_contact else ():
            getattr(self.model, name)[:] = rigid_margins(self._own_contact[name])
        for name in _GAPS if self._own_contact else ():
            # a negative gap would let MuJoCo see a contact in penetration only
            getattr(self.model, name)[:] = np.maximum(self._own_contact[name], 0.0) + self._reach
        for name in _LIMIT_MARGINS if self._own_contact else ():
            getattr(self.model, name)[:] = self._own_contact[name]
        widest = largest_margin(self._period) if self._own_contact else 0.0
        _widen_bodies(self.model, widest)

    def _restore_contact(self, model: mujoco.MjModel) -> None:
        for name, value in self._own_contact.items():
            is_array = name in (*_MARGINS, *_LIMIT_MARGINS, *_GAPS)
            own = value + self._reach if name in _GAPS else value
            setattr(model if is_array else model.opt, name, own)
        _widen_bodies(model, 0.0)
        use_exact_points(model, is_used=False)

    def set_gains(
        self, force: tuple[float, float, float], torque: tuple[float, float, float]
    ) -> None:
        """Sets control gain, stiffness and damping of the actuators of this hand's coupling.

        Args:
            force: Gains of the three translational actuators, in SI units per m and m/s.
            torque: Gains of the three rotational actuators, in SI units per rad and rad/s.
        """
        for axis, actuator_id in enumerate(coupling_ids(self.model, self.hand)):
            gain, stiffness, damping = force if axis < 3 else torque  # forces come first
            self.model.actuator_gainprm[actuator_id, 0] = gain
            self.model.actuator_biasprm[actuator_id, 1] = -stiffness
            self.model.actuator_biasprm[actuator_id, 2] = -damping
            if self.joint >= 0:  # held where it is, until the kernel moves its handle
                self.model.actuator_gainprm[actuator_id, 0] = 0.0
                self.model.actuator_biasprm[actuator_id, 0] = stiffness * self.grip_pose()[0]

    def carry_tool(self, reason: str) -> None:
        """Compensates the weight of all that moves with the grip (MuJoCo's ``gravcomp``).

        This is the tree of the grip's body, and what active welds and connects tie to it.
        ``model`` and ``data`` are replaced, and the change is noted with its reason. Inertia,
        contacts and motors stay. A carried weight stores no energy.

        Raises:
            SceneError: The scene was not made by ``load_scene``.
        """
        if self._spec is None:
            raise SceneError("only the weight of a tool in a scene from load_scene can be carried")
        # MuJoCo compensates only if a body asked for it in compilation; the handle has no mass
        self._spec.body(HANDLE).gravcomp = 1.0
        self._recompile(self._spec)
        model = self.model
        grips = {self._first_grip or self.grip, *self.other_grips}
        held = {held_body(model, grip) for grip in grips}
        own = {int(model.body_treeid[i]) for i in held}
        trees = sorted(set().union(*(tied_trees(model, tree) for tree in own)))
        model.body_gravcomp[np.isin(model.body_treeid, trees)] = 1.0
        self.is_carried, words = True, "weight of the tool: felt → carried"
        firsts = [int(model.tree_bodyadr[tree]) for tree in trees if tree not in own]
        if firsts:
            more = f" and {len(firsts) - 1} more" if len(firsts) > 1 else ""
            name = model.body(firsts[0]).name or firsts[0]
            words += f", with that of what is tied to it, '{name}'{more}"
        self.reset()
        if loads := hanging_loads(self.data, trees):
            words += f", but not that of {choices(loads)} on its tendons"
        self.differences += (SceneChange(words, "weight", reason),)

    def for_trial(self) -> Scene:
        """Returns a copy with a model and data of its own, whose settings a trial may change."""
        trial = copy.copy(self)
        trial.model = copy.copy(self.model)
        trial.data = mujoco.MjData(trial.model)
        return trial

    def with_tool_carried(self) -> Scene:
        """Returns a copy that carries its tool's weight (``carry_tool``), for a trial."""
        trial = copy.copy(self)
        trial._spec = self._spec.copy() if self._spec else None
        trial.carry_tool("")
        return trial

    def _recompile(self, spec: mujoco.MjSpec) -> None:
        spec = spec.copy()
        set_step(spec, self.model.opt.timestep)
        model = spec.compile()
        carry_over(self.model, model)
        self.model, self.data = model, mujoco.MjData(model)

    def _set_diagonal(self, own: int, *, is_exact: bool) -> None:
        """Sets the exact diagonal, which gives a weld its stiffness, or what the file's flags say.

        The flags of rigid contacts have it; those that they replace are then the scene's.
        """
        bit, replaced = int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT), self._own_contact
        flags = replaced["enableflags"] if replaced else self.model.opt.enableflags
        flags = flags | bit if is_exact else (flags & ~bit) | (own & bit)
        if replaced:
            self._own_contact = replaced | {"enableflags": flags}
        else:
            self.model.opt.enableflags = flags

    def set_weld(self, coupling: Coupling | None) -> None:
        """Welds the grip to the handle with K and B as ``solref``; None removes the weld.

        A weld changes the model's size, so ``model`` and ``data`` are replaced. Changes to the old
        model are copied to the new one. Without a weld before and after, nothing changes.

        Raises:
            SceneError: The scene was not made by ``load_scene``.
        """
        has_weld = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_EQUALITY, WELD_NAME) >= 0
        if has_weld != (coupling is not None):
            if self._spec is None:
                raise SceneError(
                    "only a scene from load_scene can be welded to its handle; load it with "
                    "load_scene, or choose another method"
                )
            spec = self._spec.copy()
            if coupling is not None:
                add_weld(spec, self.grip)
            self._recompile(spec)
            self._set_diagonal(self._spec.option.enableflags, is_exact=coupling is not None)
        if coupling is not None:
            set_weld_gains(self.model, coupling)
