"""Runs a recorded hand through a changed bridge, and sets the runs side by side."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport, audit
from hapticbridge.bridge import Bridge
from hapticbridge.clock import SimulatedClock
from hapticbridge.device import Device
from hapticbridge.device.simulated.scene_hand import scene_hand
from hapticbridge.errors import RecordingError, SafetyTrip
from hapticbridge.recording import read_recording
from hapticbridge.tick import TickFlag
from hapticbridge.whatif.changes import UNITS, Settings, Value
from hapticbridge.whatif.hands import (
    IdentifiedDevice,
    RecordedMotion,
    ResampledMotion,
    missing_for_closed_loop,
)
from hapticbridge.whatif.outcome import CLOSED, PRESCRIBED, RECORDED, WhatIf, WhatIfRun
from hapticbridge.whatif.recorded import RecordedRun


def what_if(
    path: str | Path,
    changes: Mapping[str, Value],
    *,
    progress: Callable[[int, int, str], None] | None = None,
) -> WhatIf:
    """Simulates a recorded run again with a changed bridge.

    Twice: with the recorded motion of the device, whatever the forces (``prescribed``), and, where
    the device's mass and damping are known, in a closed loop of that device and a model hand which
    wants what the recorded hand wanted (``hands``). All runs are judged by the same audit. Memory
    holds all of them.

    Args:
        path: The recording, neither damaged nor changed; it carries its scene.
        changes: New values by name: ``changes.UNITS``, or the scene's own parameters. None runs the
            recorded settings again.
        progress: Called with the runs done, all of them, and the one that begins.

    Raises:
        RecordingError: The recording cannot be judged or simulated, or a change is unknown.
        HapticBridgeError: The changed bridge is refused; the message says why.
    """
    tell = progress or _silent
    tell(0, 4, "auditing what was recorded")
    report = audit(path)
    if report.verdict == "invalid":
        raise RecordingError(f"what is invalid cannot be simulated again: {report.reason}")
    with TemporaryDirectory(prefix="hapticbridge-") as name:
        folder = Path(name)
        run = RecordedRun.of(read_recording(path), folder / "scene")
        return _Experiment(run, report, folder, tell).changed(changes)


class _Experiment:
    """Runs one recorded run in variations."""

    def __init__(
        self,
        run: RecordedRun,
        report: AuditReport,
        folder: Path,
        tell: Callable[[int, int, str], None],
    ) -> None:
        self._run, self._report, self._folder, self._tell = run, report, folder, tell
        self._ticks, self._period = run.recording.ticks, run.parameters.period
        if len(self._ticks) < 3:
            raise RecordingError(f"'{run.recording.path}' is too short to be simulated again")
        self._concerns: dict[str, None] = {}

    def changed(self, changes: Mapping[str, Value]) -> WhatIf:
        """Returns all runs."""
        run, settings = self._run, self._run.settings
        new = settings.changed(changes)
        notes = []
        if not run.is_scene_as_recorded():
            notes.append(
                "the attached scene does not give the recorded model: a program changed it after "
                "it was loaded, or it was compiled elsewhere; these runs are without that change"
            )
        runs = [self._as_recorded()]
        self._tell(1, 4, "the recorded motion")
        runs.append(self._simulated(PRESCRIBED, self._prescribed(new), new))
        notes.extend(_unrepeated(self._ticks))
        if runs[0].trip:
            notes.append("what was recorded ends in a trip: these runs end there, too")
        if new.rate != settings.rate:
            notes.append(
                "the recorded motion is linear between its samples: at another rate its speed "
                "changes in steps"
            )
        hand_error = math.nan
        if missing := missing_for_closed_loop(run.info):
            notes.append(f"no closed loop: {missing}")
        else:
            self._tell(2, 4, "the model hand, nothing changed")
            same = self._simulated(CLOSED, self._identified(settings), settings)
            hand_error = self._hand_error(same)
            self._tell(3, 4, "the model hand")
            runs.append(self._simulated(CLOSED, self._identified(new), new))
            notes.append(
                f"with nothing changed the model hand is {1e3 * hand_error:.3g} mm off the "
                "recorded motion (root mean square); how it gives way to changed forces is assumed"
            )
        told = tuple(
            (name, UNITS.get(name, ""), settings.value(name), new.value(name)) for name in changes
        )
        return WhatIf(run.recording.path, told, tuple(runs), hand_error, (*notes, *self._concerns))

    def _as_recorded(self) -> WhatIfRun:
        trips = [e for e in self._run.recording.events if e.get("event") == "trip"]
        trip = str(trips[0].get("reason", "unknown")) if trips else ""
        peaks = _peaks(self._ticks)
        return WhatIfRun(RECORDED, self._report, peaks, trip, self._period, self._ticks)

    def _prescribed(self, settings: Settings) -> Device:
        kind = RecordedMotion if settings.rate == self._run.settings.rate else ResampledMotion
        start = self._run.start
        return kind(self._ticks, self._period, start, self._run.info)

    def _identified(self, settings: Settings) -> Device:
        hand = scene_hand(self._run.scene(settings))
        start = self._run.start
        return IdentifiedDevice(self._run.info, hand, self._ticks, self._period, start)

    def _hand_error(self, same: WhatIfRun) -> float:
        count = min(len(same.ticks), len(self._ticks))
        off = same.ticks["device_position"][:count] - self._ticks["device_position"][:count]
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    def _simulated(self, name: str, device: Device, settings: Settings) -> WhatIfRun:
        run = self._run
        path = self._folder / "run.mcap"
        bridge = Bridge(
            run.scene(settings),
            device,
            settings.coupling,
            rate=settings.rate,
            substeps=settings.substeps,
            method=settings.method.name,
            contact_stiffness=settings.contact_stiffness,
            recording=path,
            clock=SimulatedClock(),
            scale=settings.scale,
            force_scale=settings.force_scale,
            axes=np.array(run.parameters.axes),
            absolute=run.is_absolute,
            limits=run.limits,
            controller=settings.controller,
            clutch=run.clutch,
            dead_man=run.dead_man,
        )
        trip = ""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            with bridge:
                try:
                    self._repeat(bridge)
                except SafetyTrip as error:
                    trip = str(error)
        if settings is not run.settings:
            # where the scene was unpacked to tells nobody anything
            told = [str(each.message).replace(str(run.scene_file), "") for each in caught]
            self._concerns |= dict.fromkeys(text.removeprefix("scene '': ") for text in told)
        ticks = read_recording(path).ticks
        return WhatIfRun(name, audit(path), _peaks(ticks), trip, bridge.period, ticks)

    def _repeat(self, bridge: Bridge) -> None:
        """Runs as long as was recorded, with its inputs and its pauses at their times."""
        per_tick = self._period / bridge.period
        events = self._run.recording.events
        inputs = [e for e in events if e.get("event") == "input"]
        pauses = [e for e in events if e.get("event") == "resume"]
        due = [math.ceil(int(each["tick"]) * per_tick - 1e-9) for each in inputs]

        def on_tick(tick: int) -> None:
            while due and due[0] <= tick:
                due.pop(0)
                bridge.repeat_input(inputs.pop(0)["writes"])

        ends = [int(each["tick"]) for each in pauses] + [len(self._ticks)]
        done = 0
        for end in ends:
            count = round(end * per_tick) - done
            if count > 0:
                bridge.run(count * bridge.period, on_tick)
                done += count


def _unrepeated(ticks: NDArray[np.void]) -> Iterator[str]:
    """Says what these runs have not of the recorded one."""
    flags = ticks["flags"]
    if missed := int(np.count_nonzero(flags & int(TickFlag.OVERRUN))):
        yield (
            f"missed deadlines: {missed} when it was recorded, none in these runs: what the hand "
            "did meanwhile it does here in one tick"
        )
    if (flags & int(TickFlag.CONTROLLER_ACTIVE)).any():
        yield "a controller was at work; the prescribed run has none, because nobody feels it"


def _peaks(ticks: NDArray[np.void]) -> dict[str, float]:
    """Returns the largest forces, torques and stretch of a run; zero without ticks."""

    def largest(vectors: NDArray[np.float64]) -> float:
        return float(np.linalg.norm(vectors, axis=1).max(initial=0.0))

    tool, device = ticks["wrench_on_tool"], ticks["wrench_on_device"]
    return {
        "force on tool": largest(tool[:, :3]),
        "torque on tool": largest(tool[:, 3:]),
        "force on device": largest(device[:, :3]),
        "torque on device": largest(device[:, 3:]),
        "stretch": largest(ticks["handle_position"] - ticks["tool_position"]),
    }


def _silent(_done: int, _total: int, _name: str) -> None:
    """Says nothing: the library draws no progress."""
