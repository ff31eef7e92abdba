"""A device that turns as a directed hand turns it, with a ledger of its own.

The work of the torque and what the device's damper burns are counted in twentieths of a tick, with
the torque that acts then: it comes ``late`` ticks after its sample, whole or in twentieths. Nothing
is taken from a meter of the package.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.device import AXES, DeviceInfo
from hapticbridge.kernel.record import SAMPLE_DTYPE

PARTS = 20
"""Parts of a tick."""

Path: TypeAlias = Callable[[NDArray[np.float64]], Rotation]
"""Orientations of the handle at times in ticks, (n,)."""


class DirectedDevice:
    """A device on a hand that turns it along a path, whatever the torque.

    Attributes:
        gained: Energy in J that the hand got beyond what it put in and the damper burned, after
            each tick.

    Args:
        path: Orientation of the handle.
        damping: b_r in N m s/rad.
        late: Ticks from a sample to its torque.
        sheet: More fields of the data sheet.
    """

    def __init__(self, path: Path, damping: float, late: float, **sheet: Any) -> None:
        usual: dict[str, Any] = {
            "name": "directed",
            "axes": AXES,
            "mass": 0.1,
            "damping": 2.0,
            "force_limit": 10.0,
            "torque_limit": 1e3,
            "is_real": False,
            "is_delay_measured": True,
        }
        self.info = DeviceInfo(**usual | {"rotational_damping": damping} | sheet)
        self._path, self._damping, self._late = path, damping, round(PARTS * late)
        self.gained: list[float] = []

    def start(self, period: float) -> NDArray[np.void]:
        self._period, self._ticks = period, 0
        self._torques = [np.zeros(3)] * (1 + math.ceil(self._late / PARTS))
        sample = np.zeros(1, SAMPLE_DTYPE)
        sample["quaternion"] = self._path(np.zeros(1)).as_quat(scalar_first=True)
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        places = self._path(self._ticks + np.arange(PARTS + 1) / PARTS)
        turns = (places[1:] * places[:-1].inv()).as_rotvec()
        later = self._late % PARTS  # parts in which the torque of one tick before still acts
        earlier, newer = self._torques[0], self._torques[1 if later else 0]
        torques = np.where(np.arange(PARTS)[:, None] < later, earlier, newer)
        burned = self._damping / (self._period / PARTS) * np.sum(turns**2)
        before = self.gained[-1] if self.gained else 0.0
        self.gained.append(before + float(np.sum(torques * turns) - burned))
        self._ticks += 1
        sample["quaternion"] = places[-1].as_quat(scalar_first=True)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self._torques = [*self._torques[1:], wrench[3:].copy()]

    def close(self) -> None:
        pass


BEGIN = 200
"""Tick in which a hand has turned the handle by its twist."""


def _about(twist: float, time: NDArray[np.float64]) -> Rotation:
    return Rotation.from_rotvec(np.outer(np.clip(time / BEGIN, 0.0, 1.0), (0.0, 0.0, twist)))


def trembles(twist: float, size: float, ticks: int) -> Path:
    """A hand that goes to and fro along its twist, by 2 ``size`` rad in every ``ticks`` ticks."""

    def side(tick: NDArray[np.float64]) -> NDArray[np.float64]:
        sign = np.where((tick - BEGIN) // ticks % 2 == 0.0, 1.0, -1.0)
        return np.where(tick > BEGIN, size * sign, 0.0)

    def path(time: NDArray[np.float64]) -> Rotation:
        tick = np.floor(time)
        way = side(tick) + (time - tick) * (side(tick + 1.0) - side(tick))
        return Rotation.from_rotvec(np.outer(way, (0.0, 0.0, 1.0))) * _about(twist, time)

    return path


def wobbles(twist: float, size: float, speed: float) -> Path:
    """A hand on a circle of ``size`` rad across its twist, ``speed`` rad of it in a tick."""

    def path(time: NDArray[np.float64]) -> Rotation:
        radius = size * np.clip((time - BEGIN) / 100.0, 0.0, 1.0)
        angle = speed * (time - BEGIN)
        across = [radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle]
        return Rotation.from_rotvec(np.stack(across, axis=1)) * _about(twist, time)

    return path


def most_created(
    device: DirectedDevice, rows: NDArray[np.void], stiffness: float, scene: NDArray[np.float64]
) -> float:
    """Returns the largest rise in J of what hand, spring and scene have, from the twist on.

    Args:
        device: The device after a run.
        rows: Its records.
        stiffness: K_r in N m/rad, below the level.
        scene: What the scene has in J, per record: storage, or the tank in front of a program.
    """
    tool = Rotation.from_quat(rows["tool_quaternion"], scalar_first=True)
    handle = Rotation.from_quat(rows["handle_quaternion"], scalar_first=True)
    twist = (handle * tool.inv()).magnitude()
    whole = (np.array(device.gained) + 0.5 * stiffness * twist**2 + scene)[BEGIN + 10 :]
    return float((whole - np.minimum.accumulate(whole)).max())
