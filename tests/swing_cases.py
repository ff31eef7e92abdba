"""Honest hands that the watch for a late force must leave alone."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.device import DEFAULT_HAND, Hand, Motion, SimulatedDevice
from hapticbridge.kernel.record import TickFlag

GRIPS = {
    "fingers": Hand(mass=0.05, damping=2.0, stiffness=30.0),
    "arm": DEFAULT_HAND,
    "firm": Hand(stiffness=1000.0, damping=20.0, rotational_stiffness=3.0),
}
"""Grips from two fingers to an arm that holds hard."""

ALARM = int(TickFlag.SWINGING | TickFlag.RUNS_AWAY)
"""Flags of what the watch finds."""


def taps(frequency: float, amplitude: float, duration: float = 3.0) -> Motion:
    """Returns a hand that taps on the face of ``virtual_wall``, in Hz and m."""
    times = np.arange(0.0, duration + 0.005, 0.002)
    swing = amplitude * np.sin(2 * np.pi * frequency * times) * np.minimum(times, 1.0)
    along = 0.010 * np.minimum(times / 0.3, 1.0) + swing
    return Motion(times, [(x, 0.0, 0.0) for x in along])


FAST_SCENES = {
    "virtual_wall": ((0.010, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "drawer": ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    "hammer": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "peg_in_hole": ((0.0, 0.0, -0.045), (1.0, 0.5, 0.0)),
    "bench_pliers": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "point_mass": ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
}
"""Place in m at which a fast hand shakes a scene, and the direction."""

VERY_FIRM = Hand(
    mass=0.4, stiffness=3000.0, damping=40.0, rotational_stiffness=5.0, rotational_damping=0.05
)


def shakes(name: str, frequency: float, amplitude: float, duration: float = 3.0) -> Motion:
    """Returns a hand that shakes a scene of ``FAST_SCENES``, in Hz and m."""
    base, direction = (np.array(vector) for vector in FAST_SCENES[name])
    times = np.arange(0.0, duration + 0.005, 0.001)
    swing = amplitude * np.sin(2 * np.pi * frequency * times) * np.minimum(times / 0.5, 1.0)
    return Motion(times, np.minimum(times / 0.4, 1.0)[:, None] * base + swing[:, None] * direction)


def alarms(name: str, motion: Motion | None, grip: Hand | None) -> int:
    """Runs a hand on a scene; returns the alarms of the watch as flags, 0 for none.

    Without a motion the scene's own path is followed, by the hand that it asks for.
    """
    device = "simulated" if motion is None else SimulatedDevice(path=motion, hand=grip)
    with hb.Bridge(name, device, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(None if motion is None else motion.duration)
        flags = bridge.latest_records(summary.ticks)["flags"]
    return int(np.bitwise_or.reduce(flags)) & ALARM


class LateInBunches:
    """Simulated device whose samples are late and come several at a time, as over a network.

    Args:
        device: The device itself.
        delay: Age in ticks of the newest sample that is known.
        most: The samples of 1 to 2 ``most`` − 1 ticks come at once; no new one comes between.
        begin: Tick from which on this is so.
    """

    def __init__(self, device: SimulatedDevice, delay: int, most: int, begin: int = 0) -> None:
        self.device, self.info = device, replace(device.info, delay=0.0)
        self._delay, self._most, self._begin = delay, most, begin
        self._chance = np.random.default_rng(0)
        self._waiting: deque[NDArray[np.void]] = deque()
        self._next, self._known = 0, np.zeros(1, hb.SAMPLE_DTYPE)
        self._places: list[NDArray[np.float64]] = []
        self._forces: list[NDArray[np.float64]] = [np.zeros(3)]

    def start(self, period: float) -> NDArray[np.void]:
        self.period = period
        self._known = self.device.start(period)
        return self._known.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        self.device.read(sample)
        self._places.append(sample["position"][0].copy())
        self._waiting.append(sample.copy())
        tick = len(self._places)
        if tick < self._begin:
            self._known = self._waiting.popleft()
            return 0
        is_new = False
        if tick >= self._next:
            self._next = tick + int(self._chance.integers(1, 2 * self._most))
            while len(self._waiting) > self._delay:
                self._known, is_new = self._waiting.popleft(), True
        sample[:] = self._known
        return 0 if is_new else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        self._forces.append(wrench[:3].copy())
        self.device.write(wrench)

    def close(self) -> None:
        self.device.close()

    def max_net_energy(self) -> float:
        """Returns the largest energy in J that the hand had got beyond what the damping burnt."""
        moved = np.diff(self._places, axis=0)
        work = np.einsum("ki,ki->k", self._forces[1 : len(moved) + 1], moved)
        burnt = (
            (self.device.info.damping or 0.0) / self.period * np.einsum("ki,ki->k", moved, moved)
        )
        return float(np.cumsum(work - burnt).max(initial=0.0))


def bunched(
    name: str, motion: Motion, device: SimulatedDevice, delay: int, most: int, begin: int = 0
) -> tuple[int, float]:
    """Runs a hand whose samples come in bunches; returns the alarms as flags, and joules given."""
    late = LateInBunches(device, delay, most, begin)
    with hb.Bridge(name, late, clock=hb.SimulatedClock()) as bridge:
        summary = bridge.run(motion.duration)
        flags = bridge.latest_records(summary.ticks)["flags"]
    return int(np.bitwise_or.reduce(flags)) & ALARM, late.max_net_energy()


class BetweenStops:
    """Handle on a rail that a hand shakes against a stop on each side; its motor is right.

    Args:
        stop: Place in m, stiffness in N/m and damping in N s/m of each stop.
        mass: Mass of handle and hand in kg.
        hand: Stiffness in N/m and damping in N s/m of the hand.
        shaking: Amplitude in m and frequency in Hz of where the hand wants to be.
    """

    info = hb.DeviceInfo(
        name="rail",
        axes=("x",),
        force_limit=10.0,
        damping=2.0,
        delay=0.0,
        is_delay_measured=True,
        is_real=False,
    )

    def __init__(
        self,
        stop: tuple[float, float, float],
        mass: float,
        hand: tuple[float, float],
        shaking: tuple[float, float],
    ) -> None:
        self._stop, self._mass, self._hand, self._shaking = stop, mass, hand, shaking

    def start(self, period: float) -> NDArray[np.void]:
        self._step, self._steps = 0.1 * period, 0
        self._place = self._speed = self._force = 0.0
        return np.array([((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)], hb.SAMPLE_DTYPE)

    def read(self, sample: NDArray[np.void]) -> int:
        (end, stiffness, damping), (spring, damper) = self._stop, self._hand
        amplitude, frequency = self._shaking
        for _ in range(10):
            time = self._steps * self._step
            wanted = min(time, 1.0) * amplitude * np.sin(2.0 * np.pi * frequency * time)
            push = self._force + spring * (wanted - self._place) - (2.0 + damper) * self._speed
            deep = self._place - min(max(self._place, -end), end)
            back = stiffness * deep + damping * self._speed
            push -= back if back * deep > 0.0 else 0.0
            self._speed += self._step * push / self._mass
            self._place += self._step * self._speed
            self._steps += 1
        sample[0] = ((self._place, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self._force = wrench[0]

    def close(self) -> None:
        self._force = 0.0
