"""A simulated device of one axis that taps a wall, with a ledger of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from kernel_runs import T, load, unlimited
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import METHODS, prepare
from hapticbridge.kernel.parameters import GuardParameters, RunParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import set_external_flags, whole_tick

WALL = """
<mujoco>
  <option gravity="0 0 0"/>
  <default><geom friction="0"/></default>
  <worldbody>
    <geom type="box" size="0.02 0.2 0.2" pos="{place} 0 0"/>
    <body name="tool"><freejoint/><geom size="0.02" mass="0.1"/><site name="grip"/></body>
  </worldbody>
</mujoco>"""
GAP = 0.02
"""Way in m from the tool's start to the wall."""


def wall(gap: float = GAP) -> str:
    """Returns a scene with a tool of 0.1 kg before a wall."""
    return WALL.format(place=gap + 0.04)


DAMPING, SPARE = 4.0, 3.0
"""b and b_s of the device in N s/m; the coupling needs the difference."""

COUPLING = Coupling(2.0 * (DAMPING - SPARE) / T * (1 - 1e-9), 0.0, 1.0, 0.0)


@dataclass
class Tapping:
    """A device of 0.2 kg at a wall, integrated in steps of T/20, with a ledger of its own.

    Attributes:
        kernel: The bound kernel.
        delays: Ticks from a force to when it acts, one of them drawn in each tick.
        drawn: Work in J that the hand has got so far; negative if it did work.
        most: Largest ``drawn`` so far, beyond what the scene's storage gave.
        course: Position in m and velocity in m/s after each part of a tick.
    """

    kernel: BoundKernel
    period: float = T
    delays: tuple[int, ...] = (0,)
    drawn: float = 0.0
    most: float = 0.0
    course: list[tuple[float, float]] = field(default_factory=list)

    MASS = 0.2

    def __post_init__(self) -> None:
        self.position = self.velocity = 0.0
        self.sent, self.rows = [0.0] * 64, list[Any]()
        self.sample = np.zeros(1, SAMPLE_DTYPE)
        self.sample["quaternion"][0, 0] = 1.0
        self.rng = np.random.default_rng(0)

    def tick(self, hand: Any, is_stale: bool = False) -> Any:
        """Runs a tick, then the device for a period with a hand of force ``hand(row, v)`` in N."""
        set_external_flags(self.kernel.state[0]["loop"], int(TickFlag.STALE_SAMPLE) * is_stale)
        if not is_stale:
            self.sample["position"][0, 0] = self.position
        assert whole_tick(self.kernel.state, self.sample, self.kernel.row, self.period)
        row = self.kernel.row[0].copy()
        self.rows.append(row)
        self.sent.append(float(row["wrench_on_device"][0]))
        force = self.sent[-1 - int(self.rng.choice(self.delays))]
        step = self.period / 20
        for _ in range(20):
            push = hand(row, self.velocity)
            # exact for a constant force within the step
            decay = math.exp(-DAMPING * step / self.MASS)
            end = (force + push) / DAMPING
            moved = end * step + (self.velocity - end) * (1 - decay) * self.MASS / DAMPING
            self.velocity = end + (self.velocity - end) * decay
            self.position += moved
            self.drawn -= push * moved
            self.course.append((self.position, self.velocity))
        stored = row["kinetic"] + row["potential"]
        kinetic = 0.5 * self.MASS * self.velocity**2
        self.most = max(self.most, self.drawn + kinetic + min(stored, 0.0))
        return row

    @property
    def pulse(self) -> Any:
        return self.kernel.state["impact"][0]

    @property
    def ticks(self) -> Any:
        return np.array(self.rows)


def parameters_of(scene: Any, **changes: Any) -> RunParameters:
    """Returns parameters of a run with pulses, and with these changes."""
    method = METHODS["implicit"]
    guard = GuardParameters(has_hand=True, fade_ticks=20, speed=10.0)
    guard = replace(guard, **changes.pop("guarding", {}))
    standard: dict[str, Any] = {
        "scheme": method.scheme,
        "is_rigid": True,
        "device_damping": DAMPING,
        "device_rotational_damping": 1.0,
        "force_limit": 10.0,
        "impact_pulses": 1.0,
        "pulse_frequency": 30.0,
        "pulse_decay": 0.0167,
        "pulse_damping": SPARE,
        "guarding": guard,
    }
    return replace(unlimited(scene, COUPLING), **(standard | changes))


def tapping(
    delays: tuple[int, ...] = (0,),
    coupling: Coupling = COUPLING,
    gap: float = GAP,
    **changes: Any,
) -> Tapping:
    """Returns a device before a wall; ``changes`` are those of ``parameters_of``."""
    scene, period = load(wall(gap)), changes.get("period", T)
    prepare(scene, coupling, period, 1, METHODS["implicit"], warns=False)
    parameters = replace(parameters_of(scene, **changes), coupling=coupling)
    return Tapping(BoundKernel(scene.model, scene.data, parameters), period, delays)


def towards(speed: float) -> Any:
    """Returns a hand that holds a speed in m/s, as well as 6 N s/m can."""
    return lambda row, v: DAMPING * speed + 6.0 * (speed - v)


# Acceleration of the handle at the onset

WINDOW, STEP, BAND = 5e-3, 1e-4, (20.0, 500.0)
"""Time in s after the handle has reached the wall that counts, step in s of the accelerations in
it, and band in Hz in which their spectra are compared."""


def onset(taps: Tapping, speed: float, gap: float) -> NDArray[np.float64]:
    """Strikes once at a speed in m/s; returns the handle's accelerations in m/s² in ``WINDOW``."""
    hand = towards(speed)
    while taps.position < gap:
        taps.tick(hand)
    for _ in range(round(2 * WINDOW / taps.period)):
        taps.tick(hand)
    places, velocities = np.array(taps.course).T
    time = taps.period / 20 * np.arange(len(places))
    first = int(np.argmax(places > gap)) + 1
    start = float(np.interp(gap, places[:first], time[:first]))
    grid = start + np.arange(0.0, WINDOW + STEP / 2, STEP)
    return np.asarray(np.diff(np.interp(grid, time, velocities)) / STEP)


def spectral_error(found: NDArray[np.float64], target: NDArray[np.float64]) -> float:
    """Returns the error of an acceleration's amplitude spectrum in ``BAND``, over the target's.

    References:
        Kuchenbecker, Fiene & Niemeyer 2006, IEEE TVCG 12 (accelerations of taps as the measure).
    """
    frequencies = np.fft.rfftfreq(16 * len(target), STEP)
    chosen = (frequencies >= BAND[0]) & (frequencies <= BAND[1])
    own, wanted = (np.abs(np.fft.rfft(a, 16 * len(a)))[chosen] for a in (found, target))
    return float(np.linalg.norm(own - wanted) / np.linalg.norm(wanted))


def stiff_onset(coupling: Coupling, speed: float, gap: float) -> NDArray[np.float64]:
    """Returns the accelerations at a wall of ten times the stiffness, in a loop ten times as fast.

    Its coupling needs the same damping, and its force level lies ten times as high.
    """
    stiff = replace(coupling, stiffness=10 * coupling.stiffness)
    taps = tapping(
        (0,),
        stiff,
        gap,
        period=T / 10,
        force_limit=100.0,
        impact_pulses=0.0,
        pulse_damping=0.0,
    )
    return onset(taps, speed, gap)
