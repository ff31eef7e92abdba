"""Brown & Colgate 1997, equation by equation: curves, numbers, and second routes to them.

Each part of the walk is a function that returns a ``section`` with its checks.
"""

from __future__ import annotations

from collections.abc import Callable

from hapticbridge.lab.paper import device_damping, impact, integrators, transmission_line
from hapticbridge.lab.paper.section import Section

STEPS: tuple[tuple[str, Callable[[], Section]], ...] = (
    ("(1) direct rendering", device_damping.direct_section),
    ("(2) any coupling", device_damping.any_coupling),
    ("(4), (5) discretisations", device_damping.discretizations),
    ("(6) backward difference", device_damping.backward_difference),
    ("(7) Tustin", device_damping.tustin),
    ("(11), (13), (14) discrete-time passivity", integrators.discrete_passivity_section),
    ("(15), (16) implicit Euler", integrators.implicit_euler_section),
    ("(17), (18) explicit Euler", integrators.explicit_euler_section),
    ("(19) a mass behind the coupling", integrators.virtual_mass_section),
    ("section 4, impact", impact.section),
    ("the worst hand", device_damping.worst_hand_section),
    ("the transmission line", transmission_line.section),
)
"""Steps in the paper's order, each with a name for the progress display. A step takes under 2 s
once the kernel is compiled."""
