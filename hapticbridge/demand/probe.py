"""Probe of a device before its force: direction and delay of each motor.

Along each axis in turn a small force F = ±A is sent, and the device is read. Hand and handle are
passive, so that a motor that is right, and acts a time l after the write, moves them by

    F(t − l) = m a + c v + k (x − x_0),    m, c, k >= 0

with m in kg, c in N s/m, k in N/m, or their like in rotation. Integrated twice,

    ∬F(t − l) = m x + c ∫x + k ∬x + c_0 + c_1 t + c_2 t²

it is linear in m, c and k and needs no derivative of the samples; c_0 to c_2 hold what the hand did
before. It is fitted with m, c, k >= 0 for each l up to ``MAX_DELAY``, for −F as for F, on each axis
that moved. The misfit E is the share of (∬F)² that a fit leaves, without unit. A hypothesis (this
axis with this sign, or a delay beyond the stated one) holds if its E is at most ``MISFIT`` and that
of every other is ``RATIO`` times as large. A wrong direction holds only if the right one has at
least ``EXCLUDED`` for each delay up to ``PULSE`` beyond the stated one: a passive hand that is
stiffer or heavier in some directions moves sideways, too. A wrong direction or a delay must be
found ``TIMES`` times, with forces to and fro: a hand that moves by itself may look so by chance.

The signs have neither mean nor trend, so that a mass stands afterwards where it was, and a hand
that shakes does not move like this.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import Clock
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.loop_setting import delay_ticks, device_period
from hapticbridge.device.base import AXES, USUAL_FORCE_LIMIT, USUAL_TORQUE_LIMIT, DeviceInfo
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.parameters import ROUNDING
from hapticbridge.kernel.record import TickFlag
from hapticbridge.units import format_si

Array = NDArray[np.float64]

SIGNS = tuple(1.0 if sign == "+" else -1.0 for sign in "+---++-+++--")
"""Signs of the force, one after another."""

LEAD, PULSE, MAX_DELAY = 0.01, 0.008, 0.05
"""Times in s before the first force, of each sign, and after the last one; the third is also the
longest delay that is seen. Longer pulses move the hand further, shorter ones too little."""

SLOWEST = 0.004
"""Longest time in s between two samples of a device that can be probed: two for each sign. After
twice this time without a sample the force goes on by the clock."""

LEVELS = 0.03, 0.1
"""A as shares of the force limit, or of the usual limit if that is more; without unit. The second
is sent if the first tells nothing, because of friction, a coarse encoder or a firm hand."""

FARTHEST = 4e-3, 0.06
"""Way in m and angle in rad at which the force ends early. 0.3 N move 20 g by 4 mm."""

TREMOR = 5e-4, 8e-3
"""Way in m and angle in rad that a hand goes by itself. A wrong direction that is found in less of
a motion is looked at with the larger force."""

ROUNDED = 1e-12
"""Way in m or rad to which equal samples round; no unit's position has steps so fine."""

MISFIT, RATIO = 0.05, 5.0
"""Largest E of a hypothesis that holds, and least ratio of the others' to it, without unit."""

EXCLUDED = 0.15
"""Least E of the right direction where a wrong one holds, without unit. With 0.05, hands 30 times
as stiff or heavy in one direction as in another are refused in 7 %; with 0.3 fewer reversed axes
are found."""

MOVED, OWN_MOVED = 0.5, 0.1
"""Least motion of another axis that may be the one that was pushed, and of the pushed one itself,
as shares of the largest one. Motion left from an earlier push is a few percent."""

DELAY_STEP, LEAST_DELAY = 2.5e-4, 5e-4
"""Step in s of the delays tried, and least excess in s over the stated one that is a finding."""

ALIKE = 1.5e-3
"""Largest difference in s of two delays that are alike."""

TIMES, PUSHES = 3, 6
"""Number of like findings that count, and most pushes along an axis. An axis without a finding by
then is unknown. With two findings, 1 % of the hands that move meanwhile were refused."""

EVENT = "probe"
"""Event of a recording with what a probe has found of a hand's device."""


class Direction(StrEnum):
    """Direction in which a device moves under a force along one of its axes."""

    RIGHT = "right"
    REVERSED = "reversed"
    EXCHANGED = "exchanged"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer of a device to a force along one axis.

    Attributes:
        axis: Name of the axis of the force.
        direction: Direction of the motion.
        moved: Name of the axis that moved; empty if it is unknown.
        delay: Time in s from a write to its effect in a sample; of a right direction only if it is
            beyond the stated one, else 0.
        is_still: True if the position along this axis was the same in each sample.
    """

    axis: str
    direction: Direction = Direction.UNKNOWN
    moved: str = ""
    delay: float = 0.0
    is_still: bool = False

    @property
    def is_wrong(self) -> bool:
        """True if the axis is reversed or exchanged."""
        return self.direction in (Direction.REVERSED, Direction.EXCHANGED)

    def confirms(self, other: Answer) -> bool:
        """Returns True if it has the direction and the delay of another one."""
        is_same = self.direction == other.direction and self.moved == other.moved
        return is_same and abs(self.delay - other.delay) <= ALIKE


@dataclass(frozen=True, slots=True)
class Probed:
    """Result of the probe of one hand's device.

    Attributes:
        answers: Answer of each axis.
        skipped: Reason for which it was not probed, as a clause; empty if it was.
    """

    answers: tuple[Answer, ...] = ()
    skipped: str = ""

    @property
    def delay(self) -> float:
        """Largest delay in s beyond the stated one; 0 without one."""
        return max((each.delay for each in self.answers if not each.is_wrong), default=0.0)

    def axes(self, direction: Direction) -> str:
        """Names of the axes with a direction."""
        names = [each.axis for each in self.answers if each.direction == direction]
        return ", ".join(names)

    def details(self, info: DeviceInfo, period: float) -> dict[str, object]:
        """Returns the details of the event, with the period T of the loop in s."""
        directions = {each.axis: each.direction.value for each in self.answers}
        return {"axes": directions, "added_delay": self.added_delay(info, period)}

    def added_delay(self, info: DeviceInfo, period: float) -> float:
        """Returns by how much in s the delay is longer than the one that is judged anyway."""
        return max(self.delay - (delay_ticks(info, period) or 0) * period, 0.0)

    @property
    def words(self) -> str:
        """Findings in a line."""
        if self.skipped:
            return f"not probed: {self.skipped}"
        right, still = self.axes(Direction.RIGHT), [a.axis for a in self.answers if a.is_still]
        others = (a for a in self.answers if a.direction == Direction.UNKNOWN and not a.is_still)
        unknown = ", ".join(a.axis for a in others)
        texts = [f"{right} answered the right way"] if right else []
        if still:
            each = f"the position{'s' if len(still) > 1 else ''} of {', '.join(still)}"
            texts.append(f"{each} never changed (sensor, cable, axis or a firm hand)")
        texts += [f"{unknown} gave no clear answer"] if unknown else []
        if self.delay:
            texts.append(f"the force acts {format_si(self.delay, 's')} after the sample")
        return ", ".join(texts)

    def refuse_wrong_axes(self, info: DeviceInfo) -> None:
        """Refuses a device that did not move as it was pushed.

        Raises:
            DeviceError: The message names the axis and the remedy.
        """
        for each in self.answers:
            if not each.is_wrong:
                continue
            way = "backwards" if each.direction == Direction.REVERSED else f"along {each.moved}"
            raise DeviceError(
                f"a small force along {each.axis} moved the device '{info.name}' {way}: its axis "
                f"{each.axis} is {each.direction}; correct it by the device's option 'reverse', or "
                "by the order and signs of its axes in the driver or firmware"
            )


@dataclass(frozen=True, slots=True)
class ProbedHand:
    """Device of a hand as the probe needs it.

    Attributes:
        info: Its data sheet.
        limits: Limits of the run.
        period: T of the loop in s.
        has_dead_man: True if a button must be held for any force.
    """

    info: DeviceInfo
    limits: Limits
    period: float
    has_dead_man: bool = False

    @property
    def obstacle(self) -> str:
        """Reason for which it cannot be probed, as a clause; empty if it can."""
        if self.has_dead_man:
            return "its force needs a button"
        own = device_period(self.info, self.period)
        if own <= SLOWEST * (1.0 + ROUNDING):
            return ""
        return (
            f"it gives a sample in {format_si(own, 's')}, and a probe needs one in "
            f"{format_si(SLOWEST, 's')}"
        )

    def force(self, axis: int, level: int) -> float:
        """Returns A in N or N m, half of the limit at most; 0 if it has no such axis."""
        if AXES[axis] not in self.info.axes or level < 0 or self.obstacle:
            return 0.0
        limit, usual = (
            (self.limits.force, USUAL_FORCE_LIMIT)
            if axis < 3
            else (self.limits.torque, USUAL_TORQUE_LIMIT)
        )
        return min(LEVELS[level] * max(limit, usual), 0.5 * limit)


class Port(Protocol):
    """Devices of all hands."""

    def read(self, sample: NDArray[np.void]) -> Sequence[int]:
        """Reads the newest sample of each; returns the flags of each."""

    def write(self, wrench: Array) -> None:
        """Commands a wrench to each, (n, 6)."""


@dataclass(slots=True)
class Push:
    """Force along one axis of a hand's device, and the motion that answered.

    Attributes:
        force: A in N or N m.
        axis: Number of the axis.
        times: Time of each sample in s.
        places: Way in m, or angle in rad, along the three axes of its kind.
        changes: Time of each change of the force in s, and the change in N or N m.
        present: Force now in N or N m.
        is_far: True once the device went too far.
    """

    force: float
    axis: int
    times: list[float] = field(default_factory=list)
    places: list[Sequence[float]] = field(default_factory=list)
    changes: list[tuple[float, float]] = field(default_factory=list)
    present: float = 0.0
    is_far: bool = False

    def next_force(self, time: float) -> float:
        """Returns the force at a time in s."""
        number = int((time - LEAD) // PULSE)
        is_far = self.places and max(map(abs, self.places[-1])) > FARTHEST[self.axis // 3]
        self.is_far = self.is_far or bool(is_far)
        is_on = 0 <= number < len(SIGNS) and not self.is_far
        force = self.force * SIGNS[number] if is_on else 0.0
        if force != self.present:
            self.changes.append((time, force - self.present))
            self.present = force
        return force

    @property
    def way(self) -> float:
        """Longest way in m, or angle in rad, from the start."""
        return float(np.abs(self.places).max()) if self.places else 0.0

    @property
    def _is_still(self) -> bool:
        own = [place[self.axis % 3] for place in self.places]
        return bool(own) and max(own) - min(own) <= ROUNDED

    def answer(self, hand: ProbedHand) -> Answer:
        """Judges the motion."""
        own = self.axis % 3
        unknown = Answer(AXES[self.axis], is_still=self._is_still)
        first = self.axis - own
        if len(self.times) < 3 * len(SIGNS) or not self.changes:
            return unknown
        times, places = np.array(self.times), np.array(self.places)
        delays = np.arange(0.0, MAX_DELAY, DELAY_STEP)
        at, change = np.array(self.changes).T
        since = np.maximum(times[:, None, None] - at - delays[:, None], 0.0)
        twice = 0.5 * since**2 @ change  # ∬F, a column for each delay
        drift = np.linalg.qr(np.vander(times, 3))[0]
        twice -= drift @ (drift.T @ twice)
        sizes = np.linalg.norm(places - drift @ (drift.T @ places), axis=0)
        misfits = {
            (i, sign): _misfits(times, places[:, i], sign * twice, drift)
            for i in range(3)
            if sizes[i] >= (OWN_MOVED if i == own else MOVED) * sizes.max() > 0.0
            for sign in (1.0, -1.0)
        }
        ordered = sorted((each.min(), key) for key, each in misfits.items())
        if not ordered or not _holds(ordered[0][0], ordered[1][0]):
            return unknown
        least, (i, sign) = ordered[0]
        each, moved = misfits[i, sign], AXES[first + i]
        delay, stated = float(delays[each.argmin()]), hand.info.delay or 0.0
        if (i, sign) != (own, 1.0):
            is_soon = delays <= stated + PULSE
            if (own, 1.0) in misfits and misfits[own, 1.0][is_soon].min() <= EXCLUDED:
                return unknown
            direction = Direction.EXCHANGED if i != own else Direction.REVERSED
            return Answer(AXES[self.axis], direction, moved, delay)
        is_beyond = delays >= stated + LEAST_DELAY
        is_found = is_beyond.any() and _holds(least, each[~is_beyond].min())
        return Answer(AXES[self.axis], Direction.RIGHT, moved, delay if is_found else 0.0)


def _holds(misfit: float, other: float) -> bool:
    return misfit <= MISFIT and other >= RATIO * misfit


def _misfits(times: Array, place: Array, twice: Array, drift: Array) -> Array:
    """Returns E for each column of ∬F, with x, its integrals and ∬F free of drift."""
    from scipy.optimize import nnls  # noqa: PLC0415 - 0.2 s, and only a probe needs it

    once = _integral(times, place)
    columns = np.stack([place, once, _integral(times, once)], axis=1)
    columns -= drift @ (drift.T @ columns)
    columns /= np.linalg.norm(columns, axis=0)
    basis, triangle = np.linalg.qr(columns)
    parts, squares = basis.T @ twice, np.sum(twice * twice, axis=0)
    left = [nnls(triangle, part)[1] ** 2 - part @ part for part in parts.T]
    return np.asarray(np.maximum(1.0 + np.array(left) / squares, 0.0))


def _integral(times: Array, values: Array) -> Array:
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times)
    return np.concatenate([[0.0], np.cumsum(steps)])


def probe_devices(
    port: Port,
    sample: NDArray[np.void],
    hands: Sequence[ProbedHand],
    clock: Clock,
    is_over: Callable[[], object] = lambda: False,
) -> list[Probed]:
    """Probes the devices of all hands together, up to the first wrong axis; ends with zero force.

    Args:
        port: The started devices.
        sample: ``SAMPLE_DTYPE``, one per hand; receives the newest samples.
        hands: Their data sheets and limits.
        clock: A started clock, whose periods pace it.
        is_over: Returns True if the run was stopped meanwhile; the probe then ends.
    """
    answers: list[list[Answer]] = [[] for _ in hands]
    for axis in range(len(AXES)):
        if is_over() or any(each.is_wrong for own in answers for each in own):
            break
        levels = {i: 0 for i, each in enumerate(hands) if each.force(axis, 0) > 0.0}
        doubted: dict[int, list[Answer]] = {}
        for _ in range(PUSHES):
            if not levels or is_over():
                break
            pushes = [
                Push(hand.force(axis, levels.get(i, -1)) * (-1.0) ** len(doubted.get(i, ())), axis)
                for i, hand in enumerate(hands)
            ]
            _push(port, sample, pushes, clock)
            for i, level in tuple(levels.items()):
                answer, is_last = pushes[i].answer(hands[i]), level + 1 == len(LEVELS)
                is_small = answer.is_wrong and pushes[i].way < TREMOR[axis // 3]
                alike = [each for each in doubted.get(i, ()) if answer.confirms(each)]
                is_known = len(alike) + 1 == TIMES
                if not is_last and (is_small or answer.direction == Direction.UNKNOWN):
                    levels[i] = level + 1
                elif (answer.is_wrong or answer.delay) and not is_known:
                    doubted.setdefault(i, []).append(answer)
                else:
                    answers[i].append(answer)
                    del levels[i]
        for i in levels:
            answers[i].append(Answer(AXES[axis]))
    return [Probed(tuple(own), each.obstacle) for own, each in zip(answers, hands, strict=True)]


def _push(port: Port, sample: NDArray[np.void], pushes: Sequence[Push], clock: Clock) -> None:
    """Sends the forces, and notes the samples."""
    wrench, begin = np.zeros((len(pushes), 6)), clock.now()
    starts: dict[int, tuple[Array, Array]] = {}
    time = 0.0
    while time < LEAD + len(SIGNS) * PULSE + MAX_DELAY:
        clock.wait()
        flags = port.read(sample)
        time = 1e-9 * (clock.now() - begin)
        for i, push in enumerate(pushes):
            place, turn = sample["position"][i], sample["quaternion"][i]
            start = starts.setdefault(i, (place.copy(), turn.copy()))
            is_new = not flags[i] & int(TickFlag.STALE_SAMPLE)
            if is_new:
                is_linear = push.axis < 3
                way = place - start[0] if is_linear else _rotation(start[1], turn)
                push.times.append(time)
                push.places.append(tuple(way))
            if is_new or not push.times or time > push.times[-1] + 2.0 * SLOWEST:
                # a force is as old as its sample, and not held back by the device
                wrench[i, push.axis] = push.next_force(time)
        port.write(wrench)


def _rotation(start: Array, end: Array) -> Array:
    """Returns the rotation vector from one orientation to another, in the world frame.

    The compiled one of ``kernel.pose`` would be loaded at its first call, within a push.
    """
    back, turn, vector = np.zeros(4), np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(back, start)
    mujoco.mju_mulQuat(turn, end, back)
    mujoco.mju_quat2Vel(vector, turn, 1.0)
    return vector
