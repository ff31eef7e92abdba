"""Stiffness of MuJoCo's constraints at rest, and penetration under a force."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.kernel.codes import held_body
from hapticbridge.scene.contacts import impedance_at

# Poses and rotations as NumPy arrays, by MuJoCo's functions

Array = NDArray[np.float64]

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
"""Identity quaternion (w, x, y, z)."""


def matrix_of(quaternion: ArrayLike) -> Array:
    """Returns the rotation matrix of a unit quaternion (w, x, y, z)."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=np.float64))
    return matrix.reshape(3, 3)


def quaternion_of(matrix: Array) -> Array:
    """Returns the unit quaternion (w, x, y, z) of a rotation matrix."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - 0.3 s, and no run needs it

    return np.asarray(Rotation.from_matrix(matrix).as_quat(scalar_first=True))


def rotation_vector(start: ArrayLike, now: ArrayLike) -> Array:
    """Returns the rotation vector in rad from one orientation to another."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - 0.3 s, and no run needs it

    before, after = (Rotation.from_quat(each, scalar_first=True) for each in (start, now))
    return np.asarray((after * before.inv()).as_rotvec())


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
"""Change in m of a tendon's length in a tick, beyond that of its speed, from which on it counts as
a jump. A tendon that leaves a geom which it wraps jumps by mm; a smaller value would tell rounding
of a blow's tick."""

STEADY_WAY = (
    'a sidesite="…" at the geom that it wraps, or a geom that it never leaves or never meets'
)
"""Change that keeps a tendon from jumping."""


class Lengths(NamedTuple):
    """Lengths of all tendons in m or rad (n,), and their rates."""

    lengths: NDArray[np.float64]
    rates: NDArray[np.float64]

    @classmethod
    def of(cls, data: mujoco.MjData) -> Lengths:
        """Returns copies of the present lengths and rates."""
        return cls(data.ten_length.copy(), data.ten_velocity.copy())

    def jumps_since(self, before: Lengths, period: float) -> dict[int, float]:
        """Returns by how much each tendon jumped in a period; only those that did.

        A length L of a smooth path changes by |ΔL| <= T max |L̇| in a period T. The factor of two
        leaves room for rates within the steps of a tick.
        """
        rate = np.maximum(np.abs(before.rates), np.abs(self.rates))
        beyond = np.abs(self.lengths - before.lengths) - 2.0 * period * rate
        return {tendon: float(beyond[tendon]) for tendon in np.flatnonzero(beyond > JUMP).tolist()}
