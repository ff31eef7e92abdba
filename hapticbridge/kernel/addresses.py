"""Where in a model and its data the tick finds what it needs, and the gains that it starts with."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel import native
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.scheme import LOSSLESS


def gains_of(model: mujoco.MjModel, first: int, parameters: RunParameters) -> tuple[float, ...]:
    """Returns the whole gains of the coupling's actuators: of those that push, then that turn."""
    if parameters.scheme == LOSSLESS:  # the model may have half of them
        coupling = parameters.coupling
        k, b = coupling.stiffness, coupling.damping
        kr, br = coupling.rotational_stiffness, coupling.rotational_damping
        return b, k, b, br, kr, br
    gains: list[float] = []
    for actuator in (first, first + 3):
        bias = model.actuator_biasprm[actuator]
        gains += [float(model.actuator_gainprm[actuator, 0]), -float(bias[1]), -float(bias[2])]
    return tuple(gains)


def bind_addresses(
    model: mujoco.MjModel, data: mujoco.MjData, state: NDArray[np.void]
) -> dict[str, NDArray[np.generic]]:
    """Fills in the addresses and sizes that the tick needs of a model and its data.

    Returns:
        The arrays that must outlive the state, beside model and data themselves, by name.

    Raises:
        SceneError: See ``native.addresses``.
    """
    state["model"], state["data"] = native.addresses(model, data)
    buffer_fields = (
        "qpos qvel qacc ctrl mocap_pos mocap_quat site_xpos site_xquat xipos ten_length "
        "qfrc_actuator qfrc_applied qfrc_gravcomp xfrc_applied actuator_force moment_rownnz "
        "moment_rowadr moment_colind actuator_moment energy solver_niter"
    )
    for name in buffer_fields.split():
        state[name] = getattr(data, name).ctypes.data
    struct_fields = (
        "ncon nisland nefmA efm_aid efm_as efm_ak ne nefc efc_type efc_id efc_pos efc_force contact"
    )
    for name in struct_fields.split():
        state[name] = native.field_address(data, name)
    state["warnings"] = native.field_address(data, "warning")
    state["gainprm"] = model.actuator_gainprm.ctypes.data
    state["biasprm"] = model.actuator_biasprm.ctypes.data

    # actgravcomp hands a joint's gravity compensation to its actuators; the rest is passive
    passive = np.ascontiguousarray(
        1.0 - model.jnt_actgravcomp[model.dof_jntid].astype(np.float64), dtype=np.float64
    )
    # what is fixed to a mocap body, or jointed to it, moves with it
    body_mocap = np.ascontiguousarray(model.body_mocapid[model.body_rootid], dtype=np.int32)
    # flexes may take more rows than 6 an equality, as many as they have now
    equality_capacity = max(6 * model.neq, data.ne)
    owned: dict[str, NDArray[np.generic]] = {
        "passive_gravcomp_dofs": passive,
        "body_mocap": body_mocap,
        "geom_bodyid": np.ascontiguousarray(model.geom_bodyid, dtype=np.int32),
        "tendon_range": np.ascontiguousarray(model.tendon_range, dtype=np.float64),
        "scratch": np.zeros(max(model.nv, 1)),
        "mocap_previous": np.zeros((max(model.nmocap, 1), 7)),
        "mocap_shift": np.zeros((max(model.nmocap, 1), 6)),
        "equality_before": np.zeros(max(equality_capacity, 1)),
        "tendon_before": np.zeros(max(model.ntendon, 1)),
        "outadr": np.ascontiguousarray(model.actuator_outadr, dtype=np.int32),
        "outnum": np.ascontiguousarray(model.actuator_outnum, dtype=np.int32),
    }
    for name, array in owned.items():
        state[name] = array.ctypes.data

    for name in ("nq", "nv", "nbody", "ngeom", "nmocap", "ntendon", "nsensor"):
        state[name] = getattr(model, name)
    state["equality_capacity"] = equality_capacity
    for name, value in native.contact_layout().items():
        state[f"contact_{name}"] = value
    state["has_gravity_compensation"] = bool(np.any(model.body_gravcomp))
    state["has_tendons_or_flexes"] = model.ntendon > 0 or model.nflex > 0
    return owned
