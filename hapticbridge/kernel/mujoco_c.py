"""MuJoCo's C library for compiled code: functions by symbol, fields by address.

Only this module uses MuJoCo's private ``_address`` and the layout of its structs. The layout comes
from the package's own description (``mujoco.introspect``) and is compared with the Python bindings
whenever a scene is bound. Another version of MuJoCo is therefore either right or refused.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from threading import Lock
from typing import Any

import llvmlite.binding
import mujoco
import numpy as np
from mujoco.introspect import ast_nodes, structs
from numpy.typing import NDArray

from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import (
    BAD_RESULT,
    CONSTRAINTS_FULL,
    CONTACTS_FULL,
    OK,
)
from hapticbridge.kernel.jit import Deferred, compiled, direct, external, intrinsic


def library_path() -> Path:
    """Returns MuJoCo's library, which the Python bindings use too."""
    folder = Path(mujoco.__file__).parent
    for pattern in ("libmujoco.so.*", "libmujoco.*.dylib", "mujoco.dll"):
        for path in folder.glob(pattern):
            return path
    raise SceneError(f"no MuJoCo library lies in {folder.name}/ of the installed package mujoco")


# Makes the symbols known to the compiler's linker; the Python bindings use the same library file.
llvmlite.binding.load_library_permanently(str(library_path()))

mj_step: Any = external("mj_step", "void(intp, intp)")
mj_step1: Any = external("mj_step1", "void(intp, intp)")
mj_step2: Any = external("mj_step2", "void(intp, intp)")
mj_kinematics: Any = external("mj_kinematics", "void(intp, intp)")
mj_fwd_kinematics: Any = external("mj_fwdKinematics", "void(intp, intp)")
mj_fwd_position: Any = external("mj_fwdPosition", "void(intp, intp)")
mj_fwd_velocity: Any = external("mj_fwdVelocity", "void(intp, intp)")
mj_transmission: Any = external("mj_transmission", "void(intp, intp)")
mj_sensor_pos: Any = external("mj_sensorPos", "void(intp, intp)")
mj_sensor_vel: Any = external("mj_sensorVel", "void(intp, intp)")
mj_com_pos: Any = external("mj_comPos", "void(intp, intp)")
mj_make_m: Any = external("mj_makeM", "void(intp, intp)")
mj_energy_pos: Any = external("mj_energyPos", "void(intp, intp)")
mj_energy_vel: Any = external("mj_energyVel", "void(intp, intp)")
mj_make_constraint: Any = external("mj_makeConstraint", "void(intp, intp)")
mj_com_vel: Any = external("mj_comVel", "void(intp, intp)")
mj_factor_m: Any = external("mj_factorM", "void(intp, intp)")
mj_passive: Any = external("mj_passive", "void(intp, intp)")
mj_rne: Any = external("mj_rne", "void(intp, intp, int32, intp)")
mj_mul_m: Any = external("mj_mulM", "void(intp, intp, intp, intp)")
mj_mul_jac: Any = external("mj_mulJacVec", "void(intp, intp, intp, intp)")
mj_solve_m: Any = external("mj_solveM", "void(intp, intp, intp, intp, int32)")
mj_apply_ft: Any = external("mj_applyFT", "void(intp, intp, intp, intp, intp, int32, intp)")
mj_differentiate_pos: Any = external("mj_differentiatePos", "void(intp, intp, double, intp, intp)")
mj_integrate_pos: Any = external("mj_integratePos", "void(intp, intp, intp, double)")
mju_mul_mat_vec_sparse: Any = external(
    "mju_mulMatVecSparse", "void(intp, intp, intp, int32, intp, intp, intp, intp)"
)
mju_normalize4: Any = external("mju_normalize4", "double(intp)")
mju_quat2mat: Any = external("mju_quat2Mat", "void(intp, intp)")
mju_sub_quat: Any = external("mju_subQuat", "void(intp, intp, intp)")
mj_contact_force: Any = external("mj_contactForce", "void(intp, intp, int32, intp)")


class _StageClock:
    """Clock ``mjcb_time`` that MuJoCo reads around every stage, and the count of its pauses."""

    def __init__(self) -> None:
        self._pointer = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library_path())), "mjcb_time")
        self._lock, self._pauses, self._kept = Lock(), 0, self._pointer.value

    def pause(self) -> None:
        with self._lock:
            if not self._pauses:
                self._kept, self._pointer.value = self._pointer.value, None
            self._pauses += 1

    def resume(self) -> None:
        with self._lock:
            self._pauses -= 1
            if not self._pauses and not self._pointer:
                self._pointer.value = self._kept


_STAGE_CLOCK = _StageClock()


@contextmanager
def without_timers() -> Iterator[None]:
    """Turns the timers of MuJoCo's stages off inside, for all threads.

    MuJoCo's Python bindings install a clock that is read at the start and end of every stage: 0.7
    µs per step, a quarter of the step of one body. Inside, ``mjData.timer`` adds no time. A clock
    that the program installed by ``mujoco.set_mjcb_time`` stays. Uses may overlap.
    """
    if mujoco.get_mjcb_time() is not None:
        yield
        return
    _STAGE_CLOCK.pause()
    try:
        yield
    finally:
        _STAGE_CLOCK.resume()


_view = Deferred(lambda: import_module("numba").carray)


@intrinsic
def _as_pointer(_typing: Any, _address: Any) -> Any:
    types = import_module("numba.core.types")

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.intp), generate


@intrinsic
def release_fence(_typing: Any) -> Any:
    """Orders the record's bytes before the cursor that publishes them (release semantics)."""

    def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        builder.fence("release")
        return context.get_dummy_value()

    return import_module("numba.core.types").void(), generate


@compiled
def floats(address: int, count: int) -> NDArray[np.float64]:
    """Returns ``count`` doubles at an address, as a view."""
    view: NDArray[np.float64] = _view(_as_pointer(address), count, np.float64)
    return view


@compiled
def singles(address: int, count: int) -> NDArray[np.float32]:
    """Returns ``count`` numbers of single precision at an address, as a view."""
    view: NDArray[np.float32] = _view(_as_pointer(address), count, np.float32)
    return view


@compiled
def ints(address: int, count: int) -> NDArray[np.int32]:
    """Returns ``count`` 32-bit integers at an address, as a view."""
    view: NDArray[np.int32] = _view(_as_pointer(address), count, np.int32)
    return view


@compiled
def wide_ints(address: int, count: int) -> NDArray[np.int64]:
    """Returns ``count`` 64-bit integers at an address, as a view."""
    view: NDArray[np.int64] = _view(_as_pointer(address), count, np.int64)
    return view


@compiled
def pointer_at(address: int) -> int:
    """Returns the pointer stored at an address (arrays in MuJoCo's arena move between steps)."""
    return int(wide_ints(address, 1)[0])


_KINDS = int(mujoco.mjtWarning.mjNWARNING)
_FULL_OF_CONTACTS = int(mujoco.mjtWarning.mjWARN_CONTACTFULL)
_FULL_OF_CONSTRAINTS = int(mujoco.mjtWarning.mjWARN_CNSTRFULL)
_SINGULAR = int(mujoco.mjtWarning.mjWARN_INERTIA)


@compiled
def warning_at(address: int) -> int:
    """Returns the result for MuJoCo's warnings since they were forgotten; ``OK`` without one.

    ``BAD_RESULT`` is a position, velocity, acceleration or control that is no number, or beyond
    mjMAXVAL = 1e10, which is finite but no motion. A singular inertia, of which a solver with few
    iterations warns too, does not count: 'check' counts it. ``address`` is that of
    ``mjData.warning``.
    """
    # mjWarningStat: two integers, the second is the count
    counts, total = ints(address, 2 * _KINDS), 0
    for kind in range(_KINDS):
        total += counts[2 * kind + 1] if kind != _SINGULAR else 0
    if total == 0:
        return OK
    if counts[2 * _FULL_OF_CONTACTS + 1] > 0:
        return CONTACTS_FULL
    if counts[2 * _FULL_OF_CONSTRAINTS + 1] > 0:
        return CONSTRAINTS_FULL
    return BAD_RESULT


def warning_of(data: mujoco.MjData) -> int:
    """Returns the result for MuJoCo's warnings on a scene, as ``warning_at``."""
    address = field_address(data, "warning")
    return int(direct(warning_at, address)(address))


def forget_warnings(data: mujoco.MjData) -> None:
    """Sets the counts of MuJoCo's warnings to zero."""
    for warning in data.warning:
        warning.number = 0


@contextmanager
def quiet() -> Iterator[list[str]]:
    """Collects MuJoCo's warnings, neither printed nor in MUJOCO_LOG.TXT; counters still count."""
    before, told = mujoco.get_mju_user_warning(), list[str]()
    mujoco.set_mju_user_warning(told.append)
    try:
        yield told
    finally:
        mujoco.set_mju_user_warning(before)


def warnings_of_reading(spec: mujoco.MjSpec) -> list[str]:
    """Returns what MuJoCo warned of in a specification that was read and not yet compiled.

    These are whole; a handler of warnings gets the first line of each alone.
    """
    library = ctypes.CDLL(str(library_path()))
    text = library.mjs_getWarning
    text.argtypes, text.restype = (ctypes.c_void_p, ctypes.c_int), ctypes.c_char_p
    address = ctypes.c_void_p(spec._address)
    return [text(address, k).decode() for k in range(library.mjs_numWarnings(address))]


def copy_of(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Returns a whole copy of a specification.

    MuJoCo's own copy lacks what refers to nothing, such as an actuator of no joint. It is a null
    pointer, whose first use ends the process, where two keyframes have one name.

    Raises:
        ValueError: MuJoCo cannot copy the specification, and what it refuses in it.
    """
    copy = spec.copy()
    if copy._address and all(len(getattr(copy, of)) == len(getattr(spec, of)) for of in _REFERRING):
        return copy
    spec.compile()  # raises the reason
    raise ValueError("MuJoCo cannot copy the specification")


_REFERRING = "actuators", "equalities", "excludes", "pairs", "sensors", "tendons", "tuples"


_SCALARS: dict[str, Any] = {
    "int": ctypes.c_int,
    "mjtNum": ctypes.c_double,
    "float": ctypes.c_float,
    "char": ctypes.c_char,
    "mjtByte": ctypes.c_ubyte,
    "mjtBool": ctypes.c_bool,
    "mjtSize": ctypes.c_int64,
    "size_t": ctypes.c_size_t,
    "uintptr_t": ctypes.c_void_p,
    "uint64_t": ctypes.c_uint64,
}


def _ctype(declared: Any) -> Any:
    if isinstance(declared, ast_nodes.PointerType):
        return ctypes.c_void_p
    if isinstance(declared, ast_nodes.ArrayType):
        inner = _ctype(declared.inner_type)
        for extent in reversed(declared.extents):
            inner = inner * extent
        return inner
    if isinstance(declared, ast_nodes.AnonymousStructDecl):
        return _structure("anonymous", declared.fields)
    if declared.name in _SCALARS:
        return _SCALARS[declared.name]
    if declared.name in structs.STRUCTS:
        return struct_of(declared.name)
    raise SceneError(
        f"MuJoCo {mujoco.__version__} uses a type '{declared.name}' whose size is unknown here; "
        "install a version from constraints.txt"
    )


@cache
def struct_of(name: str) -> Any:
    """Returns the ctypes structure of a C struct of MuJoCo, by its name."""
    return _structure(name, structs.STRUCTS[name].fields)


def _structure(name: str, declared: Any) -> Any:
    fields = [(field.name, _ctype(field.type)) for field in declared]
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def field_address(data: mujoco.MjData, name: str) -> int:
    """Returns the address of a field of ``mjData``; for a pointer, that of the pointer itself."""
    return int(data._address + getattr(struct_of("mjData"), name).offset)


def contact_layout() -> dict[str, int]:
    """Returns the size of ``mjContact`` and the offsets that a tick uses, in bytes."""
    contact = struct_of("mjContact")
    fields = {
        "distance": "dist",
        "point": "pos",
        "frame": "frame",
        "surface_velocity": "surfacevel",
        "geoms": "geom",
        "dim": "dim",
        "row": "efc_address",
        "friction": "friction",
        "solref": "solref",
        "solreffriction": "solreffriction",
        "solimp": "solimp",
    }
    offsets = {name: int(getattr(contact, field).offset) for name, field in fields.items()}
    return {"size": ctypes.sizeof(contact), **offsets}


def addresses(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[int, int]:
    """Returns the addresses of model and data for the C functions.

    Raises:
        SceneError: The described layout of ``mjData`` or ``mjModel`` is not that of the library, so
            the compiled tick would read wrong memory.
    """
    option = struct_of("mjModel").from_address(model._address).opt
    view = struct_of("mjData").from_address(data._address)
    agrees = (
        view.ncon == data.ncon
        and view.nefc == data.nefc
        and view.nisland == data.nisland
        and view.nbody_awake == data.nbody_awake
        and view.dof_awake_ind == data.dof_awake_ind.ctypes.data
        and (option.disableflags, option.enableflags)
        == (model.opt.disableflags, model.opt.enableflags)
        and view.time == data.time
        and view.qvel == data.qvel.ctypes.data
        and view.site_xpos == data.site_xpos.ctypes.data
        and view.mocap_pos == data.mocap_pos.ctypes.data
        and view.signature == data.signature
    )
    if not agrees:
        raise SceneError(
            f"MuJoCo {mujoco.__version__} lays out its structs differently from its description; "
            "install a version from constraints.txt"
        )
    return int(model._address), int(data._address)


_DATA_ARRAYS = (
    "qpos",
    "qvel",
    "act",
    "history",
    "plastic",
    "qacc",
    "ctrl",
    "mocap_pos",
    "mocap_quat",
    "xpos",
    "xquat",
    "xmat",
    "xipos",
    "ximat",
    "site_xpos",
    "site_xquat",
    "site_xmat",
    "subtree_com",
    "cdof",
    "ten_length",
    "qfrc_actuator",
    "qfrc_applied",
    "qfrc_bias",
    "qfrc_constraint",
    "qfrc_gravcomp",
    "xfrc_applied",
    "actuator_force",
    "actuator_length",
    "actuator_velocity",
    "moment_rownnz",
    "moment_rowadr",
    "moment_colind",
    "actuator_moment",
    "energy",
    "solver_niter",
)
_DATA_FIELDS = (
    "time",
    "ncon",
    "nbody_awake",
    "nparent_awake",
    "nv_awake",
    "body_awake_ind",
    "parent_awake_ind",
    "dof_awake_ind",
    "nisland",
    "nefmA",
    "efm_aid",
    "efm_as",
    "efm_ak",
    "ne",
    "nefc",
    "efc_type",
    "efc_id",
    "efc_J",
    "efc_J_rowadr",
    "efc_J_rownnz",
    "efc_J_colind",
    "efc_pos",
    "efc_margin",
    "efc_vel",
    "efc_aref",
    "efc_R",
    "efc_force",
    "contact",
)
_OWNED = (
    "actuator_gravcomp_dofs",
    "compensated_mass",
    "body_mocap",
    "geom_bodyid",
    "tendon_range",
    "scratch",
    "mocap_previous",
    "mocap_shift",
    "equality_before",
    "tendon_before",
    "outadr",
    "outnum",
    "tree_dofadr",
    "tree_dofnum",
    "tree_mass",
    "dof_turns",
)
_MASSLESS = ("tool_map", "tool_qpos", "geom_is_tool", "geom_is_part")
_SIZES = (
    "nq",
    "nv",
    "na",
    "nplastic",
    "nhistory",
    "njnt",
    "nbody",
    "ngeom",
    "nmocap",
    "ntendon",
    "nsensor",
    "ntree",
)
_CONTACT = (
    "size",
    "distance",
    "point",
    "frame",
    "surface_velocity",
    "geoms",
    "dim",
    "row",
    "friction",
    "solref",
    "solreffriction",
    "solimp",
)
_IDS = (
    "handle_mocap_id",
    "handle_body_id",
    "handle_site_id",
    "grip_site_id",
    "grip_body_id",
    "grip_root_id",
    "grip_dofs",
    "grip_dof_count",
    "weld_id",
    "coupling_actuator_id",
    "coupling_output_adr",
    "coupling_ctrl_adr",
    "coupling_outputs",
    "handle_count",
    "held_qpos",
    "metered_mocaps",
)
_FACTS = (
    "equality_capacity",
    "tool_map_size",
    "has_actuators",
    "has_belts",
    "has_gravity_compensation",
    "has_tendons_or_flexes",
    "is_discrete",
    "is_handle_alone",
)

MJ_DTYPE = np.dtype(
    [
        (name, "<i8")
        for name in (
            *("model", "data", "warnings", "gainprm", "biasprm", "enableflags", "gravity"),
            *_DATA_ARRAYS,
            *_DATA_FIELDS,
            *_OWNED,
            *_MASSLESS,
            *_SIZES,
            *(f"contact_{name}" for name in _CONTACT),
            *_IDS,
            *_FACTS,
        )
    ]
)
"""Sub-record ``mj``, bound once: addresses, sizes and ids of a model and its data.

The names are MuJoCo's. An address of ``_DATA_FIELDS`` is that of the field in ``mjData``, because
arrays in MuJoCo's arena move between steps. Filled in by ``state.BoundKernel``."""


def model_addresses(
    model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[dict[str, int], dict[str, NDArray[np.generic]]]:
    """Returns the addresses and sizes of a model and its data, by their names in ``MJ_DTYPE``.

    Returns:
        The numbers, and the arrays that must outlive the state, whose addresses go under their
        names.

    Raises:
        SceneError: The layout of ``mjData`` is another one (``addresses``).
    """
    model_address, data_address = addresses(model, data)
    values: dict[str, int] = {"model": model_address, "data": data_address}
    values |= {name: getattr(data, name).ctypes.data for name in _DATA_ARRAYS}
    values |= {name: field_address(data, name) for name in _DATA_FIELDS}
    values["warnings"] = field_address(data, "warning")
    options = model_address + struct_of("mjModel").opt.offset
    for name in ("enableflags", "gravity"):
        values[name] = options + getattr(struct_of("mjOption"), name).offset
    values["gainprm"] = model.actuator_gainprm.ctypes.data
    values["biasprm"] = model.actuator_biasprm.ctypes.data
    values |= {name: getattr(model, name) for name in _SIZES}
    values |= {f"contact_{name}": value for name, value in contact_layout().items()}
    values["has_gravity_compensation"] = _has_gravity_compensation(model)
    values["has_tendons_or_flexes"] = model.ntendon > 0 or model.nflex > 0
    values["is_discrete"] = model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE
    # a flex may take more rows than 6 per equality, as many as it has now
    values["equality_capacity"] = max(6 * model.neq, data.ne)

    # actgravcomp hands a joint's gravity compensation to its actuators; the rest is passive
    by_actuator = model.jnt_actgravcomp[model.dof_jntid]
    owned: dict[str, NDArray[np.generic]] = {
        "actuator_gravcomp_dofs": np.ascontiguousarray(by_actuator, dtype=np.float64),
        "compensated_mass": np.asarray(model.body_gravcomp * model.body_mass),
        # a body that is fixed or jointed to a mocap body moves with it
        "body_mocap": np.ascontiguousarray(model.body_mocapid[model.body_rootid], dtype=np.int32),
        "geom_bodyid": np.ascontiguousarray(model.geom_bodyid, dtype=np.int32),
        "tendon_range": np.ascontiguousarray(model.tendon_range, dtype=np.float64),
        "scratch": np.zeros((4, max(model.nv, 1))),
        "mocap_previous": np.zeros((max(model.nmocap, 1), 7)),
        "mocap_shift": np.zeros((max(model.nmocap, 1), 6)),
        "equality_before": np.zeros(max(values["equality_capacity"], 1)),
        "tendon_before": np.zeros(max(model.ntendon, 1)),
        "outadr": np.ascontiguousarray(model.actuator_outadr, dtype=np.int32),
        "outnum": np.ascontiguousarray(model.actuator_outnum, dtype=np.int32),
        "tree_dofadr": np.ascontiguousarray(model.tree_dofadr, dtype=np.int32),
        "tree_dofnum": np.ascontiguousarray(model.tree_dofnum, dtype=np.int32),
        "tree_mass": _masses_of_free_trees(model),
        "dof_turns": turning_dofs(model),
    }
    return values, owned


def _has_gravity_compensation(model: mujoco.MjModel) -> bool:
    """Returns True if MuJoCo computes gravity compensation."""
    disabled, flags = model.opt.disableflags, mujoco.mjtDisableBit
    passive = flags.mjDSBL_SPRING | flags.mjDSBL_DAMPER  # without both it skips passive forces
    is_off = disabled & flags.mjDSBL_GRAVITY or disabled & passive == passive
    return bool(model.ngravcomp) and not is_off


def _masses_of_free_trees(model: mujoco.MjModel) -> NDArray[np.float64]:
    """Returns the mass in kg of each kinematic tree that begins with a free joint, 0 for others."""
    first = model.tree_dofadr
    is_free = model.jnt_type[model.dof_jntid[first]] == mujoco.mjtJoint.mjJNT_FREE
    armature = np.array([np.any(model.dof_armature[dof : dof + 3]) for dof in first], bool)
    masses = model.body_subtreemass[model.dof_bodyid[first]]
    return np.ascontiguousarray(np.where(is_free & ~armature, masses, 0.0), dtype=np.float64)


def turning_dofs(model: mujoco.MjModel) -> NDArray[np.int32]:
    """Returns 1 for each degree of freedom that is a rotation, 0 for others."""
    kinds, dofs = model.jnt_type[model.dof_jntid], np.arange(model.nv)
    is_shift = kinds == mujoco.mjtJoint.mjJNT_SLIDE
    is_free = kinds == mujoco.mjtJoint.mjJNT_FREE
    is_shift |= is_free & (dofs - model.jnt_dofadr[model.dof_jntid] < 3)
    return np.ascontiguousarray(~is_shift, dtype=np.int32)
