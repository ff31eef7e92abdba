"""What the loop does with the commands that wait: at which tick, in which order."""

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
    """Takes one command a tick and does it; what must not happen under force waits until it faded.

    Args:
        queue: Where the commands wait.
        tell: Notes an event of the present tick: its name, then its details.

    Attributes:
        felt: The coupling that is to be felt, once its change is over.
        later: Resets that wait until the force has faded: tick, and who gave it.
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
        """The coupling of the law, once its change is over."""
        return self._queue.allowance.used(self.felt)

    def begin(self, repeater: Repeater, fade_ticks: int) -> None:
        """Takes up a run at its first tick.

        Args:
            repeater: Of the run.
            fade_ticks: In how many ticks its force fades.
        """
        self._repeater, self._fade_ticks = repeater, fade_ticks
        self.later.clear()
        if not self._has_force or self._is_clutched:
            self._switch("run")

    def act(self, tick: int) -> None:
        """Does what is due before a tick."""
        if self.later:
            due, by = self.later[0]
            if tick < due:
                return  # in the order that they were given
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
        # of a force that is only away for a moment; nobody asked for it to be off
        self._do(event | ({"fading": True} if is_fading else {}))

    def _do(self, event: dict[str, Any]) -> None:
        if self._repeater is not None:
            self._repeater.apply(event)
        details = dict(event)
        self._tell(details.pop("event"), **details)
