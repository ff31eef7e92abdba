"""The wrench of a weld between grip and handle, from the forces of its constraint rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import EQUALITY
from hapticbridge.kernel.native import floats, ints, pointer_at
from hapticbridge.pose import Vector, conjugate, product, quaternion_of, vector_of


@compiled
def weld_wrench(state: NDArray[np.void]) -> tuple[Vector, Vector]:
    """Returns force and torque of the weld on the tool, about the grip, in the world frame.

    A weld of two sites has six rows. Three are the grip's position minus the handle's: their forces
    λ act at the grip as they are. Three are the vector part of q̄_h ⊗ q_x, which a rotation ω of the
    tool changes by ½ vec(q̄_h ⊗ (0, ω) ⊗ q_x): their torque is the transpose of that times λ.

    Must run before kinematics are refreshed: the step used the poses of its start.
    """
    s = state[0]
    count = min(ints(s.ne, 1)[0], ints(s.nefc, 1)[0])
    kinds, ids = ints(pointer_at(s.efc_type), count), ints(pointer_at(s.efc_id), count)
    row = 0
    while row < count and not (kinds[row] == EQUALITY and ids[row] == s.weld_id):
        row += 1
    if row + 6 > count:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    force = floats(pointer_at(s.efc_force), count)
    grip = quaternion_of(floats(s.site_xquat + 32 * s.grip_site_id, 4))
    to_handle = conjugate(quaternion_of(floats(s.site_xquat + 32 * s.handle_site_id, 4)))
    x = product(product(to_handle, (0.0, 1.0, 0.0, 0.0)), grip)
    y = product(product(to_handle, (0.0, 0.0, 1.0, 0.0)), grip)
    z = product(product(to_handle, (0.0, 0.0, 0.0, 1.0)), grip)
    a, b, c = 0.5 * force[row + 3], 0.5 * force[row + 4], 0.5 * force[row + 5]
    return (
        vector_of(force[row : row + 3]),
        (
            a * x[1] + b * x[2] + c * x[3],
            a * y[1] + b * y[2] + c * y[3],
            a * z[1] + b * z[2] + c * z[3],
        ),
    )
