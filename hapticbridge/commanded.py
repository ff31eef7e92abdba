"""What a run is asked for while it goes on: inputs of its scene, commands, a recorder."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from numpy.typing import ArrayLike

from hapticbridge.clock import RealClock, SimulatedClock
from hapticbridge.commands import Command, Operator, Record, Repeat
from hapticbridge.commands.command import Stop
from hapticbridge.errors import CommandError, RecordingError, SceneError
from hapticbridge.inputs import Write, apply_writes, input_writes
from hapticbridge.kernel.counts import Counts
from hapticbridge.opened import Opened
from hapticbridge.provenance import (
    MODEL_ATTACHMENT,
    RESET_ATTACHMENT,
    STATE_ATTACHMENT,
    start_state,
)
from hapticbridge.summary import Summary


class Commanded(Opened):
    """A bridge that takes inputs and commands between two ticks, and notes each with its tick."""

    _pause: Record | None = None
    _earlier_ticks, _end = 0, -1
    _earlier_fault: tuple[int, str] | None = None

    def __enter__(self) -> Self:
        super().__enter__()
        if self._onlooker is not None:
            self._commands.warm_up()
        self._operator = Operator(self._commands, self._event)
        self._operator.begin(self._repeater, self._guarding.fade_ticks)
        return self

    def set_input(
        self,
        *,
        ctrl: Mapping[str, ArrayLike] | None = None,
        mocap: Mapping[str, ArrayLike] | None = None,
        joint_force: Mapping[str, ArrayLike] | None = None,
        body_wrench: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Changes inputs of the scene from the next tick on; recorded, so the run can be repeated.

        Move mocap bodies slowly: MuJoCo damps their welds and contacts against rest, so a fast
        move can create energy, and the environment is then called active.

        Args:
            ctrl: Control per actuator of the scene.
            mocap: Pose (x, y, z[, qw, qx, qy, qz]) in m per mocap body of the scene.
            joint_force: Generalised force per joint, in N or N m per degree of freedom.
            body_wrench: (force, torque) in N and N m per body, world frame, at its centre of mass.

        Raises:
            SceneError: A name does not exist or has the wrong count of numbers.
        """
        self.repeat_input(
            input_writes(
                self.scene.model,
                ctrl=ctrl,
                mocap=mocap,
                joint_force=joint_force,
                body_wrench=body_wrench,
            )
        )

    def repeat_input(self, writes: list[Write]) -> None:
        """As ``set_input``, with the writes that a recording's event ``input`` holds.

        Raises:
            SceneError: The method cannot meter the work of inputs.
        """
        if not self.method.meters_inputs:
            raise SceneError(
                f"method '{self.method.name}' cannot meter the work of inputs; use 'implicit'"
            )
        self._inputs.append(writes)

    def command(self, command: Command, by: str = "caller") -> None:
        """Asks for something while the run goes on; from any thread, or from ``on_tick``.

        It is done between two ticks and recorded with its tick, so that the run can be repeated. A
        recorder that is started in mid-run gets a run that begins there: with tick 0, energies that
        are counted from it, and the state that the scene is in, so that its file is audited like
        any other. While it starts or stops, which takes about half a second, nothing is felt.

        Args:
            command: A coupling, a switch, a reset, a recorder to be started or stopped, an end.
            by: Who asks, for the recording.

        Raises:
            CommandError: The device does not allow it, the last command is too recent, or this run
                cannot do it; nothing changes then.
        """
        if isinstance(command, Stop):
            self.stop(by)
            return
        if not self._is_open:
            raise CommandError("the bridge is not open; nobody would do what is asked for")
        if isinstance(command, Record):
            if type(self.clock) not in (RealClock, SimulatedClock):
                raise CommandError("a clock of another kind cannot begin anew; nothing is recorded")
            if reason := self._needless(command):
                raise CommandError(reason)
        self._commands.offer(command, by)

    def repeat_commands(self, events: Sequence[Mapping[str, Any]]) -> None:
        """Does before the next tick what commands did in another run; for ``on_tick``.

        Nothing is asked of the device, and nothing waits for a force to fade: the other run did.

        Args:
            events: As its recording holds them (``commands.CHANGES``), in their order.
        """
        self._commands.waiting.append((Repeat(tuple(events)), ""))

    def stop(self, by: str = "caller") -> None:
        """Ends the run after the present tick; may be called from ``on_tick`` or a thread.

        Where none is running it ends the next one before its first tick: whoever wants the force
        off need not know whether it is on yet.

        Args:
            by: Who wants it, for the summary and the recording's event ``stop``; not empty.
        """
        self._stops.append((by or "caller", ""))

    def stop_on_signal(self, name: str) -> None:
        """As ``stop``, for a signal: what a program does with those that come before ``run``.

        Args:
            name: The signal's, for the recording.
        """
        self._stops.append(("signal", name))

    def _heed_stops(self) -> None:
        """Notes at the end of a run who ended it; what comes later is for the next one."""
        while self._stops:
            self._stopped_by, self._signal = self._stops.popleft()

    def summary(self) -> Summary:
        """Returns what the run was so far; energies count from where it last began anew."""
        now = super().summary()
        ticks = now.ticks + self._earlier_ticks
        duration = now.duration + self._earlier_ticks * self.period
        fault = self._earlier_fault or now.fault
        return replace(now, ticks=ticks, duration=duration, fault=fault)

    def _take_changes(self) -> bool:
        """Takes in what others want changed: between two ticks, and noted with its tick.

        Returns:
            Whether the loop must pause for it.
        """
        while self._inputs:
            writes = self._inputs.popleft()
            apply_writes(self.scene.data, writes)
            self._event("input", writes=writes)
        if self._commands.waiting or self._operator.later:
            self._pause = self._operator.act(self._tick)
        # asked for twice before the first was done: a pause would leave a hole in the recording
        if self._pause is not None and (reason := self._needless(self._pause)):
            self._pause = None
            self._stream.tell({"event": "refused", "reason": reason})
        return self._pause is not None

    def _needless(self, record: Record) -> str:
        """Returns why a recorder need not be started or stopped, or nothing."""
        if record.on != self._stream.is_recording:
            return ""
        return f"this run is {'already' if record.on else 'not'} being recorded"

    def _obey_in_pause(self) -> None:
        """Starts or stops the recorder while nothing is felt."""
        record, self._pause = self._pause, None
        try:
            if record is not None and record.on:
                self._begin_anew()
                self._record()
            else:
                self._event("stop", reason="recording stopped", dropped=self._stream.dropped)
                self._stream.stop_recording()
        except (RecordingError, OSError) as error:  # a name too long for the disk is one too
            self._stream.tell({"event": "refused", "reason": str(error)})
        path = str(self._path) if self._stream.is_recording else None
        self._stream.tell({"event": "recording", "path": path})
        if self._tick:
            self._binding.resume()
            self._event("resume")
        else:
            self._operator.begin(self._repeater, self._guarding.fade_ticks)

    def _begin_anew(self) -> None:
        """Lets a run begin in the state that the scene is in, with tick 0.

        Energies count from there, but what the guard holds against the device goes on: else it
        could be given the energy limit with each recorder that is started.
        """
        scene, method, counts = self.scene, self.method, Counts.of(self._binding.state)
        self._earlier_ticks += self._tick
        self._end -= self._tick if self._end >= 0 else 0
        self._earlier_fault = self._earlier_fault or self.ledger.fault
        self._tick, self.clock = 0, type(self.clock)()
        self._binding.let_go()
        scene.set_gains(*method.gains(self._operator.used, self.period / self._substeps))
        state = start_state(scene.model, scene.data).tobytes()
        self._begin_in(state, self._operator.felt, self.parameters.felt, counts)
        files = {item.name: item.data for item in self._attachments()}
        names = (MODEL_ATTACHMENT, STATE_ATTACHMENT, RESET_ATTACHMENT)
        needed = {name: files[name] for name in names}
        self._stream.tell(
            {
                "event": "begin",
                "metadata": self._description(),
                "attachments": {n: base64.b64encode(d).decode() for n, d in needed.items()},
            }
        )

    def _record(self) -> None:
        path = self._next_path()
        self._stream.record(path, self._description(), self._attachments())
        self._path = path
        self._event("start")

    def _next_path(self) -> Path:
        """Returns the first of NAME.mcap, NAME-2.mcap, NAME-3.mcap … that does not exist."""
        base = self._path or Path(f"{self.scene.name}.mcap")
        stem, _, number = base.stem.rpartition("-")
        if not (stem and number.isdecimal()):
            stem = base.stem
        candidate, count = base.with_stem(stem), 1
        while candidate.exists():
            count += 1
            candidate = base.with_stem(f"{stem}-{count}")
        return candidate
