"""A device in a hand, with a ledger of its own: work of the motors less what the device burned.

In each of many parts of a tick the device moves at a constant velocity. Force times way, and
b v² and friction times way, are then exact for this motion, whatever moves it; the equation of
motion of the hand chooses only which motion it is. Nothing is taken from a meter of the package.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from adversary import turn
from numpy.typing import NDArray

from hapticbridge.device import DeviceInfo
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.pose import quaternion_of, rotation_between
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """Place and orientation that the hand wants, and its grip in rotation.

    Attributes:
        end: Time in s at which the hand is back, so that nothing stays stored.
        place: Way along x in m, reached in 0.2 s.
        swing: Amplitude along x in m.
        omega: Angular frequency of swing and wobble in rad/s.
        twist: Angle about x in rad, reached in 0.2 s.
        wobble: Radius in rad of a circle across the twist.
        inertia: In kg m².
        spring, damper: In N m/rad and N m s/rad.
    """

    end: float = math.inf
    place: float = 0.0
    swing: float = 0.0
    omega: float = 0.0
    twist: float = 0.0
    wobble: float = 0.0
    inertia: float = 1e-4
    spring: float = 1.0
    damper: float = 0.0


LONGEST = 0.1
"""Angle in rad by which the hand's own swing goes on in a part of a tick; more finds less."""


@compiled
def _move(
    pose: Array,
    v: Array,
    wrench: Array,
    hand: Array,
    sheet: Array,
    drive: Array,
    span: tuple[float, float],
    net: Array,
) -> None:
    """Moves the device from one time in s to another.

    ``hand`` is mass, stiffness, damping; ``sheet`` b, b_r, friction; ``net`` the ledger and its
    largest value in J, and the energy that went to and fro.
    """
    mass, k, c = hand[0], hand[1], hand[2]
    inertia, k_r, c_r = drive[6], drive[7], drive[8]
    fastest = min(math.sqrt(k / mass), 2.0 * k / max(sheet[0] + c, 1e-9))
    if sheet[1] > 0.0:
        own = min(math.sqrt(k_r / inertia), 2.0 * k_r / (sheet[1] + c_r))
        fastest = max(fastest, own)
    parts = math.ceil((span[1] - span[0]) * fastest / LONGEST) + 4
    h, pull, step = (span[1] - span[0]) / parts, np.zeros(6), np.zeros(6)
    for part in range(parts):
        at = span[0] + (part + 0.5) * h
        share = max(min(at / 0.2, (drive[0] - at) / 0.2, 1.0), 0.0)
        rest = np.array([1.0, 0.0, 0.0, 0.0])
        if sheet[1] > 0.0:
            size, phase = share * drive[5], drive[3] * at
            turn(rest, np.array([share * drive[4], 0.0, 0.0]))
            turn(rest, np.array([0.0, size * math.cos(phase), size * math.sin(phase)]))
            found = rotation_between(quaternion_of(pose[3:]), quaternion_of(rest))
            pull[3], pull[4], pull[5] = found[0], found[1], found[2]
        for i in range(3):
            goal = share * (drive[1] + drive[2] * math.sin(drive[3] * at)) if i == 0 else 0.0
            pull[i] = goal - pose[i]
        burned = 0.0
        for i in range(6):
            if i >= 3 and sheet[1] == 0.0:
                break
            m, spring, damper, b = (
                (mass, k, c, sheet[0]) if i < 3 else (inertia, k_r, c_r, sheet[1])
            )
            rate, force = max((b + damper) / m, 1e-9), wrench[i]
            v[i] += h * spring * pull[i] / m
            friction = sheet[2] if i < 3 else 0.0
            sign = math.copysign(1.0, v[i] if v[i] != 0.0 else force)
            end = (force - sign * friction) / (m * rate)
            after = end + (v[i] - end) * math.exp(-rate * h)
            mean = end + (v[i] - end) * -math.expm1(-rate * h) / (rate * h)
            if friction > 0.0 and min(after * sign, mean * sign) <= 0.0:
                after = mean = 0.0
            v[i], step[i] = after, h * mean
            burned += b * h * mean * mean + friction * abs(step[i])
        work = 0.0
        for i in range(6):
            work += wrench[i] * step[i]
        pose[:3] += step[:3]
        turn(pose[3:], step[3:])
        net[0] += work - burned
        net[1] = max(net[1], net[0])
        net[2] += abs(work)


class OwnDevice:
    """A device in a hand of spring and damper, with forces that come late and samples in steps.

    ``got`` is the energy in J that the hand got beyond what it put in and the device burned,
    ``gained`` the largest so far, ``through`` what went to and fro.

    Args:
        hand: Stiffness in N/m and damping in N s/m of the hand.
        every: Ticks per sample; in the others the device holds its force.
        is_new: True for the number of a tick with a sample, in place of ``every``.
        late: Ticks from a sample to its force, by the sample's number; a part of one, too.
        mass: Of hand and handle in kg.
        step: Of its encoder in m; 0 reads exactly.
        start: Displacement in m and speed in m/s of the hand along x.
        drive: Where the hand wants to be.
        sheet: Fields of the data sheet; ``rotational_damping`` makes it turn.
    """

    def __init__(
        self,
        hand: tuple[float, float],
        *,
        every: int = 1,
        is_new: Callable[[int], bool] | None = None,
        late: Callable[[int], float] = lambda _: 0.0,
        mass: float = 0.1,
        step: float = 0.0,
        start: tuple[float, float] = (1e-3, 0.05),
        drive: Drive = Drive(),
        **sheet: Any,
    ) -> None:
        turns = ("rx", "ry", "rz") if "rotational_damping" in sheet else ()
        usual: dict[str, Any] = {
            "name": "own",
            "axes": ("x", "y", "z", *turns),
            "mass": 0.1,
            "damping": 2.0,
            "delay": 0.0,
        }
        self.info = DeviceInfo(**usual | {"force_limit": 10.0, "is_real": False} | sheet)
        self._is_new = is_new or (lambda tick: tick % every == 0)
        self.late, self.step, self._begin = late, step, start
        self._hand, self._drive = np.array([mass, *hand]), np.array(astuple(drive))
        own = self.info
        burns = own.damping, own.rotational_damping, own.friction
        self._sheet, self._net = np.array([each or 0.0 for each in burns]), np.zeros(3)

    got = property(lambda self: float(self._net[0]))
    gained = property(lambda self: float(self._net[1]))
    through = property(lambda self: float(self._net[2]))

    def start(self, period: float) -> NDArray[np.void]:
        self._period, self._ticks = period, 0
        self._pose, self._v, self._wrench = np.zeros(7), np.zeros(6), np.zeros(6)
        self._pose[3], (self._pose[0], self._v[0]) = 1.0, self._begin  # displaced and moving
        self._forces: list[tuple[float, Array]] = []  # when they act, in ticks
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._take_sample()
        return self._sample

    def _take_sample(self) -> None:
        place = self._pose[:3]
        self._sample["position"] = self.step * np.round(place / self.step) if self.step else place
        self._sample["quaternion"] = self._pose[3:]

    def _move(self, begin: float, end: float) -> None:
        if end > begin:
            span = begin * self._period, end * self._period
            parts = self._hand, self._sheet, self._drive
            _move(self._pose, self._v, self._wrench, *parts, span, self._net)

    def read(self, sample: NDArray[np.void]) -> int:
        now = float(self._ticks)
        self._ticks += 1
        while self._forces and self._forces[0][0] < self._ticks:
            at, wrench = self._forces.pop(0)
            self._move(now, at)
            now, self._wrench = max(at, now), wrench
        self._move(now, self._ticks)
        is_new = self._is_new(self._ticks)
        if is_new:
            self._take_sample()
        sample[:] = self._sample
        return 0 if is_new else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        if self._is_new(self._ticks):
            at = self._ticks + self.late(self._ticks)
            if self._forces:  # none overtakes another
                at = max(at, self._forces[-1][0])
            self._forces.append((at, wrench.copy()))

    def close(self) -> None:
        pass
