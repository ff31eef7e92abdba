"""Inputs and commands that a run takes while it goes on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Self

from numpy.typing import ArrayLike

from hapticbridge.commands import Command, Operator, Repeat
from hapticbridge.commands.command import Stop
from hapticbridge.errors import CommandError, SceneError
from hapticbridge.inputs import Write, apply_writes, input_writes
from hapticbridge.opened import Opened


class Commanded(Opened):
    """A bridge that takes inputs and commands between two ticks, and notes each with its tick."""

    _end = -1

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
