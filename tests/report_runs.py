"""Golden recordings: each was made to become active for one known cause."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from audit_cases import ScriptedDevice, recorded
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.device import Device, Hand, SimulatedDevice
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import Recording
from hapticbridge.run.bridge import Bridge

LOOSE = Coupling(2000, 0.2, 2, 5e-4)

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


def circling(tick: int) -> tuple[float, ...]:
    angle = 2 * np.pi * 3e-3 * tick
    return (0.02 * np.sin(angle), 0.01 * (1 - np.cos(angle)), 0, 1, 0, 0, 0)


def tapping(tick: int) -> tuple[float, ...]:
    return (0, 0, -0.004 * (1 - np.cos(0.04 * tick)), 1, 0, 0, 0)


def made_in(path: Path, mjcf: str, device: Device, coupling: Coupling, **options: Any) -> Path:
    """Records a run in a scene of its own, which is written beside the recording."""
    scene = path.with_suffix(".xml")
    scene.write_text(mjcf)
    recorded(path, str(scene), device, coupling, **options)
    return path


def swung(path: Path, duration: float) -> Path:
    """A coupling too stiff for its device swings up, and no controller damps it."""
    scene = ANVIL.replace(
        "<worldbody>", '<custom><numeric name="simulated_hand" data="60 0"/></custom><worldbody>'
    )
    device = SimulatedDevice(mass=0.2, damping=0.1, hand=LIGHT_HAND)
    coupling = Coupling(10_000.0, 0.05, 0.1, 1e-4)
    return made_in(path, scene, device, coupling, duration=duration, controller="off")


def active_by_method(folder: Path) -> Path:
    """A light tool under an integrator that creates energy in free motion."""
    path = folder / "method.mcap"
    device = ScriptedDevice(circling)
    recorded(path, "point_mass", device, LOOSE, duration=0.3, method="implicitfast")
    return path


def active_by_contact(folder: Path) -> Path:
    """A ball pushed onto a floor that is far stiffer than the step resolves."""
    path, device = folder / "floor.mcap", ScriptedDevice(tapping)
    return made_in(path, HARD_FLOOR, device, LOOSE, duration=1.0, contact="scene")


def _held_to_an_anvil(path: Path, stiffness: float, duration: float, **sheet: Any) -> Path:
    simulated = {
        "delay": 2 if sheet.get("delay") else 0,
        "resolution": sheet.get("resolution", 0.0),
    }
    device = SimulatedDevice(mass=0.4, damping=2.0, hand=LIGHT_HAND, **simulated)
    device.info = replace(device.info, **sheet)
    coupling = Coupling(stiffness, 0.05, 0.1, 1e-4)
    return made_in(path, ANVIL, device, coupling, duration=duration, limits=FULL)


def active_by_rate(folder: Path) -> Path:
    """K T/2 + B' = 5 N s/m on a device of 2: 1 kHz is too slow for this spring."""
    return _held_to_an_anvil(folder / "rate.mcap", 10_000.0, 3.0)


def active_by_delay(folder: Path) -> Path:
    """K T/2 + B' = 1.55 N s/m on a device of 2, but the motors act two samples late."""
    return _held_to_an_anvil(folder / "delay.mcap", 3000.0, 3.0, delay=2e-3)


def active_by_quantisation(folder: Path) -> Path:
    """A coarse encoder without friction: the spring answers every step of it."""
    return _held_to_an_anvil(folder / "quantisation.mcap", 4500.0, 3.0, resolution=2e-4)


def active_by_mocap(folder: Path) -> Path:
    """A body that is put elsewhere tick by tick and knocks against a tool at rest."""
    path, device = folder / "push.mcap", ScriptedDevice(resting)
    options = {"duration": 0.05, "on_tick": _knock("pusher"), "contact": "scene"}
    return made_in(path, PUSHED, device, LOOSE, **options)


def active_beside_a_fan(folder: Path) -> Path:
    """The hard floor again, while a body that touches nothing is moved far away."""
    path, device = folder / "fan.mcap", ScriptedDevice(tapping)
    fan = '<body name="fan" mocap="true" pos="1 0 0"><geom size="0.02"/></body>'
    floor = HARD_FLOOR.replace("<worldbody>", f"<worldbody>{fan}")
    options = {"duration": 0.06, "on_tick": _knock("fan", 1.0), "contact": "scene"}
    return made_in(path, floor, device, LOOSE, **options)


def active_by_rotation(folder: Path) -> Path:
    """K_r T/2 = 0.01 N m s/rad on a device of 0.002."""
    hand = replace(
        LIGHT_HAND, rotational_inertia=1e-5, rotational_damping=0.0, rotational_stiffness=0.05
    )
    device = SimulatedDevice(mass=0.4, damping=2.0, hand=hand)
    coupling = Coupling(300.0, 0.05, 20.0, 1e-4)
    return made_in(folder / "turn.mcap", ANVIL, device, coupling, duration=0.5, limits=FULL)


def active_by_repeated_samples(folder: Path) -> Path:
    """K T/2 + B' = 1.75 N s/m on a device of 2, three of four samples of which get lost."""
    path, device = folder / "lossy.mcap", LossyDevice(mass=0.4, damping=2.0, hand=LIGHT_HAND)
    # a device whose delay is known would be certified, and not be watched
    device.info = replace(device.info, delay=None)
    coupling = Coupling(3500.0, 0.05, 0.1, 1e-4)
    options: dict[str, Any] = {"duration": 2.0, "limits": FULL, "is_guarded": False}
    return made_in(path, ANVIL, device, coupling, **options)


class LossyDevice(SimulatedDevice):
    """A device of whose samples only every fourth arrives."""

    _reads = 0

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        self._last = super().start(period, parts)
        return self._last.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        super().read(sample)
        self._reads += 1
        if self._reads % 4:
            sample[:] = self._last
            return int(TickFlag.STALE_SAMPLE)
        self._last = sample.copy()
        return 0


def resting(_: int) -> tuple[float, ...]:
    return (0, 0, 0, 1, 0, 0, 0)


def _knock(body: str, place: float = 0.05) -> Callable[[Bridge, int], None]:
    def move(bridge: Bridge, tick: int) -> None:
        x = place - 0.012 * (1 - math.cos(0.2 * tick))
        bridge.set_input(mocap={body: (x, 0, 0, 1, 0, 0, 0)})

    return move


PUSHED = """<mujoco model="push">
  <option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 0">
    <flag diagexact="enable"/>
  </option>
  <worldbody>
    <body name="pusher" mocap="true" pos="0.05 0 0">
      <geom name="pusher" size="0.02"/>
    </body>
    <body name="ball">
      <freejoint/>
      <geom name="ball" size="0.02" mass="0.1"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


Made = Callable[[Callable[[Path], Path]], tuple[Recording, AuditReport]]
"""Type of the fixture ``made``: it makes a golden recording once, and judges it."""
