"""The kernel's state, bound to a model and its data: seventeen sub-records, each with one writer.

One structured array of one element crosses from Python into the compiled functions: unpacking one
array costs 0.1 µs, unpacking forty would cost more than MuJoCo's step. Numba hands its sub-records
to functions by reference, at no cost. All fields are 8 bytes wide, so every field is aligned.

| sub-record  | contents                                          | written by                    |
|-------------|---------------------------------------------------|-------------------------------|
| mj          | addresses, sizes and ids of model and data        | state, once                   |
| run         | period, scheme, scales, limits, axes              | state, once                   |
| coupling    | K, B', gains of the actuators, goal of a change   | law                           |
| level       | force level, share of the gains                   | force_level                   |
| pose        | poses of device, handle and tool, and their steps | handle                        |
| loop        | results that a stage of a tick hands to the next  | tick                          |
| energy      | storage, works of all ports, slack, verdict       | ledger                        |
| elastic     | energy of flexes, a second model for their force  | elastic                       |
| guard       | thresholds, ramp, fade, buttons                   | tick_guard                    |
| observer    | energy at the device, added damping               | passivity_controller          |
| watch       | late force, sign of the force, greatest ratio      | swing_watch                   |
| lossless    | carried force, balanced velocity, present form    | lossless                      |
| springs     | springs and dampers of the tool's tree            | springs                       |
| contact     | tank and share of rigid contacts                  | rigid_contact                 |
| shown       | shown pose of a slower scene's tool, its tank     | shown_tool                    |
| timing      | times of samples and forces, their energy         | timing                        |
| impact      | blows of the tool, pulse on the device, account   | impact_pulse                  |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.codes import (
    HANDLE,
    WELD_NAME,
    Scheme,
    State,
    added_actuators,
    added_id,
    coupling_ids,
    handle_ids,
    held_body,
    held_joint,
    moving_geoms,
    name_of_hand,
)
from hapticbridge.kernel.colliders import bind_colliders
from hapticbridge.kernel.compared_methods import balance_contacts, massless_tool
from hapticbridge.kernel.elastic import ELASTIC_DTYPE, bind_elastic, start_elastic
from hapticbridge.kernel.force_level import LEVEL_DTYPE, bind_level
from hapticbridge.kernel.handle import (
    POSE_DTYPE,
    anchor_handle,
    bind_poses,
    follow_handle,
    handle_facts,
    move_handle_home,
    set_tool,
)
from hapticbridge.kernel.impact_pulse import (
    IMPACT_DTYPE,
    bind_pulse,
    end_pulse,
    forget_pulses,
    forgo_spare_damping,
)
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.law import (
    COUPLING_DTYPE,
    Gains,
    bind_coupling,
    forget_sent,
    implicit_gains,
    set_tuning_goal,
)
from hapticbridge.kernel.ledger import (
    ENERGY_DTYPE,
    add_reset_work,
    refresh_energies,
    start_energies,
)
from hapticbridge.kernel.lossless import LOSSLESS_DTYPE, bind_lossless, note_twist, restart_lossless
from hapticbridge.kernel.mujoco_c import MJ_DTYPE, forget_warnings, model_addresses
from hapticbridge.kernel.parameters import SEVERAL_HANDS, RunParameters, no_pulses
from hapticbridge.kernel.passivity_controller import (
    OBSERVER_DTYPE,
    bind_observer,
    credit_springs,
    observe_reset,
)
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.rigid_contact import RIGID_DTYPE, bind_contact, restore_model
from hapticbridge.kernel.shown_tool import (
    SHOWN_DTYPE,
    bind_shown,
    start_shown,
    tool_geoms,
)
from hapticbridge.kernel.springs import SPRINGS_DTYPE, restore_springs
from hapticbridge.kernel.swing_watch import WATCH_DTYPE, bind_watch
from hapticbridge.kernel.tick import LOOP_DTYPE, between_halves, discard_wrench, pause
from hapticbridge.kernel.tick_guard import (
    GUARD_DTYPE,
    bind_guard,
    let_go,
    restart_ramp,
    set_commanded,
)
from hapticbridge.kernel.timing import TIMING_DTYPE, bind_timing

MujocoStep = Callable[[mujoco.MjModel, mujoco.MjData], None]

_FROM_PARAMETERS = (
    "period",
    "substeps",
    "scheme",
    "law_evaluations",
    "has_law",
    "is_apart",
    "holds_wrench",
    "scale",
    "force_scale",
    "force_limit",
    "torque_limit",
    "ramp_ticks",
    "contact_stiffness",
    "axes",
)

RUN_DTYPE = np.dtype(
    [
        ("scheme", "<i8"),
        ("substeps", "<i8"),
        ("law_evaluations", "<i8"),
        ("has_law", "<i8"),
        ("is_apart", "<i8"),
        ("holds_wrench", "<i8"),
        ("watches_device", "<i8"),
        ("ramp_ticks", "<i8"),
        ("period", "<f8"),
        ("timestep", "<f8"),
        ("scale", "<f8"),
        ("force_scale", "<f8"),
        ("force_limit", "<f8"),
        ("torque_limit", "<f8"),
        ("contact_stiffness", "<f8"),
        ("device_damping", "<f8"),
        ("device_rotational_damping", "<f8"),
        ("axes", "<f8", 9),
        ("axes_quaternion", "<f8", 4),
    ]
)
"""Sub-record ``run``, bound once: numbers of ``RunParameters``. ``axes`` is the row-major rotation
from the device's axes to the scene's, ``axes_quaternion`` the quaternion of this rotation;
``watches_device`` is 1 if the energy sent to the device is compared with its dissipation."""

STATE_DTYPE = np.dtype(
    [
        ("mj", MJ_DTYPE),
        ("run", RUN_DTYPE),
        ("coupling", COUPLING_DTYPE),
        ("level", LEVEL_DTYPE),
        ("pose", POSE_DTYPE),
        ("loop", LOOP_DTYPE),
        ("energy", ENERGY_DTYPE),
        ("elastic", ELASTIC_DTYPE),
        ("guard", GUARD_DTYPE),
        ("observer", OBSERVER_DTYPE),
        ("watch", WATCH_DTYPE),
        ("lossless", LOSSLESS_DTYPE),
        ("springs", SPRINGS_DTYPE),
        ("contact", RIGID_DTYPE),
        ("shown", SHOWN_DTYPE),
        ("timing", TIMING_DTYPE),
        ("impact", IMPACT_DTYPE),
    ]
)
"""The kernel's state; the module's docstring has a table of its sub-records."""


class Place(NamedTuple):
    """Place of a hand's state among those of several hands.

    Attributes:
        hand: Number of the hand in the scene, from 0. The first hand's state meters the scene.
        state: Its element of an array of states; None for a state of its own, which meters too.
        row: Its element of an array of records; None for a record of its own.
    """

    hand: int = 0
    state: NDArray[np.void] | None = None
    row: NDArray[np.void] | None = None


ALONE = Place()
"""Place of a hand that is alone."""


class BoundKernel:
    """The kernel's state bound to one model, its data and the parameters of one run.

    Args:
        model: The prepared scene.
        data: Its data, at the start.
        parameters: Parameters of the run; for a slower scene's own kernel ``of_scene``.
        loop: For such a kernel that of the bridge's loop, whose handle is its device.
        place: Place of the hand's state among those of several hands.

    Attributes:
        state: One element of ``STATE_DTYPE``.
        row: One element of ``TICK_DTYPE``, written by each tick.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        parameters: RunParameters,
        loop: BoundKernel | None = None,
        place: Place = ALONE,
    ) -> None:
        """Binds; the tool's present pose and energy are those of the run's start.

        Raises:
            SceneError: MuJoCo's memory layout differs from its description
                (``mujoco_c.addresses``).
        """
        self.state = np.zeros(1, STATE_DTYPE) if place.state is None else place.state
        self.row = np.zeros(1, TICK_DTYPE) if place.row is None else place.row
        self._hand, self._meters_scene = place.hand, place.hand == 0 or place.state is None
        forget_warnings(data)  # those of a start or a trial are not the run's
        # the addresses in the state point into them
        self._model, self._data, self._loop = model, data, loop
        self._grip = parameters.grip
        self._owned: dict[str, NDArray[np.generic]] = {}
        self._restore_springs: Callable[[State], None] | None = None
        self._bind_model(parameters)
        self._bind_run(parameters)
        self._start(parameters)

    @property
    def hands(self) -> tuple[BoundKernel, ...]:
        """The kernel of the only hand, as ``BoundHands`` has those of several."""
        return (self,)

    @property
    def _record(self) -> State:
        """The state as one record, whose sub-records are views."""
        return self.state[0]

    @property
    def wrench_on_device(self) -> NDArray[np.float64]:
        """Wrench of the last tick on the device (force in N, torque in N m), as a view."""
        return cast(NDArray[np.float64], self.state["loop"]["wrench_on_device"][0])

    @property
    def external_flags(self) -> NDArray[np.int64]:
        """Flag ``STALE_SAMPLE`` of the next tick; the loop fills this view."""
        return cast(NDArray[np.int64], self.state["loop"]["external_flags"])

    @property
    def slack(self) -> float:
        """Energy in J that the environment may have created so far."""
        return float(self.state["energy"]["slack"][0])

    @property
    def step(self) -> MujocoStep:
        """MuJoCo's part of a substep through the Python bindings.

        ``kernel.tick.advance`` calls the C functions with equal results to the bit.
        """
        plain: MujocoStep = mujoco.mj_step
        if self._record["run"]["scheme"] == Scheme.MASSLESS:
            plain = mujoco.mj_fwdPosition
        if not self._record["contact"]["is_rigid"]:
            return plain
        state, aim = self.state, direct(between_halves, self.state)

        def step(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            mujoco.mj_step1(model, data)
            aim(state)
            mujoco.mj_step2(model, data)

        return step

    def resume(self) -> None:
        """Starts the ramp at the next tick, after a pause in which zero was commanded."""
        s = self._record
        restart_ramp(s["guard"], int(s["loop"]["tick"]), int(s["run"]["ramp_ticks"]))
        forget_sent(s["coupling"])
        forget_pulses(s["impact"])
        pause(s["loop"])

    def tune(self, parameters: RunParameters, gains: tuple[Gains, Gains], ticks: int) -> None:
        """Changes the coupling from the next tick on (``kernel.law``).

        Args:
            parameters: Parameters of the run with the new coupling.
            gains: Gains of its actuators (``methods.Method.gains``).
            ticks: Length of the change in ticks, >= 1.
        """
        set_tuning_goal(self._record["coupling"], parameters, gains, ticks)
        forgo_spare_damping(self._record["impact"])

    def command(self, bits: int) -> None:
        """Sets the commands in force from the next tick on, ``FORCE_OFF`` and ``CLUTCHED``."""
        set_commanded(self._record["guard"], bits)

    def release(self) -> None:
        """Puts back what a step that was broken off left in the model, at the end of a run."""
        if self._record["shown"]["is_shown"]:
            return  # the scene's own loop writes to the model, and may still be in a step
        if self._restore_springs is not None:
            self._restore_springs(self._record)
        restore_model(self._model, self._owned)

    def handle_reset(self, pose: Sequence[float] | None = None) -> None:
        """Continues after the scene's data were set back to a start.

        ``pose`` is where another program has put its tool, as x, y, z, qw, qx, qy, qz; the handle
        is put there, too.

        The handle is placed at its start, and the device's pose belongs to it from the next tick
        on; a slower scene's handle stays that of its loop. The change of the scene's storage is
        work of the external port. Energy that the device received before is not forgotten.
        """
        s = self._record
        before = float(s["energy"]["kinetic"] + s["energy"]["potential"])
        self._take_tool_pose()
        if pose is not None:
            set_tool(s["pose"], np.array(pose[:3]), np.array(pose[3:]))
        move_handle_home(s["pose"], at_tool=pose is not None)
        restore_model(self._model, self._owned)
        discard_wrench(s["loop"])
        forget_sent(s["coupling"])
        end_pulse(s["impact"])
        direct(start_elastic, s)(s)
        direct(refresh_energies, s)(s)
        after = float(s["energy"]["kinetic"] + s["energy"]["potential"])
        add_reset_work(s["energy"], after - before)
        observe_reset(s)
        direct(credit_springs, s)(s)
        if self._loop is None:
            direct(anchor_handle, s["pose"])(s["pose"])  # also if the device stays at rest
            let_go(s["guard"])
        if s["run"]["scheme"] == Scheme.MIDPOINT:
            direct(restart_lossless, s)(s)
        elif s["shown"]["is_shown"]:
            direct(start_shown, self.state)(self.state)

    def _bind_model(self, parameters: RunParameters) -> None:
        model, data, mj = self._model, self._data, self._record["mj"]
        bind_colliders(model)
        values, owned = model_addresses(model, data)
        for name, value in values.items():
            mj[name] = value
        self._own(owned)
        first, *_ = coupling_ids(model, self._hand)
        handles, own = handle_ids(model), len(added_actuators(model))
        mj["coupling_outputs"], mj["handle_count"] = own, len(handles)
        mj["metered_mocaps"] = model.nmocap - len(handles) if self._meters_scene else 0
        mj["grip_body_id"] = held_body(model, self._grip)
        joint, grip = held_joint(model, self._grip), -1
        if joint >= 0:
            mj["held_qpos"] = data.qpos[model.jnt_qposadr[joint] :].ctypes.data
        else:
            handle = name_of_hand(HANDLE, self._hand)
            mj["handle_site_id"] = added_id(model, mujoco.mjtObj.mjOBJ_SITE, handle)
            mj["handle_mocap_id"] = model.body_mocapid[handles[self._hand]]
            mj["handle_body_id"] = handles[self._hand]
            grip = mj["grip_site_id"] = model.site(self._grip).id
        mj["weld_id"] = added_id(model, mujoco.mjtObj.mjOBJ_EQUALITY, WELD_NAME)
        mj["coupling_actuator_id"] = first
        mj["coupling_ctrl_adr"] = model.actuator_ctrladr[first]
        mj["coupling_output_adr"] = model.actuator_outadr[first]
        facts, dofs = handle_facts(mj, model)
        for name, value in facts.items():
            mj[name] = value
        self._own({"grip_dofs": dofs})
        mj["has_actuators"] = model.nactuator > own or bool(np.any(model.jnt_actgravcomp))
        mj["has_belts"] = np.any(model.geom_surfacevel)
        self._elastic = bind_elastic(self._record["elastic"], model)
        if parameters.scheme == Scheme.MASSLESS:
            self._own(massless_tool(model, grip))
            mj["tool_map_size"] = self._owned["tool_map"].size
        elif joint < 0:
            parts = np.ascontiguousarray(moving_geoms(model, grip), dtype=np.int32)
            self._own({"geom_is_tool": tool_geoms(model, grip), "geom_is_part": parts})
        if parameters.scheme == Scheme.MIDPOINT and not parameters.scene_ticks:
            body = int(model.site_bodyid[grip])
            arrays = bind_lossless(self._record, model, data, body, first)
            self._owned |= arrays
            mj["qfrc_applied"] = arrays["user_forces"].ctypes.data

    def _own(self, arrays: dict[str, NDArray[np.generic]]) -> None:
        """Keeps arrays alive as long as the state, which has their addresses under their names."""
        mj = self._record["mj"]
        for name, array in arrays.items():
            mj[name] = array.ctypes.data
        self._owned |= arrays

    def _bind_run(self, parameters: RunParameters) -> None:
        s, run = self._record, self._record["run"]
        for name in _FROM_PARAMETERS:
            run[name] = getattr(parameters, name)
        run["timestep"] = self._model.opt.timestep
        if parameters.scene_ticks:
            run["scheme"], run["substeps"] = Scheme.SHOWN, 1
        run["device_damping"] = parameters.device_damping or 0.0
        run["device_rotational_damping"] = parameters.device_rotational_damping or 0.0
        run["watches_device"] = not parameters.has_law and parameters.device_damping is not None
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.asarray(parameters.axes, dtype=np.float64))
        run["axes_quaternion"] = quaternion
        gains = _whole_gains(self._model, parameters, self._hand)
        bind_coupling(s["coupling"], parameters, gains)
        self._owned |= bind_level(
            s["level"],
            self._model,
            parameters.levels_on_tool,
            is_solved=not parameters.scene_ticks
            and parameters.scheme in (Scheme.IMPLICIT, Scheme.MIDPOINT)
            and self._model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE,
        )
        bind_guard(s["guard"], parameters)
        bind_observer(s["observer"], parameters.guarding)
        bind_watch(s["watch"], parameters)
        bind_timing(s["timing"], parameters.device_delay)
        bind_pulse(s["impact"], parameters)
        bind_shown(s["shown"], parameters)
        is_rigid = parameters.is_rigid and not parameters.scene_ticks and self._meters_scene
        own = replace(parameters, is_rigid=is_rigid)
        self._owned |= bind_contact(s["contact"], self._model, self._data, own)

    def _start(self, parameters: RunParameters) -> None:
        s = self._record
        self._take_tool_pose()
        bind_poses(s["run"], s["pose"], parameters)
        if parameters.credit > 0.0:  # until the program shows its tool, that is at the handle
            pose = s["pose"]
            set_tool(pose, pose["handle_position"], pose["handle_quaternion"])
        if self._loop is not None:
            follow_handle(s["pose"], self._loop.state["pose"][0])
        if parameters.scheme == Scheme.MASSLESS:
            mujoco.mj_fwdPosition(self._model, self._data)
            balance_contacts(s)
        else:
            direct(start_elastic, s)(s)
            direct(refresh_energies, s)(s)
        start_energies(s["energy"])
        direct(credit_springs, s)(s)
        if parameters.scene_ticks:
            direct(start_shown, self.state)(self.state)
        elif parameters.scheme == Scheme.MIDPOINT:
            direct(note_twist, s)(s)
            direct(restart_lossless, s)  # loads its code ahead of a command; not run here
            self._restore_springs = direct(restore_springs, s)

    def _take_tool_pose(self) -> None:
        """Takes the present poses of the tool and of the scene's mocap bodies."""
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        if self._record["mj"]["held_qpos"]:
            joint = model.jnt_qposadr[held_joint(model, self._grip)]
            set_tool(self._record["pose"], np.array([data.qpos[joint], 0.0, 0.0]), np.eye(4)[0])
        else:
            grip = int(self._record["mj"]["grip_site_id"])
            set_tool(self._record["pose"], data.site_xpos[grip], data.site_xquat[grip])
        mocap_previous = self._owned["mocap_previous"]
        mocap_previous[: model.nmocap, :3] = data.mocap_pos
        mocap_previous[: model.nmocap, 3:] = data.mocap_quat


class BoundHands:
    """States of several hands, bound to one model and its data (``kernel.tick``).

    Attributes:
        state: One element of ``STATE_DTYPE`` per hand; the first one meters the scene.
        row: One record of ``TICK_DTYPE`` per hand.
        hands: The bound kernel of each hand.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, parameters: Sequence[RunParameters]
    ) -> None:
        """Binds; ``parameters`` are those of each hand, in the order of the scene's handles.

        Raises:
            HapticBridgeError: The hands' periods differ, or a method does not suit several hands.
            SceneError: As for ``BoundKernel``.
        """
        for each in parameters:
            if not each.properties.allows_hands or each.substeps != 1 or each.scene_ticks:
                raise HapticBridgeError(
                    "several hands need a method that MuJoCo solves whole, one substep, and a "
                    "scene that steps in every tick"
                )
            if each.impact_pulses > 0.0:
                raise no_pulses(each.impact_pulses, SEVERAL_HANDS)
            if (each.period, each.is_rigid) != (parameters[0].period, parameters[0].is_rigid):
                raise HapticBridgeError("all hands of a scene need one period and one contact")
        self.state = np.zeros(len(parameters), STATE_DTYPE)
        self.row = np.zeros(len(parameters), TICK_DTYPE)
        self.hands = tuple(
            BoundKernel(
                model,
                data,
                each,
                place=Place(i, self.state[i : i + 1], self.row[i : i + 1]),
            )
            for i, each in enumerate(parameters)
        )

    @property
    def step(self) -> MujocoStep:
        """MuJoCo's part of a tick through the Python bindings (``BoundKernel.step``)."""
        return self.hands[0].step

    def resume(self) -> None:
        """Starts every hand's ramp at the next tick (``BoundKernel.resume``)."""
        for hand in self.hands:
            hand.resume()

    def release(self) -> None:
        """Puts back what a step that was broken off left in the model, at the end of a run."""
        for hand in self.hands:
            hand.release()


def _whole_gains(model: mujoco.MjModel, parameters: RunParameters, hand: int) -> tuple[float, ...]:
    """Returns the whole gains of a hand's actuators, for forces and then for torques."""
    if parameters.scheme == Scheme.MIDPOINT:
        # the model may have half of them; ``methods.Method`` refuses any other rule
        forces, torques = implicit_gains(parameters.coupling, model.opt.timestep)
        return (*forces, *torques)
    gains: list[float] = []
    for actuator in coupling_ids(model, hand)[::3]:
        bias = model.actuator_biasprm[actuator]
        gains += [float(model.actuator_gainprm[actuator, 0]), -float(bias[1]), -float(bias[2])]
    return (*gains, 0.0, 0.0, 0.0)[:6]
