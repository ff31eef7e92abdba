"""Commands to a run in progress, recorded so that the audit can repeat them.

A command is refused if the device cannot bear its coupling. It waits in a queue, is applied between
two ticks and recorded as an event.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import (
    LARGEST,
    SMALLEST,
    check_fields,
    is_number,
    shared,
    shown,
)
from hapticbridge.coupling import PREFIX, UNITS, Axis, Coupling
from hapticbridge.demand.certificate import StepCondition, assumed_damping
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.loop_setting import IN_TIME, LoopSetting
from hapticbridge.demand.methods import Method
from hapticbridge.errors import (
    CommandError,
    CouplingError,
    HapticBridgeError,
    RecordingError,
    choices,
)
from hapticbridge.files import read_json
from hapticbridge.kernel.codes import CLUTCHED, FORCE_OFF
from hapticbridge.kernel.ledger import take_scene_works
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.run.description import restore_state
from hapticbridge.run.posted_scene import PostedScene
from hapticbridge.run.slow_scene import SlowScene
from hapticbridge.scene.inputs import applied_writes
from hapticbridge.units import format_si

# Commands and their wire format

MAX_LINE = 250
"""Largest size of a line in bytes; the longest command has about 170."""


@dataclass(frozen=True, slots=True)
class Couple:
    """Command that changes stiffness and damping of the coupling gradually.

    Attributes:
        stiffness: Requested K in N/m, finite and > 0.
        damping: Requested B in N s/m, finite and >= 0.
        rotational_stiffness: Requested K_r in N m/rad, finite and >= 0; None keeps it.
        rotational_damping: Requested B_r in N m s/rad, finite and >= 0; None keeps it. Both
            rotational gains are given or neither, because their bound is a joint one.
        grip: Grip of the hand; several hands need it, and None is the only hand.

    Raises:
        CommandError: A value is out of range.
    """

    stiffness: float = shared(Coupling, "stiffness", least=SMALLEST, most=LARGEST)
    damping: float = shared(Coupling, "damping", most=LARGEST)
    rotational_stiffness: float | None = shared(
        Coupling, "rotational_stiffness", None, most=LARGEST
    )
    rotational_damping: float | None = shared(Coupling, "rotational_damping", None, most=LARGEST)
    grip: str | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        check_fields(self, CommandError)
        if (self.rotational_stiffness is None) != (self.rotational_damping is None):
            raise CommandError("give rotational stiffness and damping together, or neither")


@dataclass(frozen=True, slots=True)
class Switch:
    """Command that switches force or clutch; None keeps a switch as it is.

    Attributes:
        force: True enables force on the device.
        clutch: True lets the device move without the handle.
        grip: Grip of the hand; None switches every hand.

    Raises:
        CommandError: A value is neither true nor false.
    """

    force: bool | None = None
    clutch: bool | None = None
    grip: str | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        check_fields(self, CommandError)


@dataclass(frozen=True, slots=True)
class Reset:
    """Command that resets the scene; the force fades before and rises after."""


@dataclass(frozen=True, slots=True)
class Mark:
    """Command that marks a moment: an event ``mark`` in the recording; ``export`` can cut there."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Command that ends the run."""


@dataclass(frozen=True, slots=True)
class Repeat:
    """Internal command that repeats recorded events; not accepted over the wire.

    Attributes:
        events: Events of ``CHANGES`` in order, all applied before one tick.
    """

    events: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True, slots=True)
class Hold:
    """Internal command that keeps the force off while a step of the scene does not end.

    Attributes:
        is_held: True keeps it off, False gives it back as the switches have it.
    """

    is_held: bool


Command = Couple | Switch | Reset | Mark | Stop

KINDS: dict[str, type[Command]] = {
    "couple": Couple,
    "switch": Switch,
    "reset": Reset,
    "mark": Mark,
    "stop": Stop,
}


def line_of(command: Command) -> bytes:
    """Returns a command as a line of JSON."""
    name = next(name for name, kind in KINDS.items() if isinstance(command, kind))
    return json.dumps({"command": name, **asdict(command)}).encode() + b"\n"


def command_of(line: bytes) -> Command:
    """Parses a line.

    Raises:
        CommandError: The line is too long, not a command, or has values that the command does not
            take.
    """
    if len(line) > MAX_LINE:
        raise CommandError(f"a command has at most {MAX_LINE} bytes")
    try:
        values: Any = read_json(line)
        name = values.pop("command")
        kind = KINDS[name]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise CommandError(
            f"{shown(line)} is not a command; choose one of {choices(KINDS)}"
        ) from None
    try:
        return kind(**values)
    except TypeError:
        valid = choices(each.name for each in fields(kind)) or "nothing else"
        raise CommandError(f"command '{name}' takes {valid}, not {shown(values)}") from None


# Couplings that may be selected during a run: the largest stiffness and damping of each

SOFTEST = 0.05
"""Smallest selectable stiffness as a share of the largest, without unit. A softer coupling no
longer shows the hand where the tool is. A run that began softer may stay so."""

_HALVINGS = 60
"""Number of bisections of a limit; more exceed the 53 bits of a double."""

_POINTS, _HIGHEST = 40, 1e3
"""Number of points, and largest ratio B'/(K T), of the table of required damping."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AxisCouplingLimits:
    """Limits of stiffness and damping along one kind of axis.

    They follow from the device condition b >= s (K T/2 + B'), with s = s_h s_f for translation and
    s_f/s_h for rotation. B' is the damping of the law. With a delay or several laws per tick the
    requirement is larger and has no closed form (``loop_setting.required_damping``). In translation
    the friction that the encoder's steps need is a limit too (``certificate.StepCondition``).
    Without any friction none suffices; then no coupling may shake the hand more than the start's.

    Attributes:
        axis: ``translation`` or ``rotation``.
        run: Limits of the run in both kinds of axis. Unknown damping of its device is replaced by
            ``certificate.assumed_damping``.
    """

    axis: Axis
    run: CouplingLimits

    @property
    def leverage(self) -> float:
        """Factor s from the tool's to the device's coupling."""
        return self.run.loop.ratio(self.axis)

    @property
    def damping(self) -> float:
        """Device damping b in N s/m or N m s/rad, or the assumed one."""
        return assumed_damping(self.run.loop.info)[self.axis == "rotation"]

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Ratios B'/K in s, and the required damping for K = 1 at each.

        The requirement is convex and homogeneous in (K, B'), so linear interpolation never
        underestimates it.
        """
        linear, angular = assumed_damping(self.run.loop.info)
        known = replace(self.run.loop.info, damping=linear, rotational_damping=angular)
        loop = replace(self.run.loop, info=known)
        is_linear = loop.law_evaluations == 1 and loop.lag == IN_TIME
        inner = () if is_linear else np.geomspace(0.02, 50.0, _POINTS)
        ratios = loop.period * np.array([0.0, *inner, _HIGHEST])
        needs = []
        for ratio in ratios.tolist():
            at = replace(loop, law=self.run.start.with_axis(self.axis, 1.0, ratio))
            try:
                needs.append(at.needs()[self.axis == "rotation"])
            except CouplingError:  # the delay is beyond what the theory takes
                needs.append(math.inf)
        return ratios, np.array(needs)

    def steps(self, requested: Coupling) -> StepCondition | None:
        """Returns the condition on encoder steps of a requested coupling; None without a limit."""
        if self.axis == "rotation":
            return None
        condition = StepCondition.of(replace(self.run.loop, law=self.run.law(requested)))
        return None if condition is None or condition.holds is None else condition

    @cached_property
    def friction(self) -> float:
        """Friction in N that holds encoder steps; without any, what the start's coupling needs."""
        steps = self.steps(self.run.start)
        return math.inf if steps is None else steps.available or steps.needed or 0.0

    def needed(self, stiffness: float, damping: float) -> float:
        """Returns the device damping b in N s/m or N m s/rad that requested gains need.

        It is inf where friction does not hold the encoder's steps. It takes microseconds after the
        first call, because a refusal must not slow the loop.
        """
        requested = self.run.start.with_axis(self.axis, stiffness, damping)
        steps = self.steps(requested)
        if steps is not None and (steps.needed or 0.0) > self.friction * (1.0 + 1e-9):
            return math.inf
        stiffness, damping = self.run.law(requested).gains(self.axis)
        ratios, needs = self._table
        highest = float(ratios[-1])
        ratio = min(damping / stiffness, highest) if stiffness > 0.0 else highest
        more = damping - ratio * stiffness  # B' beyond the table
        return (
            stiffness * float(np.interp(ratio, ratios, needs)) + float(needs[-1]) / highest * more
        )

    def max_stiffness(self, damping: float) -> float:
        """Returns the largest stiffness for a damping; 0 if there is none."""
        most = 4.0 * self.damping / (self.run.loop.period * self.leverage)
        return _largest(most, lambda stiffness: self.needed(stiffness, damping), self.damping)

    def max_damping(self, stiffness: float) -> float:
        """Returns the largest damping for a stiffness; 0 if there is none."""
        most = 4.0 * self.damping / self.leverage
        return _largest(most, lambda damping: self.needed(stiffness, damping), self.damping)

    @cached_property
    def min_stiffness(self) -> float:
        """Smallest selectable stiffness, at most that of the run's start.

        K >= F/(s · reach), because the guard stops a run whose coupling is too long before its
        force is full; and K >= ``SOFTEST`` of the largest. If it exceeded the start's stiffness, a
        change of the damping alone would stiffen the coupling.
        """
        limits = self.run.limits
        is_linear = self.axis == "translation"
        effort = limits.force if is_linear else limits.torque
        reach = self.leverage * (limits.stretch if is_linear else limits.angle)
        stiffest = self.max_stiffness(0.0)
        softest = min(max(SOFTEST * stiffest, effort / reach), stiffest)
        return min(softest, self.run.start.gains(self.axis)[0])

    def check(self, stiffness: float, damping: float) -> None:
        """Refuses gains that the device does not allow.

        Raises:
            CommandError: The message names the excessive value and the bound.
        """
        (unit, damper), prefix = UNITS[self.axis], PREFIX[self.axis]
        least = self.min_stiffness
        if stiffness < least * (1.0 - 1e-9):
            raise CommandError(
                f"{prefix}stiffness is {stiffness:g} {unit}; below {least:.4g} {unit} a hand no "
                "longer feels where the tool is, or the run stops before the force is full"
            )
        needed = self.needed(stiffness, damping)
        steps = self.steps(self.run.start.with_axis(self.axis, stiffness, damping))
        if steps is not None and needed == math.inf:
            has = f"{steps.available:.3g} N" if steps.available else "none"
            raise CommandError(
                f"stiffness {stiffness:g} {unit} with damping {damping:g} {damper} needs "
                f"{steps.needed:.3g} N of friction for the encoder's steps of "
                f"{format_si(steps.resolution or 0.0, 'm')}; the device has {has}"
            )
        if not needed <= self.damping * (1.0 + 1e-9):
            raise CommandError(
                f"{prefix}stiffness {stiffness:g} {unit} with {prefix}damping {damping:g} {damper} "
                f"needs a device of {needed:.4g} {damper}, and this one has {self.damping:.4g}"
            )


def _largest(most: float, needed: Callable[[float], float], limit: float) -> float:
    """Returns the largest argument in [0, most] whose requirement stays below a limit."""
    low, high = 0.0, most
    if not needed(low + 1e-9 * most) <= limit:
        return 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needed(middle) <= limit else (low, middle)
    return low


@dataclass(frozen=True, kw_only=True)
class CouplingLimits:
    """Limits of stiffness and damping on a device, in translation and rotation.

    Attributes:
        loop: Loop of the run.
        start: Requested coupling at the start of the run.
        limits: Limits of the run.
    """

    loop: LoopSetting
    start: Coupling
    limits: Limits

    @property
    def method(self) -> Method:
        """The rendering method."""
        return self.loop.method

    @cached_property
    def translation(self) -> AxisCouplingLimits:
        """Limits in translation."""
        return AxisCouplingLimits("translation", self)

    @cached_property
    def rotation(self) -> AxisCouplingLimits | None:
        """Limits in rotation; None for a device without torque."""
        return AxisCouplingLimits("rotation", self) if self.loop.info.turns else None

    @property
    def spans(self) -> tuple[AxisCouplingLimits, ...]:
        """Limits of the available kinds of axis."""
        return (self.translation, *(() if self.rotation is None else (self.rotation,)))

    def requested(self, command: Couple, now: Coupling) -> Coupling:
        """Returns the requested coupling after a command; omitted gains keep their values."""
        requested = now.with_axis("translation", command.stiffness, command.damping)
        stiffness, damping = command.rotational_stiffness, command.rotational_damping
        if self.rotation is None or stiffness is None or damping is None:
            return requested
        return requested.with_axis("rotation", stiffness, damping)

    def law(self, requested: Coupling) -> Coupling:
        """Returns the law's coupling for a requested one."""
        return self.loop.requesting(requested).law

    def reason(self) -> str:
        """Returns the reason of the slider limits, in a sentence."""
        info = self.loop.info
        is_known = info.damping and (info.rotational_damping or not info.turns)
        known = "" if is_known else " (assumed; it is unknown)"
        dampings = " and ".join(f"{span.damping:.3g} {UNITS[span.axis][1]}" for span in self.spans)
        if info.is_prescribed:
            return f"They end where a device with a damping of {dampings} would just suffice."
        steps = self.translation.steps(self.start)
        of_steps = ""
        if steps is not None:
            step = format_si(steps.resolution or 0.0, "m")
            of_steps = (
                f", or its friction of {format_si(steps.available, 'N')} for its steps of {step}"
                if steps.available
                else f", and where its steps of {step} would shake it more than at the start: "
                "without friction they shake any coupling"
            )
        return (
            f"They end where the device's damping of {dampings}{known} just suffices{of_steps}. "
            "Beyond, the coupling could push the hand by itself."
        )

    def check(self, command: Couple) -> None:
        """Refuses gains that the device does not allow.

        Raises:
            CommandError: The message names the excessive value and the bound.
        """
        if not self.method.has_law:
            raise CommandError(
                f"method '{self.method.name}' has no coupling law to change during a run"
            )
        self.translation.check(command.stiffness, command.damping)
        stiffness, damping = command.rotational_stiffness, command.rotational_damping
        if stiffness is None or damping is None:
            return
        if self.rotation is None:
            raise CommandError(
                f"device '{self.loop.info.name}' feels no torque; its coupling's rotation stays as "
                "it is"
            )
        self.rotation.check(stiffness, damping)


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


def concerns(event: Mapping[str, Any], parameters: RunParameters) -> bool:
    """Returns True if an event is of a hand: it names the hand's grip, or none."""
    return bool(event.get("grip", parameters.grip) == parameters.grip)


def coupling_in(event: Mapping[str, Any], parameters: RunParameters) -> Coupling:
    """Returns the coupling of an event ``coupling``.

    Raises:
        RecordingError: It has none, the run has no coupling law, or its duration is wrong.
    """
    tick = event.get("tick")
    try:
        coupling = Coupling(**{each.name: event.get(each.name) for each in fields(Coupling)})  # type: ignore[arg-type] # what is none is refused there
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


def pose_in(event: Mapping[str, Any]) -> tuple[float, ...] | None:
    """Returns where an event ``reset`` puts another program's tool; None for a reset of a scene.

    Raises:
        RecordingError: The pose is damaged.
    """
    pose = event.get("pose")
    if pose is None:
        return None
    numbers = tuple(pose) if isinstance(pose, list | tuple) else ()
    is_pose = len(numbers) == 7 and all(is_number(each) for each in numbers)
    if not is_pose or abs(math.hypot(*numbers[3:]) - 1.0) > 1e-9:
        raise RecordingError(
            f"event 'reset' at tick {event.get('tick')!r} is damaged: its pose is {shown(pose)}"
        )
    return numbers


class EventApplier:
    """Applies events of commands and inputs to a live or simulated run.

    The loop applies the event that it records, so live run and re-simulation share one path.
    ``hands`` holds kernel and parameters of each hand. ``start`` is the scene's state at the start
    (``description.start_state``), as bytes. A scene slower than the loop takes part in a change
    before its next step.
    """

    def __init__(
        self,
        hands: Sequence[tuple[BoundKernel, RunParameters]],
        data: mujoco.MjData,
        method: Method,
        start: bytes,
        slow: SlowScene | PostedScene | None = None,
    ) -> None:
        self._hands, self._data, self._slow = tuple(hands), data, slow
        self._method, self._start = method, start

    @property
    def period(self) -> float:
        """Time in s between two ticks, for all hands."""
        return self._hands[0][1].period

    def apply(self, event: Mapping[str, Any]) -> None:
        """Applies an event of ``CHANGES`` before the tick that it names.

        Raises:
            RecordingError: The event is damaged.
        """
        kind = event.get("event")
        if kind == "reset":
            if not self._method.has_coupling:
                raise RecordingError(f"event 'reset': method '{self._method.name}' has no reset")
            pose = pose_in(event)
            [(bound, parameters), *_] = self._hands
            if (pose is None) == (parameters.credit > 0.0):
                raise RecordingError("event 'reset' is damaged: it belongs to another kind of run")
            if pose is None:
                self._reset()
            else:
                bound.handle_reset(pose)
            return
        if kind not in CHANGES:
            return
        hands = [hand for hand in self._hands if concerns(event, hand[1])]
        if len(hands) != 1:
            raise RecordingError(
                f"event '{kind}' at tick {event.get('tick')!r} is of grip "
                f"{shown(event.get('grip'))}; it must be one of "
                f"{choices(parameters.grip for _, parameters in self._hands)}"
            )
        [(bound, parameters)] = hands
        if kind == "switch":
            bound.command(bits_in(event))
            return
        coupling = coupling_in(event, parameters)
        gains = self._method.gains(coupling, parameters.timestep)
        goal = replace(parameters, coupling=coupling)
        bound.tune(goal, gains, tuning_ticks(parameters.period))
        if self._slow is not None:
            of_scene = goal.of_scene
            tune = partial(self._slow.bound.tune, of_scene, gains)
            self._slow.queue_change(partial(tune, tuning_ticks(of_scene.period)))

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
        for bound, _ in self._hands:
            bound.handle_reset()
            if self._slow is not None:
                take_scene_works(bound.state["energy"], self._slow.bound.state["energy"])

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
"""Shortest time in s of the run between two commands. A dragged slider looks smooth at 20 per
second; each command costs the loop about 20 µs, and a flood must not become a load."""

RESET_INTERVAL = 1.0
"""Shortest time in s of the run between two resets. The force fades before each and rises after
it. With a shorter interval, resets could follow each other without any force between them."""


class CommandQueue:
    """Queue of commands between their senders and the loop; every command in it is validated.

    Any thread may ``offer``; only the loop takes. The loop tests whether ``waiting`` is empty,
    which needs no lock and no allocation, and pops from its left end, which the interpreter does
    atomically. The queue holds at most ``MAX_WAITING`` commands.

    Args:
        limits: Limits of the coupling on each hand's device, by the hand's grip.
        is_recorded: True for a recorded run, which can be marked.
        is_posted: True if another program steps the scene, which it alone can reset.
        now: Returns the time in s of the run; it never runs backwards.

    Attributes:
        limits: Limits of the coupling on each hand's device, by the hand's grip.
        now: Returns the time in s; a test may replace it.
        waiting: Commands in order, each with its origin.
    """

    def __init__(
        self,
        limits: Mapping[str, CouplingLimits],
        *,
        is_recorded: bool = True,
        is_posted: bool = False,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.limits, self.now = dict(limits), now
        self.waiting: deque[tuple[Command | Repeat | Hold, str]] = deque(maxlen=MAX_WAITING)
        self._is_recorded, self._is_posted = is_recorded, is_posted
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
        for limits in self.limits.values():
            if limits.method.has_law:
                for span in limits.spans:
                    span.needed(span.min_stiffness, 0.0)

    def grips_of(self, command: Couple | Switch) -> list[str]:
        """Returns the grips of the hands that a command is for.

        Raises:
            CommandError: No hand holds its grip, or a coupling is for several hands.
        """
        grips = list(self.limits)
        if command.grip is None and (len(grips) == 1 or isinstance(command, Switch)):
            return grips
        if command.grip not in grips:
            named = "names no grip" if command.grip is None else f"has grip {shown(command.grip)}"
            raise CommandError(f"the command {named}; it must be one of {choices(grips)}")
        return [command.grip]

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
        method = next(iter(self.limits.values())).method
        if isinstance(command, Couple | Switch):
            grips = self.grips_of(command)
            if isinstance(command, Couple):
                self.limits[grips[0]].check(command)
        elif isinstance(command, Reset) and self._is_posted:
            raise CommandError("another program steps the scene; reset it there")
        elif isinstance(command, Reset) and not method.has_coupling:
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
        requested: Requested coupling of each hand at the end of its present change, by grip.
        later: Postponed resets: tick and origin.
    """

    def __init__(
        self, queue: CommandQueue, applier: EventApplier, fade_ticks: int, note: NoteEvent
    ) -> None:
        self.requested = {grip: limits.start for grip, limits in queue.limits.items()}
        self.later: deque[tuple[int, str]] = deque()
        self._queue, self._applier, self._fade_ticks, self._note = queue, applier, fade_ticks, note
        self._has_force = dict.fromkeys(queue.limits, True)
        self._is_clutched, self._is_held = dict.fromkeys(queue.limits, False), False

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
            [grip] = self._queue.grips_of(command)
            limits = self._queue.limits[grip]
            requested = self.requested[grip] = limits.requested(command, self.requested[grip])
            law = asdict(limits.law(requested))
            ticks = tuning_ticks(self._applier.period)
            named = self._named(grip)
            self._apply({"event": "coupling", **law, "ticks": ticks, "by": by, **named})
        elif isinstance(command, Switch):
            grips = self._queue.grips_of(command)
            for grip in grips:
                if command.force is not None:
                    self._has_force[grip] = command.force
                if command.clutch is not None:
                    self._is_clutched[grip] = command.clutch
            self._switch(by, grips)
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

    def _named(self, grip: str) -> dict[str, str]:
        """Returns what names one of several hands in an event; nothing for the only hand."""
        return {"grip": grip} if len(self.requested) > 1 else {}

    def _switch(
        self, by: str, grips: Iterable[str] | None = None, *, is_fading: bool = False
    ) -> None:
        for grip in self.requested if grips is None else grips:
            force = self._has_force[grip] and not is_fading and not self._is_held
            clutch = self._is_clutched[grip]
            event = {"event": "switch", "force": force, "clutch": clutch, "by": by}
            # a force that fades for a moment only was not switched off by a command
            self._apply(event | self._named(grip) | ({"fading": True} if is_fading else {}))

    def _apply(self, event: dict[str, Any]) -> None:
        self._applier.apply(event)
        details = dict(event)
        self._note(details.pop("event"), **details)
