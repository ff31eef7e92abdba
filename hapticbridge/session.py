"""What is open while a bridge is: device, ring, recording, kernel; and how it is left again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.certificate import condition_sentences
from hapticbridge.clock import RealClock
from hapticbridge.commands import Command, CommandExecutor, EventApplier, Repeat
from hapticbridge.commands.command import Stop
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CommandError, DeviceError, HapticBridgeError, SceneError
from hapticbridge.guard import refuse_stretched_start, wait_until_still
from hapticbridge.inputs import Write, apply_writes, input_writes
from hapticbridge.jit import direct
from hapticbridge.kernel.state import STATE_DTYPE, BoundKernel
from hapticbridge.kernel.tick import (
    answer_step,
    before_step,
    finish_tick,
    publish,
    publish_positions,
)
from hapticbridge.options import Arrangement, run_parameters
from hapticbridge.realtime import Grant, check_pace, memory_at_rest
from hapticbridge.record import TICK_DTYPE
from hapticbridge.recording.recorder import RecordStream
from hapticbridge.recording.snapshot import Snapshot
from hapticbridge.rendering import prepare
from hapticbridge.run_description import attachments, describe_run, start_state
from hapticbridge.summary import Ledger, Summary

_NO_FORCE = np.zeros(6)


class Opened(Arrangement):
    """An arrangement that can be entered and left, with the ways into a run and what it says.

    Entering prepares everything and compiles what must be compiled; leaving commands zero force,
    closes the recording with a reason, and closes the device.

    Attributes:
        parameters: All that decides what the run computes; once entered.
    """

    _tick = _overruns = _skipped = 0
    _stopped_by = _signal = ""
    _is_open = False
    _grants: tuple[Grant, ...] = ()

    def __enter__(self) -> Self:
        # released in reverse order, whatever one of them does: force, recording, ring, device
        with ExitStack() as resources:
            resources.callback(self.device.close)
            self._prepare(resources)
            resources.callback(self._silence)
            self._resources = resources.pop_all()
        self._is_open = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._is_open = False
        reason = self._stopped_by if error is None else f"{type(error).__name__}: {error}"
        self._event(
            "stop",
            reason=reason,
            **self._named_signal(),
            overruns=self._overruns,
            skipped=self._skipped,
            dropped=self._stream.dropped,
        )
        self._resources.__exit__(kind, error, traceback)

    def _prepare(self, resources: ExitStack) -> None:
        """Compiles the kernel, puts the scene to its start, and opens the recording."""
        if self._tick or self._is_open:
            raise HapticBridgeError("a bridge is entered once; make a new one for another run")
        self.scene.claim()
        resources.callback(self.scene.release)
        scene, clock, method = self.scene, self.clock, self.method
        felt = prepare(scene, self.coupling, self.period, self._substeps, method)
        self._snapshot = None if self._onlooker is None else Snapshot.shared(scene.model)
        if self._snapshot is not None:
            resources.callback(self._snapshot.close)
        self._stream = RecordStream(
            self._path,
            self.period,
            live=self._is_live,
            is_lossless=clock.is_lossless,
            onlooker=self._onlooker,
            snapshot=str(self._snapshot and self._snapshot.name),
        )
        resources.callback(self._stream.close)
        self._compile()
        if clock.name == RealClock.name:
            is_real = self.device.info.is_real
            check_pace(scene, method, self.period, self._substeps, is_real=is_real)
        if self._is_realtime:
            self._grants = resources.enter_context(memory_at_rest())
        # last, because from here on the device is held, and its pose counts
        self._sample[:] = self.device.start(self.period)
        self._bind(felt)
        refuse_stretched_start(self._binding.state, self._sample, self._limits)
        if self._stream.is_read:
            self._stream.start(self._description(), attachments(scene))
            self._event("start")

    def _bind(self, felt: Coupling | None) -> None:
        """Binds the kernel to the scene, whose present state is where the run starts."""
        scene = self.scene
        start = start_state(scene.model, scene.data).tobytes()
        self.parameters = parameters = run_parameters(
            scene,
            self.coupling,
            self.method,
            self._sample,
            period=self.period,
            felt=felt,
            substeps=self._substeps,
            info=self.device.info,
            limits=self._limits,
            workspace=self._workspace,
            contact_stiffness=self._contact_stiffness,
            guarding=self._guarding,
        )
        self._binding = binding = BoundKernel(scene.model, scene.data, parameters)
        self._repeater = EventApplier(
            binding, scene.model, scene.data, self.method, parameters, start
        )

    def _description(self) -> dict[str, str]:
        return describe_run(
            self.scene,
            self.parameters,
            self._binding,
            method=self.method.name,
            device=self.device.info,
            clock=self.clock.name,
        )

    def _come_to_rest(self) -> None:
        """Waits until a real device is still, before force is enabled.

        Raises:
            DeviceError: It moves on, or a hand has meanwhile moved an absolute one too far.
        """
        stops = self._stops
        wait_until_still(self.device, self._sample, self.period, self.clock, lambda: stops)
        if not self._tick and not stops and self._workspace.is_absolute:
            refuse_stretched_start(self._binding.state, self._sample, self._limits)

    def _compile(self) -> None:
        """Gets the machine code of the tick ready, so that the first one is not late."""
        state, row, sample = np.zeros(1, STATE_DTYPE), np.zeros(1, TICK_DTYPE), self._sample
        rows, cursors = self._stream.rows, self._stream.cursors
        self._before_step = direct(before_step, state, sample, row, 0, 0.0)
        self._answer_step = direct(answer_step, state, row, 0)
        self._publish = direct(publish, row, rows, cursors, 0, 0, 0, 0, 0)
        head, numbers = np.zeros(1, np.int64), np.zeros(1)
        self._publish_positions = direct(publish_positions, state, cursors, head, numbers)
        self._finish_tick = direct(finish_tick, state, row, rows, cursors, 0, 0, 0, 0, 0, True)

    def _silence(self) -> str:
        """Commands zero force; returns why that failed, or nothing."""
        try:
            self.device.write(_NO_FORCE)
        except DeviceError as error:
            return f"zero force could not be sent: {error}"
        return ""

    def _named_signal(self) -> dict[str, str]:
        """What an event says of the signal that ended the run, if one did."""
        return {"signal": self._signal} if self._signal else {}

    def _event(self, event: str, **details: object) -> None:
        self._stream.event(event, self._tick, self.clock.now(), **details)

    @property
    def ledger(self) -> Ledger:
        """Energies so far, per port."""
        return Ledger.of(self._binding.state)

    def latest_records(self, count: int) -> NDArray[np.void]:
        """Returns copies of the newest records (``TICK_DTYPE``), oldest first."""
        return self._stream.latest(count)

    def conditions(self) -> tuple[str, ...]:
        """Returns what is to be said of device and method, one sentence each; known once open."""
        return condition_sentences(self.device.info, self.parameters, self.method)

    def summary(self) -> Summary:
        """Returns what the run was so far."""
        return Summary.of(
            self._binding.state,
            self.parameters,
            self.device.info,
            self.method,
            self.coupling,
            ticks=self._tick,
            overruns=self._overruns,
            skipped=self._skipped,
            dropped=self._stream.dropped,
            stopped_by=self._stopped_by,
            recording=self._path,
        )


# Inputs and commands that a run takes while it goes on.


class Commanded(Opened):
    """A bridge that takes inputs and commands between two ticks, and notes each with its tick."""

    _end = -1

    def __enter__(self) -> Self:
        super().__enter__()
        if self._onlooker is not None:
            self._commands.warm_up()
        self._operator = CommandExecutor(self._commands, self._event)
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

        It is done between two ticks and recorded with its tick, so that the run can be repeated.

        Args:
            command: A coupling, a switch, a reset, a mark in the recording, an end.
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

    def _take_changes(self) -> None:
        """Takes in what others want changed: between two ticks, and noted with its tick."""
        while self._inputs:
            writes = self._inputs.popleft()
            apply_writes(self.scene.data, writes)
            self._event("input", writes=writes)
        if self._commands.waiting or self._operator.later:
            self._operator.act(self._tick)
