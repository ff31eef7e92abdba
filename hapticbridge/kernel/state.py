"""The kernel's state bound to a model and its data: addresses, sizes, parameters, the start."""

from __future__ import annotations

from dataclasses import fields

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import COUPLING_ACTUATORS, DIRECT, HANDLE, LOSSLESS, WELD, WELD_NAME
from hapticbridge.kernel.compared_methods import balance_contacts, tool_map
from hapticbridge.kernel.handle import (
    TUNED,
    Gains,
    forget_dissipation,
    handle_pose,
    set_gains,
    tuned_values,
)
from hapticbridge.kernel.ledger import refresh_energies
from hapticbridge.kernel.lossless import has_passive_forces, note_twist, tree_of_tool
from hapticbridge.kernel.mujoco_c import bind_addresses, gains_of
from hapticbridge.kernel.parameters import GuardParameters, RunParameters
from hapticbridge.record import TICK_DTYPE

# Everything a tick reads and writes, as one preallocated record.
#
# One structured array of one element crosses from Python into the compiled functions: unpacking
# a single array costs 0.1 µs, unpacking forty would cost more than MuJoCo's step.

_POINTERS = (
    "qpos",
    "qvel",
    "qacc",
    "ctrl",
    "mocap_pos",
    "mocap_quat",
    "site_xpos",
    "site_xquat",
    "energy",
    "solver_niter",
    "xipos",
    "ten_length",
    "qfrc_actuator",
    "qfrc_applied",
    "qfrc_gravcomp",
    "xfrc_applied",
    "actuator_force",
    "moment_rownnz",
    "moment_rowadr",
    "moment_colind",
    "actuator_moment",
    "outadr",
    "outnum",
    "ncon",
    "nisland",
    "nefmA",
    "efm_aid",
    "efm_as",
    "efm_ak",
    "ne",
    "nefc",
    "efc_type",
    "efc_id",
    "efc_pos",
    "efc_force",
    "contact",
    "warnings",
    "passive_gravcomp_dofs",
    "geom_bodyid",
    "body_mocap",
    "tendon_range",
    "mocap_previous",
    "mocap_shift",
    "equality_before",
    "tendon_before",
    "scratch",
    "tool_map",
    "tool_qpos",
    "geom_is_tool",
    "qfrc_written",
    "qfrc_passive",
    "gainprm",
    "biasprm",
    "geom_in_tree",
    "joint_in_tree",
    "dof_in_tree",
    "last_written",
    "carried_force",
    "external",
    "velocity",
    "half_step",
    "bias_at_u",
    "bias_at_v",
    "generalised",
    "kept",
    "wrench_buffer",
)

_COUNTS = (
    "nv",
    "njnt",
    "nbody",
    "ngeom",
    "nmocap",
    "ntendon",
    "equality_capacity",
    "contact_size",
    "contact_distance",
    "contact_point",
    "contact_frame",
    "contact_geoms",
    "contact_dim",
    "contact_row",
    "scheme",
    "substeps",
    "laws",
    "handle_mocap_id",
    "handle_site_id",
    "grip_site_id",
    "grip_body_id",
    "has_law",
    "has_passive",
    "is_never_free",
    "weld_id",
    "tool_map_size",
    "watches_device",
    "coupling_actuator_id",
    "coupling_output_adr",
    "coupling_ctrl_adr",
    "has_actuators",
    "has_gravity_compensation",
    "has_tendons_or_flexes",
    "nq",
    "nsensor",
    "ramp_ticks",
)

_PARAMETERS = (
    "period",
    "timestep",
    "stiffness",
    "damping",
    "rotational_stiffness",
    "rotational_damping",
    "slack_stiffness",
    "slack_rotational_stiffness",
    "contact_stiffness",
    "device_damping",
    "device_rotational_damping",
    "scale",
    "force_scale",
    "force_limit",
    "torque_limit",
)

_GUARD_COUNTS = ("controller", "stale_ticks", "fade_ticks", "clutch", "dead_man", "reseats")

_GUARD_PARAMETERS = (
    "credit",
    "rotational_credit",
    "most_damping",
    "most_rotational_damping",
    "surplus",
    "force_rise",
    "torque_rise",
    "longest_stall",
    "most_speed",
    "most_turn_speed",
    "most_stretch",
    "most_angle",
    "most_energy",
    "reach",
    "ramp_energy",
)

_GUARD_RUNNING_COUNTS = (
    "outside",
    "watch_flags",
    "commanded",
    "is_released",
    "is_seated_anew",
    "tuning_ticks",
    "stale_run",
    "silent_ticks",
    "rise_ticks",
)

_GUARD_RUNNING = (
    "since_news",
    "risen",
    "account",
    "own_before",
    "passed",
    "given",
    "unfelt",
    "kicked",
    "excess",
    "excess_before",
    "injected_damping",
    "injected_rotational_damping",
)

_POSES = ("device", "handle", "tool")

_RUNNING_COUNTS = (
    "tick",
    "ramp_start",
    "flags",
    "mocap_has_moved",
    "active_contacts",
    "is_midpoint",
    "was_midpoint",
    "is_near",
    "is_held",
    "lossless_ticks",
    "hold",
    "has_positions",
    "equality_rows",
    "first_unstrict",
    "first_active",
    "first_kick",
)

_RUNNING = (
    "kinetic",
    "potential",
    "start_energy",
    "coupling_work",
    "actuator_work",
    "external_work",
    "tuning_work",
    "environment_energy",
    "lossless_debt",
    "device_energy",
    "device_burnt",
    "law_work",
    "throughput",
    "slack",
    "slack_share",
    "peak_force",
    "peak_torque",
)

STATE_DTYPE = np.dtype(
    [("model", "<i8"), ("data", "<i8")]
    + [(name, "<i8") for name in _POINTERS + _COUNTS]
    + [(name, "<f8") for name in _PARAMETERS]
    + [
        ("axes", "<f8", 9),
        ("axes_quaternion", "<f8", 4),
        ("device_origin", "<f8", 7),
        ("handle_origin", "<f8", 7),
    ]
    + [(f"{name}_position", "<f8", 3) for name in _POSES]
    + [(f"{name}_quaternion", "<f8", 4) for name in _POSES]
    + [("handle_step", "<f8", 3), ("handle_turn", "<f8", 3), ("twist", "<f8", 3)]
    + [
        (name, "<f8", 6)
        for name in ("wrench_on_tool", "motion", "applied_half", "wrench_on_device")
    ]
    + [(name, "<i8") for name in _RUNNING_COUNTS]
    + [(name, "<f8") for name in _RUNNING]
    + [(name, "<i8") for name in _GUARD_COUNTS + _GUARD_RUNNING_COUNTS]
    + [(name, "<f8") for name in _GUARD_PARAMETERS + _GUARD_RUNNING]
    + [("reversals", "<i8", 6), ("gains", "<f8", 6), ("tuning_goal", "<f8", 12)]
    + [(name, "<f8", 6) for name in ("axis_account", "device_velocity", "slewed")]
)
"""Addresses, sizes, parameters, the previous tick's poses, and the energies so far. Poses are
(x, y, z, qw, qx, qy, qz); ``axes`` is the row-major rotation from the device's frame to the
scene's, ``axes_quaternion`` the same as a quaternion."""


_TRIPS = ("speed", "turn_speed", "stretch", "angle", "energy")


class BoundKernel:
    """The kernel's state bound to one model, its data and the parameters of one run.

    Attributes:
        state: One element of ``STATE_DTYPE``.
        row: One element of ``TICK_DTYPE``, written by each tick.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, parameters: RunParameters
    ) -> None:
        """Binds and resets: the tool's present pose and energy are where the run starts.

        Raises:
            SceneError: MuJoCo's memory layout is not the one described (``native.addresses``).
        """
        self.state = np.zeros(1, STATE_DTYPE)
        self.row = np.zeros(1, TICK_DTYPE)
        self._model, self._data = model, data  # the addresses in the state point into them
        self._owned = bind_addresses(model, data, self.state)
        self._fill_parameters(model, parameters)
        self._start(model, data, parameters)

    def resume(self) -> None:
        """Starts the ramp again at the next tick, after a pause in which zero was commanded."""
        self.state["ramp_start"] = self.state["tick"]
        self.state["rise_ticks"], self.state["risen"] = self.state["ramp_ticks"], 0.0
        self.state["wrench_on_device"] = self.state["slewed"] = 0.0
        self.state["has_positions"] = 0  # whoever had the scene meanwhile may have changed it

    def tune(self, parameters: RunParameters, gains: tuple[Gains, Gains], ticks: int) -> None:
        """Lets the coupling become another one from the next tick on; see ``kernel.tuning``.

        Args:
            parameters: The run's, with the new coupling.
            gains: Of its actuators (``rendering.Method.gains``).
            ticks: How many ticks that takes, >= 1.
        """
        forget_dissipation(self.state)
        self.state["tuning_goal"] = (*tuned_values(parameters), *gains[0], *gains[1])
        self.state["tuning_ticks"] = ticks

    def command(self, bits: int) -> None:
        """Sets which of ``codes.FORCE_OFF`` and ``codes.CLUTCHED`` hold from the next tick on."""
        forget_dissipation(self.state)
        self.state["commanded"] = bits

    def take_reset(self) -> None:
        """Goes on after somebody put the scene's data back to a start, all at once.

        The handle is seated at the tool and the device's pose belongs to it from the next tick on,
        so the coupling is at rest. What the scene stores more or less than before is the work of
        whoever put it there, and is booked at the port ``external``; what the device was given
        before is not forgiven by it.
        """
        state, model, data = self.state, self._model, self._data
        before = float(state["kinetic"][0] + state["potential"][0])
        self._seat(model, data)
        state["handle_position"] = state["tool_position"]
        state["handle_quaternion"] = state["tool_quaternion"]
        state["wrench_on_tool"] = 0.0  # what a held wrench would push with
        state["has_positions"] = state["is_midpoint"] = state["is_near"] = state["hold"] = 0
        refresh_energies(state)
        after = float(state["kinetic"][0] + state["potential"][0])
        state["external_work"] += after - before
        start, ratio = float(state["start_energy"][0]), state["force_scale"] / state["scale"]
        state["given"] += ratio * (min(before - start, 0.0) - min(after - start, 0.0))
        forget_dissipation(state)
        state["is_seated_anew"] = 1
        if state["scheme"][0] == LOSSLESS:
            self._owned["qfrc_applied"][: model.nv] = data.qfrc_applied
            self._owned["last_written"][: model.nv] = data.qfrc_applied
            self._owned["carried_force"][:] = 0.0
            set_gains(state, 1.0)
            note_twist(state)

    def _fill_parameters(self, model: mujoco.MjModel, parameters: RunParameters) -> None:
        state = self.state
        first = model.actuator(COUPLING_ACTUATORS[0]).id
        state["handle_site_id"] = model.site(HANDLE).id
        state["handle_mocap_id"] = model.body_mocapid[model.body(HANDLE).id]
        state["grip_site_id"] = model.site(parameters.grip).id
        state["coupling_actuator_id"] = first
        state["coupling_ctrl_adr"] = model.actuator_ctrladr[first]
        state["coupling_output_adr"] = model.actuator_outadr[first]
        state["has_actuators"] = model.nactuator > len(COUPLING_ACTUATORS) or bool(
            np.any(model.jnt_actgravcomp)
        )
        for name in ("period", "substeps", "scale", "force_scale", "force_limit", "torque_limit"):
            state[name] = getattr(parameters, name)
        state["timestep"] = model.opt.timestep
        state["ramp_ticks"] = state["rise_ticks"] = parameters.ramp_ticks
        for name, value in zip(TUNED, tuned_values(parameters), strict=True):
            state[name] = value
        state["gains"] = gains_of(model, first, parameters)
        state["scheme"], state["laws"] = parameters.scheme, parameters.laws
        state["contact_stiffness"] = parameters.contact_stiffness
        state["device_damping"] = parameters.device_damping or 0.0
        state["device_rotational_damping"] = parameters.device_rotational_damping or 0.0
        state["watches_device"] = not parameters.has_law and parameters.device_damping is not None
        state["weld_id"] = model.equality(WELD_NAME).id if parameters.scheme == WELD else -1
        state["has_law"] = parameters.has_law
        if parameters.scheme == DIRECT:
            self._bind_massless(model)
        if parameters.scheme == LOSSLESS:
            self._bind_lossless(model)
        self._fill_guard(parameters.guarding)
        state["axes"] = parameters.axes
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.asarray(parameters.axes, dtype=np.float64))
        state["axes_quaternion"] = quaternion
        state["device_origin"], state["handle_origin"] = (
            parameters.device_origin,
            parameters.handle_origin,
        )

    def _fill_guard(self, guarding: GuardParameters) -> None:
        for name in _TRIPS:
            self.state[f"most_{name}"] = getattr(guarding, name)
        for field in fields(guarding):
            if field.name not in _TRIPS:
                self.state[field.name] = getattr(guarding, field.name)
        # a device that must be held to move the handle has not been, before the first tick
        self.state["is_released"] = guarding.dead_man != 0

    def _bind_massless(self, model: mujoco.MjModel) -> None:
        grip = int(self.state["grip_site_id"][0])
        numbers, addresses = tool_map(model, grip)
        tool = model.body_weldid[model.site_bodyid[grip]]
        is_tool = model.body_weldid[model.geom_bodyid] == tool
        self._own(
            {
                "tool_map": numbers,
                "tool_qpos": addresses,
                "geom_is_tool": np.ascontiguousarray(is_tool, dtype=np.int32),
            }
        )
        self.state["tool_map_size"] = numbers.size

    def _bind_lossless(self, model: mujoco.MjModel) -> None:
        state, nv = self.state, max(model.nv, 1)
        body = int(model.site_bodyid[int(state["grip_site_id"][0])])
        first = int(state["coupling_actuator_id"][0])
        tree = tree_of_tool(model, body, range(first, first + len(COUPLING_ACTUATORS)))
        owned: dict[str, NDArray[np.generic]] = {
            "geom_in_tree": np.ascontiguousarray(tree.geoms, dtype=np.int32),
            "joint_in_tree": np.ascontiguousarray(tree.joints, dtype=np.int32),
            "dof_in_tree": np.ascontiguousarray(tree.dofs, dtype=np.int32),
            "wrench_buffer": np.zeros(6),
        }
        names = (
            "last_written carried_force external velocity half_step bias_at_u bias_at_v "
            "generalised kept"
        )
        owned |= {name: np.zeros(nv) for name in names.split()}
        # what the user applies is kept apart from what is written for MuJoCo
        users = np.zeros(nv)
        users[: model.nv] = self._data.qfrc_applied
        owned["qfrc_applied"] = users
        owned["last_written"][:] = users
        self._own(owned)
        state["qfrc_written"] = self._data.qfrc_applied.ctypes.data
        state["qfrc_passive"] = self._data.qfrc_passive.ctypes.data
        state["njnt"], state["grip_body_id"] = model.njnt, body
        state["is_never_free"] = tree.is_never_free
        state["has_passive"] = has_passive_forces(model)

    def _own(self, arrays: dict[str, NDArray[np.generic]]) -> None:
        """Keeps arrays alive as long as the state, which has their addresses under their names."""
        for name, array in arrays.items():
            self.state[name] = array.ctypes.data
        self._owned |= arrays

    def _seat(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Takes the tool's pose, and those of the scene's mocap bodies, as they are."""
        state = self.state
        mujoco.mj_kinematics(model, data)
        grip = int(state["grip_site_id"][0])
        orientation = data.site_xquat[grip]
        state["tool_position"] = data.site_xpos[grip]
        state["tool_quaternion"] = orientation if orientation[0] >= 0 else -orientation
        mocap_previous = self._owned["mocap_previous"]
        mocap_previous[: model.nmocap, :3] = data.mocap_pos
        mocap_previous[: model.nmocap, 3:] = data.mocap_quat

    def _start(self, model: mujoco.MjModel, data: mujoco.MjData, parameters: RunParameters) -> None:
        state = self.state
        self._seat(model, data)
        device = parameters.device_start
        x, y, z, qw, qx, qy, qz = device
        handle, handle_orientation = handle_pose(self.state, (x, y, z), (qw, qx, qy, qz))
        state["device_position"], state["device_quaternion"] = device[:3], device[3:]
        state["handle_position"], state["handle_quaternion"] = handle, handle_orientation
        for name in ("first_unstrict", "first_active", "first_kick"):
            state[name] = -1
        if parameters.scheme == DIRECT:
            mujoco.mj_fwdPosition(model, data)
            balance_contacts(state)
        else:
            refresh_energies(state)
        state["start_energy"] = state["kinetic"] + state["potential"]
        if parameters.scheme == LOSSLESS:
            note_twist(state)
