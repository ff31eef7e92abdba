"""Stiffness of MuJoCo's constraints at rest, and penetration under a force."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.kernel.codes import held_body
from hapticbridge.kernel.elastic import has_elastic_flex
from hapticbridge.scene.contacts import REFERENCE_STEPS, impedance_at
from hapticbridge.units import format_energy, format_si

# Poses and rotations as NumPy arrays, by MuJoCo's functions

Array = NDArray[np.float64]

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
"""Identity quaternion (w, x, y, z)."""


def matrix_of(quaternion: ArrayLike) -> Array:
    """Returns the rotation matrix of a unit quaternion (w, x, y, z)."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=np.float64))
    return matrix.reshape(3, 3)


def quaternion_of(matrix: ArrayLike) -> Array:
    """Returns the unit quaternion (w, x, y, z) of a rotation matrix."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.asarray(matrix, dtype=np.float64).ravel())
    return quaternion


def rotation_vector(start: ArrayLike, now: ArrayLike) -> Array:
    """Returns the rotation vector in rad from one orientation to another, in the world's axes."""
    back, turn, vector = np.zeros(4), np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(back, np.asarray(start, dtype=np.float64))
    mujoco.mju_mulQuat(turn, np.asarray(now, dtype=np.float64), back)
    mujoco.mju_quat2Vel(vector, turn, 1.0)
    return vector


def pose_in(frame: Array, pose: Array) -> Array:
    """Returns a pose in the coordinates of a frame: position in m and quaternion, shape (7,).

    Both poses have shape (7,) and common coordinates.
    """
    position, turn, found = np.zeros(3), np.zeros(4), np.zeros(7)
    mujoco.mju_negPose(position, turn, frame[:3], frame[3:])
    mujoco.mju_mulPose(found[:3], found[3:], position, turn, pose[:3], pose[3:])
    return found


def mesh_of(model: mujoco.MjModel, mesh: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns the vertices in m, shape (n, 3), and triangles, shape (m, 3), of a compiled mesh."""
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    start, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    return (
        np.asarray(model.mesh_vert[first : first + count], dtype=np.float64),
        np.asarray(model.mesh_face[start : start + faces], dtype=np.int64),
    )


# Effective inertia of joints and bodies


def joint_inertia(model: mujoco.MjModel, data: mujoco.MjData, dof: int) -> float:
    """Returns the inertia in kg (hinge: kg m²) along a degree of freedom: 1/(M⁻¹)_ii.

    The other degrees of freedom move freely; ``data`` must be current (``mj_forward``). Armature is
    included. MuJoCo's ``dof_invweight0`` and ``body_invweight0`` omit it for simple bodies (alone
    in their tree, without rotation between their frames). Seen in MuJoCo 4.0: a slide of 0.5 g with
    0.1 kg of armature has 1/0.0005.
    """
    unit, answer = np.zeros((2, 1, model.nv))
    unit[0, dof] = 1.0
    mujoco.mj_solveM(model, data, answer, unit)
    return float(1.0 / answer[0, dof])


def body_inertia(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
    """Returns a body's inertia in kg at its centre of mass, in the most compliant direction.

    1/m is the largest eigenvalue of J M⁻¹ Jᵀ, with the Jacobian J of the centre of mass. Armature
    is included; ``data`` must be current (``mj_forward``). A body that cannot move has infinite
    inertia.
    """
    return _inertia_at(model, data, mujoco.mj_jacBodyCom, body)


def tool_masses(model: mujoco.MjModel, grip: str) -> tuple[float, float]:
    """Returns the mass in kg of a grip's rigid body, and of all that moves with it on joints."""
    body = held_body(model, grip)
    parts = (values == values[body] for values in (model.body_weldid, model.body_treeid))
    own, whole = (float(model.body_mass[part].sum()) for part in parts)
    return own, whole


def site_inertia(model: mujoco.MjModel, data: mujoco.MjData, site: int) -> float:
    """Returns the inertia in kg at a site, as ``body_inertia`` at a centre of mass."""
    return _inertia_at(model, data, mujoco.mj_jacSite, site)


def geom_inertia(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Returns the inertia in kg at a geom's centre, as ``body_inertia`` at a centre of mass."""
    return _inertia_at(model, data, mujoco.mj_jacGeom, geom)


def site_weight(model: mujoco.MjModel, data: mujoco.MjData, site: int, length: float) -> float:
    """Returns the force in N that holds a site against weight, springs and motors at rest.

        (f, τ/ℓ) = (J M⁻¹ Jᵀ)⁺ J a

    with the acceleration a that the scene has without constraints, so that what a table bears
    counts, and J = (J_p; ℓ J_r). What holds the site also turns it back, with a rotational
    stiffness that is the ``length`` ℓ in m squared times its stiffness. ``data`` must be current
    (``mj_forward``). A door on an upright hinge has none.
    """
    if model.nv == 0:
        return 0.0
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
    jacobian[3:] *= length
    answer = np.zeros_like(jacobian)
    mujoco.mj_solveM(model, data, answer, jacobian)
    inertia = np.linalg.pinv(jacobian @ answer.T, rcond=1e-6, hermitian=True)
    return float(np.linalg.norm((inertia @ jacobian @ data.qacc_smooth)[:3]))


def _inertia_at(
    model: mujoco.MjModel, data: mujoco.MjData, jacobian_of: Callable[..., None], place: int
) -> float:
    if model.nv == 0:
        return math.inf
    jacobian = np.zeros((3, model.nv))
    jacobian_of(model, data, jacobian, None, place)
    answer = np.zeros_like(jacobian)
    mujoco.mj_solveM(model, data, answer, jacobian)
    weight = float(np.linalg.eigvalsh(jacobian @ answer.T)[-1])
    return 1.0 / weight if weight > 0 else math.inf


_ROUNDS = 60
"""Number of bisections of the depth's bracket; enough for the last bit."""


def constraint_stiffness(
    solref: Sequence[float],
    solimp: Sequence[float],
    inertia: float,
    timestep: float,
    depth: float = 0.0,
) -> float:
    """Returns the stiffness in N/m that a contact, limit or equality constraint has at rest.

        K_c = m k d²/(1 − d),
        k = min(1/(d_w timeconst dampratio)², 1/(d h²))    or    −solref[0]/d_w²

    m is the inertia at the constraint as MuJoCo computes it, d the impedance at that depth, and d_w
    the impedance beyond the width of ``solimp``. The second term of the minimum is the limit of the
    step h (flag ``refsafe``).

    Args:
        solref: (timeconst in s, dampratio), or (−stiffness in 1/s², −damping in 1/s).
        solimp: d₀, d_w, width in m, midpoint, power.
        inertia: m in kg, > 0; kg m² for a hinge, which gives a result in N m/rad.
        timestep: h in s.
        depth: Penetration in m, >= 0; rad for a hinge.

    Returns:
        K_c in N/m: force divided by depth.

    References:
        MuJoCo's documentation, "Solver parameters"; the tests compare it with runs at rest.
    """
    impedance, last = impedance_at(solimp, depth), impedance_at(solimp, math.inf)
    first, second = float(solref[0]), float(solref[1])
    if first > 0 and second > 0:
        spring = min(1.0 / (last * first * second) ** 2, 1.0 / (impedance * timestep**2))
    else:
        spring = max(-first, 0.0) / last**2
    return inertia * spring * impedance**2 / (1.0 - impedance)


def depth_under(
    force: float, solref: Sequence[float], solimp: Sequence[float], inertia: float, timestep: float
) -> float:
    """Returns the penetration in m under a steady force; infinite for zero stiffness.

    It solves F = K_c(r) r for the depth r; K_c depends on r through ``solimp``. Parameters are
    those of ``constraint_stiffness``; F is in N, or in N m for a hinge.
    """

    def stiffness(depth: float) -> float:
        return constraint_stiffness(solref, solimp, inertia, timestep, depth)

    least = min(stiffness(0.0), stiffness(math.inf))
    if least <= 0.0:
        return math.inf
    low, high = 0.0, force / least
    for _ in range(_ROUNDS):
        middle = 0.5 * (low + high)
        if stiffness(middle) * middle < force:
            low = middle
        else:
            high = middle
    return high


# Tendons that jump

JUMP = 1e-4
"""Smallest change in m of a tendon's length at one place that counts as a jump. A tendon that
leaves a geom which it wraps jumps by mm; a smaller value would tell jumps that no force shows."""

KINK = 0.1
"""Smallest change of a tendon's moment arms at one place that counts as a jump, relative to them. A
way that changes its side of a geom turns them round; a smaller value would tell kinks that move
little energy."""

_HALVINGS = 20
"""Number of bisections of a tick's motion in search of a jump: to a millionth of its way."""

_PLACE = (
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_MOCAP_POS
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)
"""State from which the ways of tendons follow."""

STEADY_WAY = (
    'a sidesite="…" at the geom that it wraps, or a geom that it never leaves or never meets'
)
"""Change that keeps a tendon from jumping."""


def unstored_words(model: mujoco.MjModel, energy: float) -> str:
    """Returns a clause on energy in J that the flexes gave without having stored it."""
    bent = _bent_flexes(model)
    names = _flex_names(model, bent or range(model.nflex))
    why = "once its edges give way, bending has no least energy" if bent else NO_GRADIENT
    gave = f"gave {format_energy(energy)} that it never stored"
    return f"the elasticity of flex {names} {gave}: {why}"


NO_GRADIENT = "MuJoCo's force is there no gradient of an energy"
"""Clause on the elasticity of a flex of which nodes move the vertices (``kernel.elastic``)."""

OWN_VERTICES = 'dof="full", with which each vertex moves by itself'
"""Change of such a flex."""


def gradientless_flexes(model: mujoco.MjModel) -> str:
    """Returns a clause on elastic flexes whose force has no energy; empty if there is none."""
    loose = np.flatnonzero(model.flex_interp).tolist() if has_elastic_flex(model) else []
    if not loose:
        return ""
    kinds = dict.fromkeys(("", "trilinear", "quadratic")[model.flex_interp[each]] for each in loose)
    return (
        f'flex {_flex_names(model, loose)} has dof="{", ".join(kinds)}", and {NO_GRADIENT}: what '
        "its elasticity gives or takes on a closed way counts as stored"
    )


def _bent_flexes(model: mujoco.MjModel) -> list[int]:
    is_bent = (model.flex_bendingadr >= 0) & (model.flex_interp == 0)
    return [int(flex) for flex in np.flatnonzero(is_bent)]


def _flex_names(model: mujoco.MjModel, flexes: Iterable[int]) -> str:
    kind = mujoco.mjtObj.mjOBJ_FLEX
    return ", ".join(f"'{mujoco.mj_id2name(model, kind, flex) or flex}'" for flex in flexes)


def storing_flex(model: mujoco.MjModel, step: float) -> str:
    """Returns the change of a flex with which it gives no energy that it never stored.

    ``step`` is the scene's time step in s.
    """
    if model.flex_interp.any() and not _bent_flexes(model):
        return f"write {OWN_VERTICES}"
    return (
        f'write <edge equality="true" solref="{REFERENCE_STEPS * step:g} 1"> for it, which holds '
        'its edges more firmly, or elastic2d="both" without an equality of its edges'
    )


class WayJump(NamedTuple):
    """Jump of a tendon as its way round a geom changes.

    Attributes:
        length: Change of its length in m at one place; 0 for a kink, at which the length is steady.
        arms: Change of its moment arms there, relative to those about it.
    """

    length: float
    arms: float

    @property
    def quantity(self) -> str:
        """Name of what jumped."""
        return "length" if self.length else "moment arms"

    @property
    def size(self) -> str:
        """Size of the jump, with its unit."""
        return format_si(self.length, "m") if self.length else f"{self.arms:.0%}"


JUMP_SHARE = 0.5
"""Share of an energy above which it came by jumps, without unit."""


def jump_behind(
    jumps: Sequence[Mapping[int, WayJump]], gained: Array
) -> tuple[int, float, WayJump] | None:
    """Returns the tendon whose jumps brought most of an energy; None if none did.

    Lengths of a step lag by one, so that the ticks beside a jump count, too.

    Args:
        jumps: Tendons that jumped in each tick, (n,).
        gained: Energy in J that was created in each tick, (n,), each >= 0.

    Returns:
        Its id, the share of the energy without unit, and its largest jump.
    """
    total, best = float(gained.sum()), None
    for tendon in set().union(*jumps):
        ticks = [tick for tick, each in enumerate(jumps) if tendon in each]
        beside = np.unique(np.add.outer(ticks, (-1, 0, 1)).clip(0, len(jumps) - 1))
        share = float(gained[beside].sum()) / total if total > 0.0 else 0.0
        if share >= JUMP_SHARE and (best is None or share > best[1]):
            best = tendon, share, max(jumps[tick][tendon] for tick in ticks)
    return best


class _Ways(NamedTuple):
    """Ways of all tendons at a place: lengths (n,) in m and moment arms (n, nv)."""

    lengths: Array
    arms: Array

    def changes(self, after: _Ways) -> tuple[Array, Array]:
        """Returns the changes of lengths, and of moment arms by their norm."""
        arms = np.linalg.norm(after.arms - self.arms, axis=1)
        return np.abs(after.lengths - self.lengths), arms


class TendonWatch:
    """Search for jumps of tendons in a run.

    The motion between two calls is bisected towards the larger change of moment arms: a smooth way
    changes less and less, one that jumps does not. A way that may take either side of a geom, for
    want of a ``sidesite``, has a kink where both are equally long: the length is steady there, and
    the moment arms jump.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        wraps = np.isin(
            model.wrap_type, [mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER]
        )
        tendons = np.repeat(np.arange(model.ntendon), model.tendon_num)
        self._wrapping = np.unique(tendons[wraps])
        self._two_sided = np.unique(tendons[wraps & (model.wrap_prm < 0)])
        self._model = model
        self._scratch: mujoco.MjData = mujoco.MjData(model) if self._wrapping.size else None
        self._last: Array | None = None

    def jumps(self, data: mujoco.MjData) -> dict[int, WayJump]:
        """Returns the tendons that jumped since the last call; none at the first."""
        if not self._wrapping.size:
            return {}
        end = np.zeros(mujoco.mj_stateSize(self._model, _PLACE))
        mujoco.mj_getState(self._model, data, end, _PLACE)
        start, self._last = self._last, end
        if start is None:
            return {}
        ends = self._ways_at(start), self._ways_at(end)
        sizes = np.max([np.linalg.norm(each.arms, axis=1) for each in ends], axis=0) + 1e-12
        lengths, arms = ends[0].changes(ends[1])
        found = {}
        for tendon in self._wrapping[((lengths > JUMP) | (arms > KINK * sizes))[self._wrapping]]:
            length, arm = self._smallest_change(tendon, start, end)
            relative = float(arm / sizes[tendon])
            if length > JUMP:
                found[int(tendon)] = WayJump(length, relative)
            elif relative > KINK and tendon in self._two_sided:
                found[int(tendon)] = WayJump(0.0, relative)
        return found

    def _smallest_change(self, tendon: int, low: Array, high: Array) -> tuple[float, float]:
        """Returns what is left of a tendon's change of length and moment arms in the bisection."""
        before, after = self._ways_at(low), self._ways_at(high)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            ways = self._ways_at(middle)
            if before.changes(ways)[1][tendon] > ways.changes(after)[1][tendon]:
                high, after = middle, ways
            else:
                low, before = middle, ways
        length, arms = before.changes(after)
        return float(length[tendon]), float(arms[tendon])

    def _ways_at(self, place: Array) -> _Ways:
        model, data = self._model, self._scratch
        mujoco.mj_setState(model, data, place, _PLACE)
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon):
            compute(model, data)
        arms = np.zeros((model.ntendon, model.nv))
        mujoco.mju_sparse2dense(
            arms, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind
        )
        return _Ways(data.ten_length.copy(), arms)
