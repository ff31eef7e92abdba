"""USB force-feedback sticks of the class PID: two axes, a constant force streamed to each."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    USUAL_SPEED_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_number,
    checked_period,
)
from hapticbridge.device.family import Driver, Notify, select_device
from hapticbridge.device.pid.reports import (
    DISABLE,
    ENABLE,
    FULL,
    LOADED,
    RESET,
    START,
    STOP,
    STOP_ALL,
    PidReports,
    forced_axes,
    has_force_feedback,
)
from hapticbridge.device.profile import profile_named, profile_of
from hapticbridge.device.transport.hid import CONTROLLERS, HidApi, HidLink, find, polling
from hapticbridge.device.transport.hid_descriptor import (
    INPUT,
    WIDEST,
    Field,
    Layout,
    Place,
    as_number,
    element,
    place_of,
    required,
)
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.watchdog import ForceOffGuardian, guard_device_node
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.record import SAMPLE_DTYPE, TickFlag

# The two constant-force effects by which a stick is pushed, and how they end by themselves.

ANGLES = (270.0, 180.0)
"""Degrees from north, clockwise, that the force of the x and y effect comes from: a positive one
pushes to the right, and away from the user. The standard's words; never tried on a real stick."""

LOADS, LOAD_MS = 60, 1
"""How often a device is asked what became of an effect, as often as Linux does, and how long is
waited in between, in ms."""

RESTART, LIFE = 0.02, 5
"""An effect is started anew every 20 ms and would end by itself after five times that: a host that
has died lets go within 0.1 s, and four restarts may be lost on the way."""

RESTART_REPORTS = 5
"""On a slow bus restarts come no oftener than every five reports per effect, so that they take at
most a fifth of it."""

SLOWEST_INTERVAL = 8e-3
"""In s, where the interval is unknown: old sticks take 125 reports a second."""


class Effects:
    """Creates an effect per axis, streams their forces, and keeps them alive.

    Args:
        link: Reports to the device, open.
        name: What errors call it.
        reports: Its reports.
        interval: Time in s that a report to it takes, None where unknown.

    Raises:
        DeviceError: The device has no room for two effects, or refuses them.
        DeviceLost: It is gone.
    """

    def __init__(
        self, link: HidLink, name: str, reports: PidReports, interval: float | None
    ) -> None:
        self._link, self._name, self._reports = link, name, reports
        count = len(ANGLES)
        slowest = RESTART_REPORTS * count * (interval or SLOWEST_INTERVAL)
        self._restart = max(RESTART, slowest)
        self.life = min(LIFE * self._restart, reports.longest())
        self._restart = min(self._restart, self.life / LIFE)
        self._require_room(count)
        for usage in (RESET, STOP_ALL, ENABLE):
            self._send(reports.control(usage))
        self._send(reports.full_gain())
        self._indices = [self._created() for _ in ANGLES]
        self._magnitudes = [reports.magnitude(index) for index in self._indices]
        self._starts = [reports.operate(index, START) for index in self._indices]
        self._sent: list[int | None] = [None] * count
        self._ticks = self._every = 0

    def start(self, period: float) -> None:
        """Gives the effects their direction and their life, and starts them without force.

        Args:
            period: The loop's, in s.
        """
        self._every, self._ticks = max(int(self._restart / period), 1), 0
        reports = self._reports
        # never shorter than a restart comes: a slow loop would drop its force between two ticks
        life = max(self.life, min(LIFE * period, reports.longest()))
        for index, angle, magnitude, start in zip(
            self._indices, ANGLES, self._magnitudes, self._starts, strict=True
        ):
            self._send(reports.set_effect(index, angle, life))
            self._send(magnitude.report(0))
            self._send(start)
        self._sent = [0] * len(ANGLES)

    def push(self, shares: Sequence[float]) -> None:
        """Sends the forces that have changed, and restarts the effects when it is time.

        Args:
            shares: Of full scale per axis, finite; beyond -1 to 1 it is full scale.
        """
        self._ticks += 1
        is_due = self._ticks >= self._every
        for axis, share in enumerate(shares):
            magnitude = self._magnitudes[axis]
            counts = round(min(max(share, -1.0), 1.0) * magnitude.full)
            # sent again with a restart, in case the one before was lost
            if is_due or counts != self._sent[axis]:
                self._link.write(magnitude.report(counts), axis)
                self._sent[axis] = counts
        if is_due:
            self._ticks = 0
            for axis, start in enumerate(self._starts):
                self._link.write(start, len(ANGLES) + axis)

    def farewell(self) -> tuple[bytes, ...]:
        """Returns what takes the force away, the effects too, and switches the motors off."""
        reports = self._reports
        said: list[bytes | None] = []
        for index, magnitude in zip(self._indices, self._magnitudes, strict=True):
            said += [magnitude.report(0), reports.operate(index, STOP)]
        said.append(reports.control(STOP_ALL))
        said += [reports.free(index) for index in self._indices]
        said.append(reports.control(DISABLE))
        return tuple(report for report in said if report is not None)

    def close(self) -> None:
        """Sends the ``farewell``."""
        for report in self.farewell():
            self._send(report)

    def _send(self, report: bytes | None) -> None:
        if report is not None:
            self._link.send(report)

    def _require_room(self, count: int) -> None:
        pool = self._reports.pool
        answer = self._link.requests.feature(*pool) if pool is not None else b""
        most = self._reports.most_effects(answer) if answer else None
        if most is not None and most < count:
            raise DeviceError(
                f"{self._name} plays {most} effect at a time; two are needed, one for each axis"
            )

    def _created(self) -> int:
        """Creates an effect in the device; returns its index."""
        requests = self._link.requests
        if not requests.set_feature(self._reports.create()):
            raise DeviceError(f"{self._name} refuses to create a constant force")
        for _ in range(LOADS):
            answer = requests.feature(*self._reports.load)
            status, index = self._reports.loaded(answer) if answer else (None, 0)
            if status == LOADED and index > 0:
                return index
            if status == FULL:
                raise DeviceError(
                    f"{self._name} has no room for another effect; unplug it and plug it in again, "
                    "or close the game that uses it"
                )
            self._link.wait(LOAD_MS)
        raise DeviceError(f"{self._name} does not create the constant force that it offers")


# What is known, stated and assumed of a force-feedback stick: its scales and its data sheet.

ASSUMED_NEWTONS = 10.0
"""Full scale in N that is assumed where nobody says it: more than an ordinary stick has, so that
what is asked for comes out weaker. A stronger one exists; only a force gauge tells."""

ASSUMED_TRAVEL = 0.1
"""In m from stop to stop, likewise: a grip some 12 cm above its pivot that turns by 24° to each
side."""

CHANGES = ("mass", "damping", "friction")
"""Numbers of the data sheet that the user may know."""

_AXES = ("x", "y")


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """What a stick's counts are in metres and newtons.

    Attributes:
        newtons: Force at full scale in N, > 0.
        travel: From stop to stop of each axis in m, > 0.
        signs: Of the force per axis, shape (2,), -1 where the firmware turns it round.
    """

    newtons: float
    travel: float
    signs: NDArray[np.float64]


def scale_of(
    options: Mapping[str, object], serial: str, model: str, tell: Notify
) -> tuple[Scale, dict[str, object]]:
    """Returns the scale, and what else of the options is for the data sheet.

    What the user says goes first, then the profile of the unit or its model (``force_limit``:
    newtons at full scale; ``workspace``: travel), then an assumption, of which the user is told.
    What a profile was measured with must not be changed: its b would be in other units than the
    force.

    Args:
        options: As given to ``open_device``.
        serial: The unit's.
        model: What the stick calls itself; the profile of another model is not taken.
        tell: Takes the sentence.

    Raises:
        DeviceError: A number is out of range, contradicts the profile, or states what nobody can
            know without the scale.
    """
    measured = _measured_with(options.get("profile"), serial, model)
    for name, value in measured.items():
        asked = options.get(name, value)
        if value is not None and asked != value:
            raise DeviceError(
                f"{name} = {asked!r}: the profile of this stick was measured with {value:g}, and "
                f"its damping holds for that alone; leave out {name}=, or add profile=none"
            )
    stated = {name: options.get(name, value) for name, value in measured.items()}
    changes = {name: options[name] for name in CHANGES if name in options}
    missing = [f"{name}=" for name, value in stated.items() if value is None]
    if changes and missing:
        raise DeviceError(
            f"{next(iter(changes))} is in newtons and metres, of which a stick knows nothing: say "
            f"{' and '.join(missing)} too"
        )
    if missing:
        tell(
            f"nobody says how strong or how wide this stick is: full scale is taken for "
            f"{ASSUMED_NEWTONS:g} N and its travel for {1e3 * ASSUMED_TRAVEL:g} mm where not "
            f"stated; {' and '.join(missing)} state it"
        )
    newtons, travel = (
        checked_number(name, assumed if value is None else value, unit, is_positive=True)
        for (name, value), assumed, unit in zip(
            stated.items(), (ASSUMED_NEWTONS, ASSUMED_TRAVEL), ("N", "m"), strict=True
        )
    )
    reverse = options.get("reverse", "")
    if reverse not in ("", "x", "y", "xy"):
        raise DeviceError(f"reverse = {reverse!r}: must be 'x', 'y' or 'xy', the axes to reverse")
    signs = np.array([-1.0 if axis in str(reverse) else 1.0 for axis in _AXES])
    return Scale(newtons, travel, signs), changes


def _measured_with(named: object, serial: str, model: str) -> dict[str, float | None]:
    """Returns the scale that a profile's numbers are in; None where it does not say."""
    profile = profile_of("pid", serial, model) if named is None else None
    if named not in (None, "none"):
        profile = profile_named(str(named))
    known = {} if profile is None else {k: q.value for k, q in profile.quantities.items()}
    newtons, workspace = known.get("force_limit"), known.get("workspace")
    return {
        "newtons": newtons if isinstance(newtons, float) else None,
        "travel": workspace[0] if isinstance(workspace, tuple) else None,
    }


def data_sheet(
    name: str,
    serial: str,
    scale: Scale,
    step: tuple[float, ...],
    intervals: tuple[float | None, float | None],
    known: dict[str, Any],
) -> DeviceInfo:
    """Makes a data sheet.

    Its rate is that of a force on both axes, two reports: the loop's period counts as no shorter in
    b >= KT/2 + B. Its delay is unknown, because no firmware says its own.

    Args:
        name: What the device is called.
        serial: Its serial number.
        scale: Newtons and metres.
        step: Least change of deflection per axis, of -1 to 1.
        intervals: Time per report from and to the device, in s; None where unknown.
        known: Of ``CHANGES``.

    Raises:
        DeviceError: A number is out of range.
    """
    asked, told = intervals
    period = None if told is None else max(asked or 0.0, len(_AXES) * told)
    values: dict[str, Any] = dict.fromkeys(CHANGES) | known
    return DeviceInfo(
        name=name,
        serial=serial,
        axes=_AXES,
        rotational_inertia=None,
        rotational_damping=None,
        resolution=0.5 * scale.travel * max(step),
        force_limit=scale.newtons,
        torque_limit=USUAL_TORQUE_LIMIT,
        speed_limit=USUAL_SPEED_LIMIT,
        rate=None if period is None else 1.0 / period,
        delay=None,
        is_prescribed=False,
        is_real=True,
        duration=None,
        **values,
    )


# Where a force-feedback stick stands: its X and Y axes and its buttons, found by usage.

X, Y = 0x00010030, 0x00010031
"""Usages of the axes on the page of generic desktop controls: to the right, and to the user."""

MOST_BUTTONS = 63
"""Buttons that are told apart, as many as a sample has bits for."""

_CONTROLLERS = {page << 16 | usage for page, usage in CONTROLLERS}
_BUTTON_PAGE = 9
"""Usage page of buttons."""


class Stick:
    """Takes input reports one by one.

    Args:
        layout: The device's reports.

    Attributes:
        deflection: To the right and towards the user, each -1 to 1.
        buttons: A bit each, the first one lowest.
        step: Least change of deflection that each axis can report.
        report: Number and length in bytes of the report with the X axis.

    Raises:
        DeviceError: It has no X or Y, or its force does not act on both.
    """

    def __init__(self, layout: Layout) -> None:
        # some have a mouse or a keyboard beside the stick, with an X and Y of their own
        fields = [
            field
            for field in layout.fields
            if field.kind == INPUT
            and field.size <= WIDEST
            and _CONTROLLERS.intersection(field.collections[:1])
        ]
        self._layout = layout
        self._axes = (
            required(place_of(fields, X), "an X axis"),
            required(place_of(fields, Y), "a Y axis"),
        )
        for place in self._axes:
            if place.field.minimum >= place.field.maximum:
                raise DeviceError("its axes have no range")
        if not {X, Y} <= forced_axes(layout):
            raise DeviceError(
                "its force does not act on both X and Y; it is no stick but a wheel or the like"
            )
        self._buttons = _buttons(fields)
        self._places = (*self._axes, *(place for _, place in self._buttons))
        self.step = tuple(2.0 / (p.field.maximum - p.field.minimum) for p in self._axes)
        number = self._axes[0].field.report
        self.report = number, layout.length(INPUT, number)
        self.deflection = [0.0, 0.0]
        self.buttons = 0

    def takes(self, report: bytes) -> bool:
        """Takes a report; returns whether it was one that says where an axis stands."""
        number = as_number(self._layout, report)
        came, bits = number & 0xFF, 8 * (len(report) + (not self._layout.is_numbered))
        mine = [place for place in self._places if place.field.report == came]
        if not mine or any(place.offset + place.field.size > bits for place in mine):
            return False  # none of ours, or cut short
        is_new = False
        for axis, place in enumerate(self._axes):
            if place.field.report == came:
                least, most = place.field.minimum, place.field.maximum
                value = min(max(place.read(number), least), most)
                self.deflection[axis] = (2 * value - least - most) / (most - least)
                is_new = True
        for bit, place in self._buttons:
            if place.field.report == came:
                pressed = place.read(number) != 0
                self.buttons = self.buttons & ~(1 << bit) | pressed << bit
        return is_new


def _buttons(fields: list[Field]) -> list[tuple[int, Place]]:
    """Returns the first buttons: which bit each one has in a sample, and where it lies."""
    found = []
    for field in fields:
        for index, usage in enumerate(field.usages[: field.count]):
            number = usage & 0xFFFF
            if usage >> 16 == _BUTTON_PAGE and field.is_variable and 0 < number <= MOST_BUTTONS:
                found.append((number - 1, element(field, index)))
    return found


LOOKS, LOOK_MS = 20, 10
"""At the start reports are waited for 20 times, up to 10 ms each: 0.2 s for a stick at rest that
says nothing, less for one that streams."""

STREAMING = 15
"""Of those, how many must bring a report from a stick that streams; one that speaks only when it is
moved brings none in a hand that keeps still. Taking the one for the other costs a flag, no more."""

SLOTS = 4
"""Kinds of report in the loop: force and restart, for each of two effects."""


class PidDevice:
    """A force-feedback stick, its two axes taken for x (to the right) and y (away from the user).

        p = travel/2 (X, −Y),   counts = full · F/newtons

    with X and Y the deflection, -1 to 1. Nothing in the standard says newtons or metres, so both
    are stated (``Scale``). If they are off by a factor, every force or every length is, and with
    them K, B and the b that ``identify`` measures: b >= KT/2 + B holds or fails all the same.

    Each axis has a constant-force effect of its own with a fixed direction, so a tick sends one
    short report per axis whose count has changed, at most two. One effect with a direction would
    need SetEffect (some 18 bytes) as soon as the angle changes, and SetConstantForce. Pushing a peg
    into its hole that is 1.62 reports a tick, against 1.44 with two effects; and between the two of
    a tick its force would point elsewhere, where that of two effects is on its way.

    A silent stick is one at rest: many report only what changes. A pulled plug is an error of the
    next call.

    Args:
        link: Reports to and from it, open, with ``SLOTS``.
        name: What errors call it.
        scale: Newtons, metres, and signs.
        known: ``mass``, ``damping``, ``friction`` of the data sheet, where the user knows them.
        intervals: How often it is asked and told, in s; None where that is unknown.
        serial: Its serial number.

    Attributes:
        info: Its data sheet.
        last_word: Takes the force away should this process die; None where no other process can,
            and the effects' own end (``Effects.life``) does it alone.
        workspace: Its travel along x, y and (it has none) z in m, as stated or assumed.

    Raises:
        DeviceError: It does not do what is needed; says what.
    """

    def __init__(
        self,
        link: HidLink,
        name: str,
        *,
        scale: Scale,
        known: Mapping[str, object] | None = None,
        intervals: tuple[float | None, float | None] = (None, None),
        serial: str = "",
    ) -> None:
        self._link, self._name = link, name
        self._is_open = True
        try:
            layout = Layout(link.requests.report_descriptor())
            reports = PidReports(layout)
            self._stick = Stick(layout)
        except DeviceError as error:
            raise DeviceError(f"{name} cannot be driven: {error}") from None
        self._effects = Effects(link, name, reports, intervals[1])
        self.info = data_sheet(name, serial, scale, self._stick.step, intervals, dict(known or {}))
        self.workspace = (scale.travel,) * 3
        self._reach = np.array([0.5, -0.5]) * scale.travel
        self._shares = scale.signs / scale.newtons
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._sample["quaternion"][:, 0] = 1.0
        self._has_started = self._streams = False
        self.last_word: ForceOffGuardian | None = None

    def start(self, period: float) -> NDArray[np.void]:
        """Starts the effects with no force, and finds out where the stick stands.

        Args:
            period: The loop's period in s, finite and > 0.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: The period is not, or the stick does not say where it stands.
            DeviceLost: It is gone.
        """
        checked_period(period)
        self._effects.start(period)
        self._link.take()
        came = sum(self._stick.takes(self._link.wait(LOOK_MS)) for _ in range(LOOKS))
        self._streams = came >= STREAMING
        if not came and not self._stick.takes(
            self._link.requests.input_report(*self._stick.report)
        ):
            raise DeviceError(f"{self._name} does not say where it stands; move it and start again")
        self._has_started = True
        self._fill()
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports where the stick stands; waits for nothing.

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Returns:
            0, or ``STALE_SAMPLE`` where a stick that streams has sent nothing since the last read.

        Raises:
            DeviceLost: The device is gone.
            DeviceError: It has not been started.
        """
        if not self._has_started:
            raise DeviceError(f"{self._name} is read before it was started")
        is_new = False
        for report in self._link.take():
            is_new |= self._stick.takes(report)
        if is_new:
            self._fill()
        sample[0] = self._sample[0]
        return 0 if is_new or not self._streams else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a force along x and y, each up to full scale.

        Args:
            wrench: Shape (6,): force in N, torque in N m, on the device, in the device's frame.

        Raises:
            DeviceLost: The device is gone.
            DeviceError: The force is not finite.
        """
        shares = self._shares * wrench[:2]
        if not np.isfinite(shares).all():
            raise DeviceError(f"{self._name}: a force that is not finite was not sent")
        self._effects.push(shares.tolist())

    def close(self) -> None:
        """Stops the effects, switches the motors off and lets the device go."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            with contextlib.suppress(DeviceLost):  # then the effects' own end does it
                self._effects.close()
        finally:
            self._link.close()
            if self.last_word is not None:
                self.last_word.close()

    def leave_last_word(self, path: str) -> None:
        """Has another process hold what takes the force away, where two may hold the node.

        Args:
            path: The device node.
        """
        self.last_word = guard_device_node(path, *self._effects.farewell())

    def _fill(self) -> None:
        sample = self._sample[0]
        sample["position"][:2] = self._reach * self._stick.deflection
        sample["buttons"] = self._stick.buttons


def open_pid(options: Mapping[str, object], tell: Notify, api: HidApi | None = None) -> PidDevice:
    """Finds and opens a force-feedback stick.

    Args:
        options: ``serial``, ``log``, ``newtons``, ``travel``, ``reverse``, ``profile``, and numbers
            of the data sheet, ``CHANGES``.
        tell: Told what had to be assumed.
        api: hidapi or what stands for it; its reports are then not sent by a thread.

    Raises:
        DeviceError: There is none, it cannot be opened, or it cannot do what is needed.
    """
    plugged = select_device(FAMILY, find(FAMILY, api), options.get("serial"))
    scale, known = scale_of(options, plugged.serial, str(plugged), tell)
    link = HidLink.open(
        plugged, api, is_overlapped=api is None, log=HexLog.asked(options), slots=SLOTS
    )
    try:
        device = PidDevice(
            link,
            str(plugged),
            scale=scale,
            known=known,
            intervals=polling(plugged.path) if api is None else (None, None),
            serial=plugged.serial,
        )
    except BaseException:
        link.close()
        raise
    if api is None:
        device.leave_last_word(plugged.path)
    return device


FAMILY = Driver(
    name="pid",
    about="USB force-feedback sticks of the class PID, any maker's",
    ids=(),
    transport="hid",
    axes="2",
    force="a share of full scale; newtons= says what that is",
    rate="125 Hz to 1 kHz, one axis at a time",
    on_stall="its effects end by themselves after 0.1 s, on a slow bus after up to 0.4 s",
    options=("serial", "log", "newtons", "travel", "reverse", "profile", *CHANGES),
    open=open_pid,
    recognises=has_force_feedback,
)
"""A class: recognised by its report descriptor, not by a list of products."""
