"""Whether the tool is near to something, touches it, or is at a joint's limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import LIMIT_JOINT, LIMIT_TENDON
from hapticbridge.kernel.native import ints, pointer_at

REACH = 5e-4
"""Distance in m within which a contact counts as near: how far a tool at 0.5 m/s comes in a tick of
1 ms. Less lets a fast tool touch before the change, more makes the tool implicit sooner and longer.

To change over only when the next step would have the contact's force, told from the distance and
the approach at its start, errs less (tapping on a wall at 4 Hz 0.25 of the implicit form instead of
0.31, at 1 Hz 0.35 instead of 0.50) and is not done: a peg led into its hole then uses 1.4 % of the
slack instead of 0.9 %, and 2 of 20 hands on a planar peg (0 of another 100) use 0.01 % of it that
use none so: chosen after seeing both, for strictness."""


@compiled
def is_near(state: NDArray[np.void]) -> bool:
    """Tells whether the step saw the tool touch something, be near to it, or at a joint's limit.

    Notes in ``is_held`` whether a constraint force acted on its tree.

    Contacts within ``REACH`` are there without a force, because the geoms' gap says so.
    """
    s = state[0]
    found = held = bool(s.is_never_free)
    s.active_contacts = 0
    contacts = pointer_at(s.contact)
    for c in range(ints(s.ncon, 1)[0]):
        contact = contacts + s.contact_size * c
        is_active = ints(contact + s.contact_row, 1)[0] >= 0
        s.active_contacts += is_active
        for geom in ints(contact + s.contact_geoms, 2):
            # a flex is no geom
            if geom < 0 or ints(s.geom_in_tree, s.ngeom)[geom] != 0:
                found, held = True, held or is_active
    count = ints(s.nefc, 1)[0]
    kinds, ids = ints(pointer_at(s.efc_type), count), ints(pointer_at(s.efc_id), count)
    for row in range(count):
        is_joint = kinds[row] == LIMIT_JOINT and ints(s.joint_in_tree, s.njnt)[ids[row]] != 0
        if is_joint or kinds[row] == LIMIT_TENDON:
            found = held = True
    s.is_held = held
    return found
