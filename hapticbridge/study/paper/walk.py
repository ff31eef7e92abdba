"""The walk from the first equation to the last."""

from __future__ import annotations

from collections.abc import Callable

from hapticbridge.study.paper import (
    coupling,
    damper,
    direct,
    discrete_passivity,
    explicit_euler,
    impact,
    implicit_euler,
    transmission_line,
    virtual_mass,
    worst_hand,
)
from hapticbridge.study.paper.section import Section

STEPS: tuple[tuple[str, Callable[[], Section]], ...] = (
    ("(1) direct rendering", direct.section),
    ("(2) any coupling", coupling.any_coupling),
    ("(4), (5) discretisations", coupling.discretizations),
    ("(6) backward difference", damper.backward_difference),
    ("(7) Tustin", damper.tustin),
    ("(11), (13), (14) discrete-time passivity", discrete_passivity.section),
    ("(15), (16) implicit Euler", implicit_euler.section),
    ("(17), (18) explicit Euler", explicit_euler.section),
    ("(19) a mass behind the coupling", virtual_mass.section),
    ("section 4, impact", impact.section),
    ("the worst hand", worst_hand.section),
    ("the transmission line", transmission_line.section),
)
"""What is computed, in the paper's order, with a name for the progress display. Each step takes
under 2 s once the kernel is compiled."""
