"""Queue of validated, rate-limited commands, their execution and their repetition."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields, replace
from functools import partial
from typing import Any

import mujoco

from hapticbridge.commands.allowed import CouplingLimits
from hapticbridge.commands.command import Command, Couple, Hold, Mark, Repeat, Reset, Switch
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CommandError, HapticBridgeError, RecordingError
from hapticbridge.inputs import applied_writes
from hapticbridge.kernel.codes import CLUTCHED, FORCE_OFF
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.rendering import Method
from hapticbridge.run_description import restore_state
from hapticbridge.slow_scene import SlowScene

# Events of commands: recorded, and repeated by a re-simulation

CHANGES = ("coupling", "switch", "reset")
"""Names of the events that commands cause."""

TUNING_TIME = 0.5
"""Duration in s of any change of the coupling. From 2000 to 2400 N/m at 10 N the spring gains 4 mJ,
8 mW; from 200 to 2400 N/m 0.23 J, which the guard's energy limit stops. A shorter change feels like
a blow, a longer one like a lagging slider."""


def tuning_ticks(period: float) -> int:
    """Returns the duration of a change of the coupling in ticks of ``period`` seconds."""
    return max(round(TUNING_TIME / period), 1)


def coupling_in(event: Mapping[str, Any], parameters: RunParameters) -> Coupling:
    """Returns the coupling of an event ``coupling``.

    Raises:
        RecordingError: It has none, the run has no coupling law, or its duration is wrong.
    """
    tick = event.get("tick")
    try:
        coupling = Coupling(**{field.name: event.get(field.name) for field in fields(Coupling)})  # type: ignore[arg-type] # what is none is refused there
    except HapticBridgeError as error:
        raise RecordingError(f"event 'coupling' at tick {tick!r} is damaged: {error}") from None
    if not parameters.has_law:
        raise RecordingError(f"event 'coupling' at tick {tick!r}: the run has no coupling law")
    if event.get("ticks") != tuning_ticks(parameters.period):
        raise RecordingError(
            f"event 'coupling' at tick {tick!r} changes within {event.get('ticks')!r} ticks; it "
            f"takes {tuning_ticks(parameters.period)}"
        )
    return coupling


def bits_in(event: Mapping[str, Any]) -> int:
    """Returns the bits of a record's ``buttons`` for an event ``switch``.

    Raises:
        RecordingError: The event is damaged.
    """
    force, clutch = event.get("force"), event.get("clutch")
    if not isinstance(force, bool) or not isinstance(clutch, bool):
        raise RecordingError(
            f"event 'switch' at tick {event.get('tick')!r} is damaged: force is {force!r}, clutch "
            f"{clutch!r}; they must be true or false"
        )
    return (0 if force else FORCE_OFF) | (CLUTCHED if clutch else 0)


class EventApplier:
    """Applies events of commands and inputs to a live or simulated run.

    The loop applies the event that it records, so live run and re-simulation share one path.
    ``start`` is the scene's state at the start (``run_description.start_state``), as bytes. A scene
    slower than the loop takes part in a change before its next step.
    """

    def __init__(
        self,
        binding: BoundKernel,
        data: mujoco.MjData,
        method: Method,
        parameters: RunParameters,
        start: bytes,
        slow: SlowScene | None = None,
    ) -> None:
        self._binding, self._data, self._slow = binding, data, slow
        self._method, self._parameters, self._start = method, parameters, start

    def apply(self, event: Mapping[str, Any]) -> None:
        """Applies an event of ``CHANGES`` before the tick that it names.

        Raises:
            RecordingError: The event is damaged.
        """
        kind, parameters = event.get("event"), self._parameters
        if kind == "coupling":
            coupling = coupling_in(event, parameters)
            gains = self._method.gains(coupling, parameters.timestep)
            goal = replace(parameters, coupling=coupling)
            self._binding.tune(goal, gains, tuning_ticks(parameters.period))
            if self._slow is not None:
                of_scene = goal.of_scene
                tune = partial(self._slow.bound.tune, of_scene, gains)
                self._slow.queue_change(partial(tune, tuning_ticks(of_scene.period)))
        elif kind == "switch":
            self._binding.command(bits_in(event))
        elif kind == "reset":
            if not self._method.has_coupling:
                raise RecordingError(f"event 'reset': method '{self._method.name}' has no reset")
            self._reset()

    @property
    def is_idle(self) -> bool:
        """True if a reset needs not wait for a step of a slower scene."""
        return self._slow is None or self._slow.is_idle

    def _reset(self) -> None:
        if self._slow is not None:
            self._slow.settle()
        restore_state(self._data.model, self._data, self._start)
        if self._slow is not None:
            self._slow.bound.handle_reset()
        self._binding.handle_reset()

    def write(self, writes: Sequence[Sequence[Any]]) -> None:
        """Applies the writes of an event ``input`` (``inputs.input_writes``).

        Raises:
            SceneError: A write names another field or exceeds it.
        """
        apply = applied_writes(self._data, writes)
        if self._slow is None:
            apply()
        else:
            self._slow.queue_change(apply)


MAX_WAITING = 8
"""Largest number of waiting commands. The loop takes one per tick; more waiting ones mean that it
stalls."""

INTERVAL = 0.05
"""Shortest time in s between two commands. A dragged slider looks smooth at 20 per second; each
command costs the loop about 20 µs, and a flood must not become a load."""

RESET_INTERVAL = 1.0
"""Shortest time in s between two resets. The force fades before each and rises after it. With
a shorter interval, resets could follow each other without any force between them."""


class CommandQueue:
    """Queue of commands between their senders and the loop; every command in it is validated.

    Any thread may ``offer``; only the loop takes. The loop tests whether ``waiting`` is empty,
    which needs no lock and no allocation, and pops from its left end, which the interpreter does
    atomically. The queue holds at most ``MAX_WAITING`` commands.

    Args:
        limits: Limits of the coupling on the device.
        is_recorded: True for a recorded run, which can be marked.
        now: Returns the time in s; it never runs backwards.

    Attributes:
        limits: Limits of the coupling on the device.
        now: Returns the time in s; a test may replace it.
        waiting: Commands in order, each with its origin.
    """

    def __init__(
        self,
        limits: CouplingLimits,
        *,
        is_recorded: bool = True,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.limits, self.now = limits, now
        self.waiting: deque[tuple[Command | Repeat | Hold, str]] = deque(maxlen=MAX_WAITING)
        self._is_recorded = is_recorded
        self._offering = threading.Lock()  # never taken by the loop
        self._last = self._last_reset = -float("inf")

    def hold(self, is_held: bool, by: str) -> bool:
        """Adds a ``Hold`` before all waiting commands; returns False if there is no room."""
        has_room = len(self.waiting) < MAX_WAITING
        if has_room:
            self.waiting.appendleft((Hold(is_held), by))
        return has_room

    def warm_up(self) -> None:
        """Computes the tables of limits in advance, so that the first command is not slow."""
        if self.limits.method.has_law:
            for span in self.limits.spans:
                span.needed(span.min_stiffness, 0.0)

    def offer(self, command: Command, by: str) -> None:
        """Adds a command, or refuses it.

        ``by`` is the command's origin, for the recording.

        Raises:
            CommandError: It exceeds the device's limits, follows the last one too soon, or the loop
                stalls.
        """
        self._check(command)
        is_reset = isinstance(command, Reset)
        with self._offering:
            now = self.now()
            early = max(
                self._last + INTERVAL - now,
                self._last_reset + RESET_INTERVAL - now if is_reset else 0.0,
            )
            if early > 0:
                raise CommandError(f"the last command is too recent; try again in {early:.2f} s")
            if len(self.waiting) >= MAX_WAITING:
                raise CommandError("the loop takes no commands because it stalls; try again later")
            self._last = now
            if is_reset:
                self._last_reset = now
            self.waiting.append((command, by))

    def _check(self, command: Command) -> None:
        if isinstance(command, Couple):
            self.limits.check(command)
        elif isinstance(command, Reset) and not self.limits.method.has_coupling:
            raise CommandError("a massless tool follows the hand, so there is nothing to reset")
        elif isinstance(command, Mark) and not self._is_recorded:
            raise CommandError("this run is not recorded; start it with a recording to mark it")


# Execution of waiting commands, in order and at their ticks

NoteEvent = Callable[..., None]


class CommandExecutor:
    """Executes one command per tick; commands that need zero force wait until it has faded.

    Args:
        queue: The waiting commands.
        applier: Applies the events that the commands cause.
        fade_ticks: Ticks in which the force fades to zero.
        note: Records an event of the present tick: its name, then its details.

    Attributes:
        requested: Requested coupling at the end of its present change.
        later: Postponed resets: tick and origin.
    """

    def __init__(
        self, queue: CommandQueue, applier: EventApplier, fade_ticks: int, note: NoteEvent
    ) -> None:
        self.requested: Coupling = queue.limits.start
        self.later: deque[tuple[int, str]] = deque()
        self._queue, self._applier, self._fade_ticks, self._note = queue, applier, fade_ticks, note
        self._has_force, self._is_clutched, self._is_held = True, False, False

    def act(self, tick: int) -> None:
        """Executes the command that is due before a tick."""
        if self.later:
            due, by = self.later[0]
            if tick < due or not self._applier.is_idle:
                return  # commands keep their order
            self.later.popleft()
            self._apply({"event": "reset", "by": by})
            self._switch(by)
            return
        command, by = self._queue.waiting.popleft()
        if isinstance(command, Couple):
            limits = self._queue.limits
            self.requested = limits.requested(command, self.requested)
            law = asdict(limits.law(self.requested))
            ticks = tuning_ticks(limits.period)
            self._apply({"event": "coupling", **law, "ticks": ticks, "by": by})
        elif isinstance(command, Switch):
            if command.force is not None:
                self._has_force = command.force
            if command.clutch is not None:
                self._is_clutched = command.clutch
            self._switch(by)
        elif isinstance(command, Reset):
            self.later.append((tick + self._fade_ticks + 1, by))
            self._switch(by, is_fading=True)
        elif isinstance(command, Hold):
            self._is_held = command.is_held
            self._switch(by)
        elif isinstance(command, Mark):
            self._note("mark", by=by)
        elif isinstance(command, Repeat):
            for event in command.events:
                self._apply({n: v for n, v in event.items() if n not in ("tick", "time_ns")})

    def _switch(self, by: str, *, is_fading: bool = False) -> None:
        force = self._has_force and not is_fading and not self._is_held
        event = {"event": "switch", "force": force, "clutch": self._is_clutched, "by": by}
        # a force that fades for a moment only was not switched off by a command
        self._apply(event | ({"fading": True} if is_fading else {}))

    def _apply(self, event: dict[str, Any]) -> None:
        self._applier.apply(event)
        details = dict(event)
        self._note(details.pop("event"), **details)
