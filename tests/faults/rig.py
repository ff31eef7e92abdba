"""A device in a hand that presses on a wall, a clock that can stall, and what is measured."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport, audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.device import SimulatedDevice
from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge

PERIOD = 1e-3
CAUSE = 1500
"""The tick at which a fault happens: the hand has pressed with 9 N for some tenths of a second."""

STALE = int(TickFlag.STALE_SAMPLE)

WATCHED = TickFlag.SWINGING | TickFlag.RUNS_AWAY

FELT = 0.01
"""Energy in J given to the hand from which on a late force must be found."""

PROBE = 3.0
"""Time in s after which the hand of a probed device begins to move: more than a probe takes."""

PRESS = ((0.0, 0.0), (0.2, 0.0), (0.9, 0.0804), (9.0, 0.0804))
"""Time in s and where the hand wants to be along x in m: the wall is at 10 mm, and 135 N/m over the
rest of the way are 9 N."""


def motion_of(points: tuple[tuple[float, float], ...], *, turns: bool = False) -> Motion:
    times, along = zip(*points, strict=True)
    if turns:
        halves = 0.5 * np.array(along)
        zero = np.zeros_like(halves)
        quaternions = np.stack([np.cos(halves), zero, zero, np.sin(halves)], axis=1)
        return Motion(times, np.zeros((len(times), 3)), quaternions)
    return Motion(times, [(x, 0.0, 0.0) for x in along])


def turn_between(before: Sequence[float], after: Sequence[float]) -> tuple[float, float, float]:
    """Returns the small turn from one unit quaternion to another as a vector in rad."""
    w, x, y, z = before[0], -before[1], -before[2], -before[3]
    a, b, c, d = after
    twice = math.copysign(2.0, w * a - b * x - c * y - d * z)
    return (
        twice * (a * x + w * b + c * z - d * y),
        twice * (a * y + w * c + d * x - b * z),
        twice * (a * z + w * d + b * y - c * x),
    )


class FaultClock(SimulatedClock):
    """Simulated time in which a tick may take long, and which may be set back."""

    may_wait = True

    def __init__(self) -> None:
        super().__init__()
        self._deadline = self._offset = 0

    def block(self, seconds: float) -> None:
        self._now += round(1e9 * seconds)

    def set_back(self, seconds: float) -> None:
        self._offset -= round(1e9 * seconds)

    def wait(self) -> tuple[int, int, int]:
        deadline = self._deadline + self._period
        skipped = max((self._now - deadline) // self._period, 0)
        self._deadline = deadline + skipped * self._period
        self._now = max(self._now, self._deadline)
        return self._deadline, self.now(), skipped

    def now(self) -> int:
        return self._now + self._offset


class FaultyDevice:
    """A simulated device whose samples and writes go through a fault; meters what it is given.

    Attributes:
        writes: Every wrench that arrived, by tick.
        to_the_hand: Σ w·δp − b δp²/T so far in J, by tick, from true poses and accepted wrenches;
            of translation and rotation.
    """

    def __init__(self, inner: SimulatedDevice) -> None:
        self.inner, self.info = inner, replace(inner.info, buttons=None)
        self.corrupt: Callable[[int, NDArray[np.void]], int] = lambda _tick, _sample: 0
        self.refuse: Callable[[int, NDArray[np.float64]], None] = lambda _tick, _wrench: None
        self.tick = -1
        self.writes: list[tuple[int, NDArray[np.float64]]] = []
        self.to_the_hand: list[float] = [0.0]
        self.true = np.zeros(1, SAMPLE_DTYPE)
        self._held = np.zeros(6)
        self.is_closed = False
        self.closed_at = 0.0

    def start(self, period: float) -> NDArray[np.void]:
        self.true = self.inner.start(period)
        return self.true.copy()

    def move_on(self) -> None:
        """Lets one period of the device's own time pass."""
        place, pose = self.true["position"][0].copy(), self.true["quaternion"][0].tolist()
        self.inner.read(self.true)
        moved = self.true["position"][0] - place
        turned = np.array(turn_between(pose, self.true["quaternion"][0].tolist()))
        burnt = (self.inner.info.damping or 0.0) / PERIOD * float(moved @ moved)
        burnt += (self.inner.info.rotational_damping or 0.0) / PERIOD * float(turned @ turned)
        work = float(self._held[:3] @ moved + self._held[3:] @ turned)
        self.to_the_hand.append(self.to_the_hand[-1] + work - burnt)

    def read(self, sample: NDArray[np.void]) -> int:
        self.tick += 1
        self.move_on()
        last = sample[0].copy()
        sample[0] = self.true[0]
        code = self.corrupt(self.tick, sample)
        if code == STALE:
            sample[0] = last
        return code

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.writes.append((self.tick, wrench.copy()))
        wrench = wrench.copy()
        self.refuse(self.tick, wrench)
        self.hold(wrench)

    @property
    def wrenches(self) -> NDArray[np.float64]:
        """Every wrench that arrived, shape (n, 6)."""
        return np.array([wrench for _, wrench in self.writes])

    @property
    def energy(self) -> float:
        """Largest energy given to the hand beyond what it had put in, in J."""
        return max(self.to_the_hand)

    def hold(self, wrench: NDArray[np.float64]) -> None:
        """Lets the motors hold a wrench."""
        self._held = wrench.copy()
        self.inner.write(wrench)

    def close(self) -> None:
        self.closed_at = self.closed_at or time.monotonic()
        self.is_closed = True


@dataclass
class Rig:
    """Bridge and device to which a fault is done, before they run.

    Attributes:
        folder: Where the recording goes.
        scene: Name or path.
        points: The hand's path along x in m, or about z in rad if ``turns``.
        parameters: Of the simulated device.
        coupling: None: the default.
        options: Of the bridge.
        duration: In s.
        is_probed: Whether the device is probed before the run; the hand begins after that.
        guard: Changes to what the guard does, for the other side of a test.
        on_tick: Called before each tick with the bridge.
        after: Called once the bridge is left, before its recording is judged.
    """

    folder: Path
    scene: str | Path = "virtual_wall"
    points: tuple[tuple[float, float], ...] = PRESS
    turns: bool = False
    parameters: dict[str, Any] = field(default_factory=dict)
    coupling: Coupling | None = None
    options: dict[str, Any] = field(default_factory=dict)
    duration: float = 2.5
    is_probed: bool = False
    guard: dict[str, Any] = field(default_factory=dict)
    on_tick: Callable[[Bridge, int], None] | None = None
    around: Callable[[ExitStack], None] | None = None
    after: Callable[[], None] | None = None
    clock: FaultClock = field(default_factory=FaultClock)
    recording: Path | None = None
    _device: FaultyDevice | None = None

    @property
    def device(self) -> FaultyDevice:
        if self._device is None:
            path = None
            if self.parameters.get("hand", 1) is not None:
                points = self.points
                if self.is_probed:
                    points = (points[0], *((time + PROBE, place) for time, place in points))
                path = motion_of(points, turns=self.turns)
            self._device = FaultyDevice(SimulatedDevice(path=path, **self.parameters))
        return self._device

    def run(self, cause: int) -> Outcome:
        """Runs it into a recording, and reports."""
        path = self.recording or self.folder / "run.mcap"
        with ExitStack() as stack:
            error, ticks_done = self._go(stack, path)
            waited = time.monotonic() - self.device.closed_at
            if self.after is not None:
                self.after()
            return Outcome.of(self, path, cause, error, ticks_done, waited)

    def run_unrecorded(self) -> FaultyDevice:
        """Runs it without a recording; returns the device, which knows what it was sent."""
        with ExitStack() as stack:
            self._go(stack, None)
        return self.device

    def _go(self, stack: ExitStack, path: Path | None) -> tuple[str, int]:
        """Runs it; returns what was raised, and the number of ticks done."""
        error, ticks_done = "", 0
        if self.around is not None:
            self.around(stack)
        limits = Limits(force=10.0, torque=0.5, ramp=0.2)
        options: dict[str, Any] = {"limits": limits, "probe": self.is_probed} | self.options
        try:
            bridge = Bridge(
                self.scene,
                self.device,
                self.coupling,
                recording=path,
                clock=self.clock,
                **options,
            )
            guard = replace(bridge.setup.guard, **self.guard)
            bridge.setup = replace(bridge.setup, guard=guard)
            with bridge:
                try:
                    act = self.on_tick or (lambda _bridge, _tick: None)
                    duration = self.duration + PROBE * self.is_probed
                    bridge.run(duration, lambda tick: act(bridge, tick))
                finally:
                    ticks_done = bridge.session.tick
        except (HapticBridgeError, ZeroDivisionError) as raised:
            error = f"{type(raised).__name__}: {raised}"
        return error, ticks_done


@dataclass
class Outcome:
    """Outcome of a fault.

    Attributes:
        largest_force: Of all that was written, in N.
        is_finite: Whether all of it was.
        energy: Largest energy given to the hand beyond what it had put in, in J.
        zero_after: Ticks from the cause to the first zero wrench; None where none came.
        found_after: Ticks from ``FELT``, without which from the cause, to the tick in which the
            watch lowers the force; None where it does not.
        last_is_zero: Whether the last write was zero.
        error: What was raised, or nothing.
        ticks: Ticks that were done, and ``rows`` records of them in the file.
        report: The audit's; None where there is no file.
        events: Names of the recording's events.
        dropped: Records that were lost, as the event ``stop`` says.
        flags: Of each record.
        waited: Time in s from the device's closing to the bridge's end.
    """

    largest_force: float
    is_finite: bool
    energy: float
    zero_after: int | None
    found_after: int | None
    last_is_zero: bool
    error: str
    ticks: int
    rows: int
    report: AuditReport
    events: list[str]
    dropped: int
    flags: NDArray[np.int64]
    forces: NDArray[np.float64]
    torques: NDArray[np.float64]
    waited: float

    @classmethod
    def of(cls, rig: Rig, path: Path, cause: int, error: str, ticks: int, waited: float) -> Outcome:
        device = rig.device
        ticks_of = np.array([tick for tick, _ in device.writes])
        wrenches = device.wrenches
        forces = np.linalg.norm(wrenches[:, :3], axis=1)
        zero = ticks_of[(ticks_of >= cause - 1) & (wrenches == 0).all(axis=1)]
        given = np.array(device.to_the_hand)
        recording = read_recording(path)
        flags = recording.ticks["flags"]
        found = np.flatnonzero(flags & int(WATCHED))
        felt = np.append(np.flatnonzero(given > FELT), cause)
        return cls(
            largest_force=float(np.max(forces)),
            is_finite=bool(np.isfinite(wrenches).all()),
            energy=device.energy,
            zero_after=max(int(zero[0]) - cause, 0) if zero.size else None,
            found_after=max(int(found[0]) - int(felt[0]), 0) if found.size else None,
            last_is_zero=not wrenches[-1].any(),
            error=error,
            ticks=ticks,
            rows=len(recording.ticks),
            report=audit(path),
            events=[str(event["event"]) for event in recording.events],
            dropped=sum(int(str(event.get("dropped", 0))) for event in recording.events),
            flags=flags,
            forces=forces,
            torques=np.linalg.norm(wrenches[:, 3:], axis=1),
            waited=waited,
        )

    def has_flag(self, flag: TickFlag) -> bool:
        return bool((self.flags & int(flag)).any())
