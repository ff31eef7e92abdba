"""The emulated devices that the checks plug in, each with mechanics and a hand behind it."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from emulated.board_model import BoardSheet, LoopBoard
from emulated.falcon_model import FalconModel
from emulated.handle import Handle, planar_hand
from emulated.pid_layouts import ODD, USUAL
from emulated.pid_model import PidStick
from emulated.rawhid_model import Claims, RawHid

from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.device.discovery import plugged_devices
from hapticbridge.device.driver import FoundDevice
from hapticbridge.scene import load_scene

MASS, DAMPING, FRICTION = 0.5, 5.0, 0.3
"""kg, N s/m, N per axis: of a Falcon's order; nobody has measured one."""

RESOLUTION = 50e-6
"""m: about a Falcon's encoder step in the middle of its workspace."""

FALCON = f"falcon:mass={MASS},damping={DAMPING},friction={FRICTION}"
"""The Falcon does not know its own mechanics; whoever opens it says them."""

NEWTONS, TRAVEL = 4.0, 0.12
"""N at full scale and m from stop to stop: nobody can ask a stick for them."""

STICK = f"pid:newtons={NEWTONS},travel={TRAVEL},mass={MASS},damping={DAMPING},friction={FRICTION}"

FIRM = Hand(stiffness=1000.0, damping=30.0)
"""A hand that turns a nut."""

PROGRAM = bytes(range(256)) * 31
"""Stands for the maker's program: about its size, and every byte value in it."""


def mechanics() -> SimulatedDevice:
    """Returns a handle in a hand that pushes the peg into its hole."""
    path = load_scene("peg_in_hole").path.with_suffix(".csv")
    return SimulatedDevice(mass=MASS, damping=DAMPING, friction=FRICTION, path=path)


def falcon() -> FalconModel:
    """Returns a Falcon that runs its program and has found its zeros."""
    return FalconModel(Handle(mechanics()))


def turning_falcon() -> FalconModel:
    """Returns a Falcon in a hand that moves to and fro along y, as with a spanner.

    It rests for 0.4 s at each end, because force is enabled only at rest, then moves for 0.4 s.
    """
    times = np.arange(0.0, 60.0, 0.02)
    stroke, phase = np.divmod(times / 0.8, 1.0)
    way = np.sin(np.pi * np.maximum(phase - 0.5, 0.0)) ** 2
    places = np.zeros((len(times), 3))
    places[:, 1] = 0.03 * np.where(stroke % 2.0, 1.0 - way, way)
    mechanics = SimulatedDevice(
        mass=MASS, damping=DAMPING, friction=FRICTION, hand=FIRM, path=Motion(times, places)
    )
    return FalconModel(Handle(mechanics))


def free_falcon() -> FalconModel:
    """Returns a Falcon that nobody holds, without friction."""
    return FalconModel(Handle(SimulatedDevice(mass=MASS, damping=DAMPING, hand=None)))


def unloaded_falcon() -> FalconModel:
    """Returns a Falcon that has just got power: only its loader runs."""
    return FalconModel(Handle(mechanics()), program=None, valid=PROGRAM)


def rawhid(serial: str = "R1") -> RawHid:
    """Returns a home-made device."""
    claims = Claims(mass=MASS, damping=DAMPING, friction=FRICTION, resolution=RESOLUTION)
    return RawHid(mechanics(), claims, serial=serial)


def free_rawhid(serial: str = "R1") -> RawHid:
    """Returns a home-made device that nobody holds, without friction."""
    claims = Claims(mass=MASS, damping=DAMPING)
    return RawHid(SimulatedDevice(mass=MASS, damping=DAMPING, hand=None), claims, serial=serial)


def board(library: ctypes.CDLL) -> LoopBoard:
    """Returns a home-made device with a loop of its own, in a hand that taps on a wall.

    The hand rests for 0.9 s, then goes out along x and back within 0.3 s, at no time so slowly that
    a run would begin out there.
    """
    times = np.arange(0.0, 60.0, 0.01)
    out = np.maximum(np.mod(times, 1.2) / 0.3 - 3.0, 0.0)
    places = np.zeros((len(times), 3))
    places[:, 0] = 0.02 * np.sin(np.pi * out) ** 2
    mechanics = SimulatedDevice(
        mass=0.1, damping=2.0, friction=0.1, hand=FIRM, path=Motion(times, places)
    )
    return LoopBoard(library, mechanics, BoardSheet(period=2.5e-4))


def stick(serial: str = "P1") -> PidStick:
    """Returns a force-feedback stick in a hand that pushes a peg into its hole, in its plane."""
    path = planar_hand("planar_peg")
    mechanics = SimulatedDevice(mass=MASS, damping=DAMPING, friction=FRICTION, path=path)
    return PidStick(mechanics, newtons=NEWTONS, travel=TRAVEL, serial=serial)


def free_stick(*, is_odd: bool = False) -> PidStick:
    """Returns a stick that nobody holds, without friction; ``is_odd``: of the other reports."""
    mechanics = SimulatedDevice(mass=MASS, damping=DAMPING, hand=None)
    return PidStick(mechanics, ODD if is_odd else USUAL, newtons=NEWTONS, travel=TRAVEL)


Found = TypeVar("Found")


def wait_for(look: Callable[[], Found], seconds: float = 10.0) -> Found:
    """Looks every 10 ms until what is seen is true.

    Raises:
        TimeoutError: It is not within this time.
    """
    end = time.monotonic() + seconds
    while not (found := look()):
        if time.monotonic() > end:
            raise TimeoutError(f"not within {seconds:g} s")
        time.sleep(0.01)
    return found


def usable_devices() -> list[FoundDevice]:
    """Lists what can be opened: the kernel tells of a device before its node is there."""
    return [device for device in plugged_devices() if device.problem is None]
