"""A scene and a recording that tests of the view share."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from audit_cases import ScriptedDevice, recorded
from report_runs import LOOSE, made_in
from tapping import DAMPING, GAP, wall

from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits

FLOOR = """<mujoco model="floor">
  <option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 0"/>
  <statistic center="0 0 0" extent="0.2"/>
  <worldbody>
    <light pos="0 0 1"/>
    <geom type="plane" size="0.1 0.1 0.01"/>
    <body name="ball" pos="0 0 0.03">
      <freejoint/>
      <geom type="sphere" size="0.02" mass="0.1" rgba="1 0 0 1"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


AT_ONCE = Limits(force=10.0, torque=0.5, ramp=0.0)
"""No rise at the start, in which the handle would follow only a part of the motion."""


def pressed(tick: int) -> tuple[float, ...]:
    """A hand that moves aside and down."""
    return (min(1e-4 * tick, 0.04), 0, max(-1e-4 * tick, -0.012), 1, 0, 0, 0)


def pressed_floor(folder: Path) -> Path:
    """Records a ball that is moved aside and pressed onto a floor, and held there."""
    path, device = folder / "floor.mcap", ScriptedDevice(pressed)
    return made_in(path, FLOOR, device, LOOSE, duration=1.5, limits=AT_ONCE)


def tap(tick: int) -> tuple[float, ...]:
    """A hand that goes 12 mm beyond the wall and back, three times a second."""
    reach = 0.5 * (GAP + 0.012)
    return (reach * (1 - math.cos(0.006 * math.pi * tick)), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def tapped_wall(folder: Path, **how: Any) -> Path:
    """Records two taps on a wall, with pulses; ``how`` are further arguments of ``recorded``."""
    path, scene = folder / "run.mcap", folder / "wall.xml"
    scene.write_text(wall())
    device, coupling = ScriptedDevice(tap, damping=DAMPING), Coupling(1000.0, 0.5, 1.0, 5e-4)
    limits = Limits(force=8.0, torque=0.5, ramp=0.0)
    pulses: dict[str, Any] = {"impact_pulses": 1.0, "limits": limits}
    recorded(path, scene, device, coupling, duration=0.6, **(pulses | how))
    return path


class Canvas:
    """Takes what is drawn."""

    def __getattr__(self, _: str) -> Any:
        return lambda name, *_, **__: self.__dict__.setdefault(name, SimpleNamespace())
