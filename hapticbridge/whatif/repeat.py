"""Repetition of a run's inputs, commands and pauses."""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from hapticbridge.bridge import Bridge
from hapticbridge.clock import Clock
from hapticbridge.commands import CHANGES as COMMANDED
from hapticbridge.commands.change import coupling_in, tuning_ticks
from hapticbridge.device import Device
from hapticbridge.errors import SafetyTrip
from hapticbridge.guard import trip_reason
from hapticbridge.kernel.codes import GAVE_ENERGY, STRETCHED, TWISTED
from hapticbridge.whatif.changes import GAINS, Settings
from hapticbridge.whatif.recorded import RecordedRun

_BY_STATE = (STRETCHED, TWISTED, GAVE_ENERGY)
"""Trips caused by the state after the previous tick, at any sample; that tick can be repeated."""

Event = Mapping[str, Any]


class Repetition:
    """One repetition of a run with given settings.

    Attributes:
        settings: Settings of the bridge.
        warned: Warnings about the scene, one sentence each.
    """

    def __init__(self, run: RecordedRun, settings: Settings) -> None:
        self._run, self.settings = run, settings
        self._per_tick = 1.0
        self.warned: tuple[str, ...] = ()

    def into(self, path: Path, device: Device, clock: Clock) -> tuple[float, str]:
        """Runs into a file; returns the period in s, and the reason of the guard's stop or empty.

        Raises:
            HapticBridgeError: The changed bridge is refused; the message names the reason.
        """
        run, settings = self._run, self.settings
        bridge = Bridge(
            run.scene(settings),
            device,
            settings.coupling,
            rate=settings.rate,
            substeps=settings.substeps,
            method=settings.method.name,
            contact_stiffness=settings.contact_stiffness,
            recording=path,
            clock=clock,
            scale=settings.scale,
            force_scale=settings.force_scale,
            axes=np.array(run.parameters.axes),
            absolute=run.is_absolute,
            limits=run.limits,
            controller=settings.controller,
            clutch=run.clutch,
            dead_man=run.dead_man,
        )
        self._per_tick = run.parameters.period / bridge.period
        trip = ""
        with warnings.catch_warnings(record=True) as caught, ExitStack() as stack:
            warnings.simplefilter("always", UserWarning)
            stack.enter_context(bridge)
            try:
                self._repeat(bridge)
            except SafetyTrip as error:
                trip = str(error)
        # the temporary path of the unpacked scene means nothing to the reader
        messages = [str(each.message).replace(str(run.scene_file), "") for each in caught]
        self.warned = tuple(dict.fromkeys(text.removeprefix("scene '': ") for text in messages))
        return bridge.period, trip

    def _repeat(self, bridge: Bridge) -> None:
        due = deque(
            (math.ceil(int(event["tick"]) * self._per_tick - 1e-9), event)
            for each in self._run.recording.events
            if (event := self._action_for(each))
        )

        def on_tick(tick: int) -> None:
            commands = []
            while due and due[0][0] <= tick:
                event = due.popleft()[1]
                if event["event"] == "input":
                    bridge.repeat_input(event["writes"])
                else:
                    commands.append(event)
            if commands:
                bridge.repeat_commands(commands)

        done = 0
        for end in self._ends():
            count = round(end * self._per_tick) - done
            if count > 0:
                bridge.run(count * bridge.period, on_tick)
                done += count
        if self._was_tripped_by_state():
            bridge.run(bridge.period, on_tick)

    def _ends(self) -> list[int]:
        """Returns the ticks at which the recorded run paused, and the end."""
        events = self._run.recording.events
        pauses = [int(e["tick"]) for e in events if e.get("event") == "resume"]
        return [*pauses, len(self._run.recording.ticks)]

    def _was_tripped_by_state(self) -> bool:
        last = len(self._run.recording.ticks)
        return self._run.trip in [trip_reason(code, last) for code in _BY_STATE]

    def _action_for(self, event: Event) -> Event | None:
        """Returns the action that repeats a recorded event under these settings, or None."""
        name = event.get("event")
        if name == "coupling":
            return self._coupling(event) if self.keeps_couplings else None
        if name == "reset" and not self.keeps_resets:
            return None
        return event if name in ("input", *COMMANDED) else None

    @property
    def keeps_couplings(self) -> bool:
        """True if recorded changes of the coupling are repeated; a new coupling replaces them."""
        old, new = self._run.settings.coupling, self.settings.coupling
        is_kept = (old.stiffness, old.damping) == (new.stiffness, new.damping)
        return is_kept and self.settings.method.has_law

    @property
    def keeps_resets(self) -> bool:
        """True if resets are repeated; a massless tool has nothing to reset."""
        return self.settings.method.has_coupling

    def _coupling(self, event: Event) -> Event:
        """Returns the change to an equal effective coupling under these settings."""
        old, new, period = self._run.settings, self.settings, 1.0 / self.settings.rate
        if replace(new, scene=old.scene, controller=old.controller) == old:
            return event
        law = coupling_in(event, self._run.parameters)
        felt = old.method.rendered(law, self._run.parameters.period / old.substeps)
        kept = {name: getattr(new.coupling, name) for name in GAINS[2:]}
        used = new.method.used(replace(felt, **kept), period / new.substeps)
        return {**event, **asdict(used), "ticks": tuning_ticks(period)}
