"""Execution of waiting commands, in order and at their ticks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from hapticbridge.commands.change import Repeater, tuning_ticks
from hapticbridge.commands.command import Couple, Mark, Repeat, Reset, Switch
from hapticbridge.commands.queue import CommandQueue
from hapticbridge.coupling import Coupling

Tell = Callable[..., None]


class Operator:
    """Executes one command per tick; commands that need zero force wait until it has faded.

    ``tell`` records an event of the present tick: its name, then its details.

    Attributes:
        felt: Requested coupling at the end of its present change.
        later: Postponed commands: tick, command, origin.
    """

    def __init__(self, queue: CommandQueue, tell: Tell) -> None:
        self.felt: Coupling = queue.allowance.start
        self.later: deque[tuple[int, str]] = deque()
        self._queue, self._tell = queue, tell
        self._has_force, self._is_clutched = True, False
        self._repeater: Repeater | None = None
        self._fade_ticks = 1

    @property
    def used(self) -> Coupling:
        """Law's coupling at the end of its present change."""
        return self._queue.allowance.used(self.felt)

    def begin(self, repeater: Repeater, fade_ticks: int) -> None:
        """Starts a run at its first tick.

        The force fades within ``fade_ticks``.
        """
        self._repeater, self._fade_ticks = repeater, fade_ticks
        self.later.clear()
        if not self._has_force or self._is_clutched:
            self._switch("run")

    def act(self, tick: int) -> None:
        """Executes the command that is due before a tick."""
        if self.later:
            due, by = self.later[0]
            if tick < due:
                return  # commands keep their order
            self.later.popleft()
            self._do({"event": "reset", "by": by})
            self._switch(by)
            return
        command, by = self._queue.waiting.popleft()
        if isinstance(command, Couple):
            self.felt = self._queue.allowance.felt(command, self.felt)
            law = asdict(self.used)
            ticks = tuning_ticks(self._queue.allowance.period)
            self._do({"event": "coupling", **law, "ticks": ticks, "by": by})
        elif isinstance(command, Switch):
            if command.force is not None:
                self._has_force = command.force
            if command.clutch is not None:
                self._is_clutched = command.clutch
            self._switch(by)
        elif isinstance(command, Reset):
            self.later.append((tick + self._fade_ticks + 1, by))
            self._switch(by, is_fading=True)
        elif isinstance(command, Mark):
            self._tell("mark", by=by)
        elif isinstance(command, Repeat):
            for event in command.events:
                self._do({n: v for n, v in event.items() if n not in ("tick", "time_ns")})

    def _switch(self, by: str, *, is_fading: bool = False) -> None:
        force = self._has_force and not is_fading
        event = {"event": "switch", "force": force, "clutch": self._is_clutched, "by": by}
        # a force that fades for a moment only was not switched off by a command
        self._do(event | ({"fading": True} if is_fading else {}))

    def _do(self, event: dict[str, Any]) -> None:
        if self._repeater is not None:
            self._repeater.apply(event)
        details = dict(event)
        self._tell(details.pop("event"), **details)
