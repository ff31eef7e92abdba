"""Recordings to audit: honest runs, and files with something changed and new checksums."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport, audit
from hapticbridge.audit.energy import EnergyBalance, energy_balances
from hapticbridge.audit.events import AuditState, RunEvents
from hapticbridge.audit.wrench_limits import AuditedBlock
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.device import AXES, Device, DeviceInfo
from hapticbridge.kernel.parameters import UNGUARDED, RunParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE, TickFlag
from hapticbridge.recording import Attachment, Recording, RecordingWriter
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.description import SOURCE_PREFIX
from hapticbridge.run.summary import Summary
from hapticbridge.scene import Scene

COUPLING = Coupling(2400.0, 0.5, 2.4, 5e-4)

FLOAT_FIELDS = tuple(name for name in TICK_DTYPE.names or () if TICK_DTYPE[name].base.kind == "f")

COMPONENTS = tuple(
    (name, index)
    for name in FLOAT_FIELDS
    for index in range(int(np.prod(TICK_DTYPE[name].shape, dtype=int)))
)
"""Every floating-point number of a record: field and index in it."""

TAP = """t,x,y,z,qw,qx,qy,qz
0,0,0,0,1,0,0,0
0.05,0.0003,0.0002,-0.009,0.9999,0.0141,0,0
0.10,0.0006,0.0001,-0.0125,0.9998,0.0141,0.0141,0
0.15,0.0012,-0.0004,-0.0105,1,0,0,0
0.20,0.0014,0.0003,-0.0130,0.9998,0,0.0141,0.0141
"""
"""A hand that taps the mouth of the hole in every direction, off centre and tilted."""


def balance_of(
    recording: Recording, parameters: RunParameters
) -> tuple[AuditedBlock, EnergyBalance]:
    """Returns a whole recording as one block, with its balance from the recorded start."""
    state = AuditState.at_start(recording, parameters)
    events = RunEvents.from_recording(recording, parameters)
    return next(energy_balances([recording.ticks], state, events))


def recorded(
    path: Path,
    scene: str | Path | Scene = "peg_in_hole",
    device: str | Device = "simulated",
    coupling: Coupling | None = None,
    *,
    duration: float | None = None,
    on_tick: Callable[[Bridge, int], None] | None = None,
    **options: Any,
) -> Summary:
    """Runs a bridge in simulated time into a file."""
    options.setdefault("clock", SimulatedClock())
    options.setdefault(
        "limits", Limits(force=10.0, torque=0.5, ramp=0.05, angle=math.inf, energy=math.inf)
    )
    options.setdefault("controller", "off")  # what is audited is what a method does by itself
    is_guarded = options.pop("is_guarded", True)
    bridge = Bridge(scene, device, coupling, recording=path, **options)
    if not is_guarded:  # what happens where nobody stops it
        bridge.setup = replace(bridge.setup, guard=UNGUARDED)
    with bridge:
        return bridge.run(duration, on_tick and (lambda tick: on_tick(bridge, tick)))


def tapped(folder: Path, name: str = "tap.mcap", **options: Any) -> Path:
    """Records a short run of the peg in contact; every number of its records is at work."""
    motion = folder / "tap.csv"
    motion.write_text(TAP)
    recorded(folder / name, device=f"trajectory:{motion}", **options)
    return folder / name


def rewritten(
    recording: Recording,
    path: Path,
    *,
    ticks: NDArray[np.void] | None = None,
    meta: Mapping[str, str] | None = None,
    events: Sequence[Mapping[str, object]] | None = None,
    attachments: Mapping[str, bytes] | None = None,
) -> Path:
    """Writes a recording with parts changed, and checksums that fit them.

    As in a recording of a run, an event comes before the ticks that follow it.
    """
    files = {**recording.attachments, **(attachments or {})}
    writer = RecordingWriter(
        path,
        {**recording.meta, **(meta or {})},
        [Attachment(name, "application/octet-stream", data) for name, data in files.items()],
        int(recording.meta["epoch_ns"]),
    )
    rows, start = recording.ticks if ticks is None else ticks, 0
    for event in recording.events if events is None else events:
        tick, time = (event.get(name) for name in ("tick", "time_ns"))
        stop = int(np.searchsorted(rows["tick"], tick)) if isinstance(tick, int) else start
        writer.write_ticks(rows[start : max(start, stop)])
        writer.write_event(event, time if isinstance(time, int) else 0)
        start = max(start, stop)
    writer.write_ticks(rows[start:])
    writer.close()
    return path


def without_model(recording: Recording) -> Recording:
    """Leaves out what a re-simulation needs."""
    kept = recording.attachments.items()
    files = {name: data for name, data in kept if not name.startswith(SOURCE_PREFIX)}
    return Recording(**{**vars(recording), "attachments": files})


def other_request(recording: Recording, change: Callable[[dict[str, Any]], Any]) -> dict[str, str]:
    """Returns the metadata of a changed request."""
    asked = json.loads(recording.meta["request"])
    change(asked)
    return {"request": json.dumps(asked)}


def other_sheet(recording: Recording, **values: Any) -> dict[str, str]:
    """Returns the metadata of another data sheet of the device, stated and requested.

    The coupling is requested in numbers, which no data sheet changes.
    """
    sheet = json.loads(recording.meta["device"]) | values
    gains = (each.name for each in fields(Coupling))
    coupling = dict(zip(gains, json.loads(recording.meta["requested"]), strict=True))

    def change(request: dict[str, Any]) -> None:
        request["devices"] = [sheet]
        request["grasps"][0]["coupling"] = coupling

    return {"device": json.dumps(sheet)} | other_request(recording, change)


SHEET = DeviceInfo(
    name="scripted",
    axes=AXES,
    mass=0.1,
    damping=2.0,
    rotational_inertia=1e-4,
    rotational_damping=2e-3,
    force_limit=10.0,
    torque_limit=0.5,
    speed_limit=5.0,
    delay=0.0,
    is_delay_measured=True,
    is_real=False,
)


def stroke(tick: int) -> tuple[float, ...]:
    """A hand that swings by 25 mm, at most at 0.5 m/s, and presses the wall at its second turn."""
    return (0.025 * np.sin(0.02 * tick), 0, 0, 1, 0, 0, 0)


class AnsweringDevice:
    """A device on the x axis whose hand answers the force that it was sent.

    Args:
        speed: Speed in m/s until the next tick, from the tick and the force in N.
        sheet: Fields of the data sheet that differ from ``SHEET``.
    """

    def __init__(self, speed: Callable[[int, float], float], **sheet: Any) -> None:
        self.info = replace(SHEET, axes=("x",), **sheet)
        self._speed = speed

    def start(self, period: float) -> NDArray[np.void]:
        self._period, self._tick, self._place, self._force = period, 0, 0.0, 0.0
        sample = np.zeros(1, SAMPLE_DTYPE)
        sample["quaternion"][0, 0] = 1.0
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        self._place += self._speed(self._tick, self._force) * self._period
        self._tick += 1
        sample["position"][0] = self._place, 0.0, 0.0
        sample["quaternion"][0] = 1.0, 0.0, 0.0, 0.0
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self._force = float(wrench[0])

    def close(self) -> None:
        self._force = 0.0


class ScriptedDevice:
    """A device whose poses, buttons and gaps come from its tick, and which keeps what it is sent.

    Args:
        pose: Position in m and quaternion (w, x, y, z) by tick.
        buttons: Button bits by tick.
        is_stale: Tells of a tick that has no new sample.
        on_write: Called with the number of wrenches written, after each.
        on_close: Called when it is closed.
        strength: Force limit in N; the torque limit in N m is a twentieth of it.
        sheet: Fields of the data sheet that differ from ``SHEET``.
    """

    def __init__(
        self,
        pose: Callable[[int], Sequence[float]],
        *,
        buttons: Callable[[int], int] = lambda _: 0,
        is_stale: Callable[[int], bool] = lambda _: False,
        on_write: Callable[[int], None] | None = None,
        on_close: Callable[[], None] | None = None,
        strength: float = 10.0,
        **sheet: Any,
    ) -> None:
        limits = {"force_limit": strength, "torque_limit": 0.05 * strength}
        self.info = replace(SHEET, **{**limits, **sheet})
        self.writes: list[NDArray[np.float64]] = []
        self.is_closed = False
        self.tick = 0
        self._pose, self._buttons, self._is_stale = pose, buttons, is_stale
        self._on_write, self._on_close = on_write, on_close

    def start(self, period: float) -> NDArray[np.void]:
        self.tick = 0
        sample = np.zeros(1, SAMPLE_DTYPE)
        self.report(sample, 0)
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        tick = self.tick
        self.tick += 1
        if self._is_stale(tick):
            return int(TickFlag.STALE_SAMPLE)
        self.report(sample, tick)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.writes.append(wrench.copy())
        if self._on_write is not None:
            self._on_write(len(self.writes))

    def close(self) -> None:
        self.is_closed = True
        if self._on_close is not None:
            self._on_close()

    def report(self, sample: NDArray[np.void], tick: int) -> None:
        """Writes the pose and the buttons of a tick."""
        pose = self._pose(tick)
        sample["position"][0] = pose[:3]
        sample["quaternion"][0] = pose[3:]
        sample["buttons"] = self._buttons(tick)


class SlowClock(SimulatedClock):
    """A real clock's behaviour on a machine that stalls: deadlines are skipped, or met late.

    Args:
        stalls: How many deadlines are skipped before a tick, by the tick's number.
        late: Ticks that begin late, by a share of the period below 1.
    """

    may_wait = False

    def __init__(self, stalls: Mapping[int, int], late: Mapping[int, float] | None = None) -> None:
        super().__init__()
        self._stalls = stalls
        self._late = late or {}
        self._count = self._lateness = 0

    def wait(self) -> tuple[int, int, int]:
        skipped = self._stalls.get(self._count, 0)
        self._lateness = round(self._late.get(self._count, 0.0) * self._period)
        self._count += 1
        self._now += (1 + skipped) * self._period
        return self._now, self.now(), skipped

    def spend(self, share: float) -> None:
        """Lets a share of the period pass within the tick."""
        self._lateness += round(share * self._period)

    def now(self) -> int:
        return self._now + self._lateness


def verdict_of(recording: Recording, folder: Path, **parts: Any) -> AuditReport:
    path = rewritten(recording, folder / "tampered.mcap", **parts)
    return audit(path, in_process=True)
