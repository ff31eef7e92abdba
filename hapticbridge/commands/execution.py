"""The way of a command into the loop: checked, slowed down, and kept where the loop looks."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, replace
from typing import Any

import mujoco

from hapticbridge.commands.allowed import CouplingLimits
from hapticbridge.commands.command import Command, Couple, Mark, Repeat, Reset, Switch
from hapticbridge.coupling import Coupling
from hapticbridge.errors import CommandError, HapticBridgeError, RecordingError
from hapticbridge.kernel.codes import CLUTCHED, FORCE_OFF
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.rendering import Method
from hapticbridge.run_description import restore_state

# What a command changes in a run, as the event that a recording keeps and a re-simulation
# repeats.
#
# coupling stiffness, damping, rotational_stiffness, rotational_damping of the law; ticks switch
# force, clutch; fading where the force comes back after a reset reset (nothing: the scene goes
# back to where the run began)
#
# The loop applies the very event that it then records, so both ways are one.

CHANGES = ("coupling", "switch", "reset")
"""Events that commands leave behind."""

TUNING_TIME = 0.5
"""In s: how long a change of the coupling takes, however small. From 2000 to 2400 N/m at 10 N the
spring gains 4 mJ, 8 mW; from 200 to 2400 N/m 0.23 J, which the energy limit of the guard stops.
Shorter is felt as a blow, longer as a slider that drags behind."""


def tuning_ticks(period: float) -> int:
    """Returns in how many ticks of ``period`` seconds a coupling changes."""
    return max(round(TUNING_TIME / period), 1)


def coupling_in(event: Mapping[str, Any], parameters: RunParameters) -> Coupling:
    """Returns the coupling that an event ``coupling`` names.

    Raises:
        RecordingError: It names none, the run has no coupling law, or it changes too fast.
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
    """Returns the bits of a record's ``buttons`` that an event ``switch`` asks for.

    Raises:
        RecordingError: It does not say.
    """
    force, clutch = event.get("force"), event.get("clutch")
    if not isinstance(force, bool) or not isinstance(clutch, bool):
        raise RecordingError(
            f"event 'switch' at tick {event.get('tick')!r} is damaged: force is {force!r}, clutch "
            f"{clutch!r}; they must be true or false"
        )
    return (0 if force else FORCE_OFF) | (CLUTCHED if clutch else 0)


class EventApplier:
    """Applies the events of commands to a run, be it live or simulated again.

    Args:
        binding: The run's.
        model: Of the scene.
        data: Likewise.
        method: How the tool is rendered.
        parameters: Of the run, as it began.
        start: The scene's state at the start (``provenance.start_state``), as bytes.
    """

    def __init__(
        self,
        binding: BoundKernel,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        method: Method,
        parameters: RunParameters,
        start: bytes,
    ) -> None:
        self._binding, self._model, self._data = binding, model, data
        self._method, self._parameters, self._start = method, parameters, start

    def apply(self, event: Mapping[str, Any]) -> None:
        """Does what an event of ``CHANGES`` says, before the tick that it names.

        Raises:
            RecordingError: The event is damaged.
        """
        kind, parameters = event.get("event"), self._parameters
        if kind == "coupling":
            coupling = coupling_in(event, parameters)
            gains = self._method.gains(coupling, parameters.period / parameters.substeps)
            goal = replace(parameters, coupling=coupling)
            self._binding.tune(goal, gains, tuning_ticks(parameters.period))
        elif kind == "switch":
            self._binding.command(bits_in(event))
        elif kind == "reset":
            if not self._method.has_coupling:
                raise RecordingError(f"event 'reset': method '{self._method.name}' has none")
            restore_state(self._model, self._data, self._start)
            self._binding.take_reset()


MOST_WAITING = 8
"""Commands that may wait for the loop, which takes one a tick; a loop that leaves more undone
stands still."""

INTERVAL = 0.05
"""In s, least time between two commands. A slider that is dragged needs no more than 20 a second to
look smooth, and each takes the loop some 20 µs; a flood must not become a load."""

RESET_INTERVAL = 1.0
"""Least time in s between two resets. The force fades before each and rises after it, which takes
half a second. A shorter interval lets resets follow each other without any force between them."""


class CommandQueue:
    """Commands between whoever gives them and the loop; nothing unchecked ever gets in.

    Any thread may ``offer``. The loop alone takes: it looks whether ``waiting`` is empty, which
    takes no lock and allocates nothing, and pops from its left end, which the interpreter does in
    one piece. The queue never holds more than ``MOST_WAITING``.

    Args:
        allowance: What the device allows.
        is_recorded: Whether the run is recorded, so that it can be marked.
        now: Time in s, that never runs backwards.

    Attributes:
        waiting: Commands in their order, each with who gave it.
    """

    def __init__(
        self,
        allowance: CouplingLimits,
        *,
        is_recorded: bool = True,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.allowance = allowance
        self.waiting: deque[tuple[Command | Repeat, str]] = deque(maxlen=MOST_WAITING)
        self._is_recorded, self._now = is_recorded, now
        self._offering = threading.Lock()  # never the loop's
        self._last = self._last_reset = -float("inf")

    def warm_up(self) -> None:
        """Computes what takes long, so that no command is the first one."""
        if self.allowance.method.has_law:
            for span in self.allowance.spans:
                span.needed(span.least_stiffness, 0.0)

    def offer(self, command: Command, by: str) -> None:
        """Hands a command over, or refuses it.

        Args:
            command: What is asked for.
            by: Who asks, for the recording.

        Raises:
            CommandError: It exceeds what the device allows, comes too soon after the last one, or
                the loop does not take any.
        """
        self._check(command)
        is_reset = isinstance(command, Reset)
        with self._offering:
            now = self._now()
            early = max(
                self._last + INTERVAL - now,
                self._last_reset + RESET_INTERVAL - now if is_reset else 0.0,
            )
            if early > 0:
                raise CommandError(f"the last command is too recent; ask again in {early:.2f} s")
            if len(self.waiting) >= MOST_WAITING:
                raise CommandError("the loop takes no commands; it stands still")
            self._last = now
            if is_reset:
                self._last_reset = now
            self.waiting.append((command, by))

    def _check(self, command: Command) -> None:
        if isinstance(command, Couple):
            self.allowance.check(command)
        elif isinstance(command, Reset) and not self.allowance.method.has_coupling:
            raise CommandError(
                "a tool without mass is where the hand is; there is nothing to reset"
            )
        elif isinstance(command, Mark) and not self._is_recorded:
            raise CommandError("this run is not recorded; start it with a recording to mark it")


# What the loop does with the commands that wait: at which tick, in which order.

Tell = Callable[..., None]


class CommandExecutor:
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
        self._repeater: EventApplier | None = None
        self._fade_ticks = 1

    @property
    def used(self) -> Coupling:
        """The coupling of the law, once its change is over."""
        return self._queue.allowance.used(self.felt)

    def begin(self, repeater: EventApplier, fade_ticks: int) -> None:
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
