"""Everything a tick reads and writes, as one preallocated record.

One structured array of one element crosses from Python into the compiled functions: unpacking a
single array costs 0.1 µs, unpacking forty would cost more than MuJoCo's step.
"""

from __future__ import annotations

import numpy as np

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
