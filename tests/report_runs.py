"""Golden recordings: each was made to become active for one known cause."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from audit_cases import ScriptedDevice, recorded

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, SimulatedDevice
from hapticbridge.guard import Limits

LOOSE = Coupling(stiffness=2000, damping=0.2, rotational_stiffness=2, rotational_damping=5e-4)

HARD_FLOOR = """<mujoco model="floor">
  <option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 0">
    <flag diagexact="enable"/>
  </option>
  <worldbody>
    <geom type="plane" size="1 1 0.1" solref="-20000 -50" solimp="0.9 0.95 0.001"/>
    <body name="ball" pos="0 0 0.021">
      <freejoint/>
      <geom type="sphere" size="0.02" mass="0.1" solref="-20000 -50" solimp="0.9 0.95 0.001"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""

ANVIL = """<mujoco model="anvil">
  <option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 0">
    <flag diagexact="enable"/>
  </option>
  <worldbody>
    <body name="anvil">
      <freejoint/>
      <geom type="sphere" size="0.02" mass="20000" contype="0" conaffinity="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""
"""A tool that stays where it is: the coupling alone pushes the device."""

LIGHT_HAND = Hand(mass=0.01, damping=0.0, stiffness=60.0)
"""A hand that burns nothing: what the coupling creates stays and grows."""

FULL = Limits(force=10.0, torque=0.5, ramp=0.05)


def _circling(tick: int) -> tuple[float, ...]:
    angle = 2 * np.pi * 3e-3 * tick
    return (0.02 * np.sin(angle), 0.01 * (1 - np.cos(angle)), 0, 1, 0, 0, 0)


def _tapping(tick: int) -> tuple[float, ...]:
    return (0, 0, -0.004 * (1 - np.cos(0.04 * tick)), 1, 0, 0, 0)


def active_by_method(folder: Path) -> Path:
    """A light tool under an integrator that creates energy in free motion."""
    path = folder / "method.mcap"
    device = ScriptedDevice(_circling)
    recorded(path, "point_mass", device, LOOSE, duration=0.3, method="implicitfast")
    return path


def active_by_contact(folder: Path) -> Path:
    """A ball pushed onto a floor that is far stiffer than the step resolves."""
    scene, path = folder / "floor.xml", folder / "contact.mcap"
    scene.write_text(HARD_FLOOR)
    recorded(path, str(scene), ScriptedDevice(_tapping), LOOSE, duration=1.0)
    return path


def _held_to_an_anvil(path: Path, stiffness: float, duration: float, **sheet: Any) -> Path:
    scene = path.with_suffix(".xml")
    scene.write_text(ANVIL)
    simulated = {
        "delay": 2 if sheet.get("delay") else 0,
        "resolution": sheet.get("resolution", 0.0),
    }
    device = SimulatedDevice(mass=0.4, damping=2.0, hand=LIGHT_HAND, **simulated)
    device.info = replace(device.info, **sheet)
    coupling = Coupling(stiffness, 0.05, 0.1, 1e-4)
    recorded(path, str(scene), device, coupling, duration=duration, limits=FULL)
    return path


def active_by_rate(folder: Path) -> Path:
    """K T/2 + B' = 5 N s/m on a device of 2: 1 kHz is too slow for this spring."""
    return _held_to_an_anvil(folder / "rate.mcap", 10_000.0, 3.0)


def active_by_delay(folder: Path) -> Path:
    """K T/2 + B' = 1.55 N s/m on a device of 2, but the motors act two samples late."""
    return _held_to_an_anvil(folder / "delay.mcap", 3000.0, 3.0, delay=2e-3)


def active_by_quantisation(folder: Path) -> Path:
    """A coarse encoder without friction: the spring answers every step of it."""
    return _held_to_an_anvil(folder / "quantisation.mcap", 4500.0, 3.0, resolution=2e-4)
