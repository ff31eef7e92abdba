"""Carts, servos and forces on which ports are metered."""

from __future__ import annotations

from typing import Any

import numpy as np
from kernel_runs import (
    Array,
)

G = 9.81


GRAVITY = 'gravity="0 0 -9.81"'


SOLID = 'contype="1" conaffinity="1" solref="0.002 1" solimp="0.9 0.95 0.001"'


SLIDER = """
    <body name="tool" pos="0 -1 0"><joint name="tool" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.015" mass="0.1"/><site name="grip"/>
    </body>"""


MASSES = np.array([0.1, 0.3, 0.2])


class Witness:
    """Keeps speeds, positions and what MuJoCo calls ``actuator_force``, tick by tick."""

    def __init__(self) -> None:
        self.qvel: list[Array] = []
        self.qpos: list[Array] = []
        self.start_of_step_power: list[float] = []

    def __call__(self, _tick: int, data: Any) -> None:
        self.qvel.append(data.qvel.copy())
        self.qpos.append(data.qpos.copy())
        # the mistake to avoid: the force of the step's start times the speed of its end
        power = data.qfrc_actuator @ data.qvel
        self.start_of_step_power.append(float(power))

    def changes(self, values: list[Array]) -> Array:
        return np.diff(np.array(values), axis=0, prepend=np.zeros((1, len(values[0]))))

    def lost(self, masses: Array) -> Array:
        """Σ ½‖Δv‖²_M up to each tick, in J."""
        return np.cumsum(0.5 * np.sum(self.changes(self.qvel) ** 2 * masses, axis=1))


ARM = """
    <body name="upper" pos="0 1 0"><joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      </body>
    </body>"""


def smooth(tick: int, ticks: int, end: float) -> float:
    """From 0 to ``end`` with no jump in speed or acceleration."""
    s = min((tick + 1) / ticks, 1.0)
    return end * (10 * s**3 - 15 * s**4 + 6 * s**5)


ROPE = """<tendon><spatial name="t" {}><site site="a"/><site site="b"/></spatial></tendon>"""
