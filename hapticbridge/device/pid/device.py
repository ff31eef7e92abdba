"""USB force-feedback sticks (class PID): two axes, each with a streamed constant force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    DeviceInfo,
    checked_number,
    checked_period,
    released,
)
from hapticbridge.device.driver import Driver, Notify
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
from hapticbridge.device.transport.hid import CONTROLLERS, HidApi, HidLink, opened, polling
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
from hapticbridge.device.watchdog import ForceOffGuardian, guard_device_node
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

# Constant-force effects of a stick

ANGLES = (270.0, 180.0)
"""Origins of the forces of the x and y effect in degrees clockwise from north, as the standard
defines it. A positive force pushes to the right and away from the user. Not verified on
hardware."""

LOADS, LOAD_MS = 60, 1
"""Number of queries for the result of a created effect (as in Linux), and the pause between them in
ms."""

RESTART, LIFE = 0.02, 5
"""Time in s between restarts of an effect, and its duration in restarts. If the host dies, the
force ends within 0.1 s. Four restarts in a row may be lost without a gap in the force."""

RESTART_REPORTS = 5
"""Smallest number of reports per effect between restarts on a slow bus, so that restarts take at
most a fifth of it."""

SLOWEST_INTERVAL = 8e-3
"""Assumed time per report in s if it is unknown: old sticks accept 125 reports a second."""


class Effects:
    """One constant-force effect per axis, with streamed force and limited duration.

    Args:
        link: Open link to the device.
        name: Name of the device in messages.
        reports: Its reports.
        interval: Time in s per report to the device, None if unknown.

    Raises:
        DeviceError: The device has no room for two effects, or refuses them.
        DeviceLost: The device is gone.
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
        """Sets direction and duration of the effects and starts them without force."""
        self._every, self._ticks = max(int(self._restart / period), 1), 0
        reports = self._reports
        # at least LIFE periods: a slow loop would otherwise lose its force between two ticks
        life = max(self.life, min(LIFE * period, reports.longest()))
        for index, angle, magnitude, start in zip(
            self._indices, ANGLES, self._magnitudes, self._starts, strict=True
        ):
            self._send(reports.set_effect(index, angle, life))
            self._send(magnitude.report(0))
            self._send(start)
        self._sent = [0] * len(ANGLES)

    def push(self, shares: Sequence[float]) -> None:
        """Sends changed forces, and restarts the effects when due.

        Shares of full scale per axis must be finite and are clipped to [-1, 1].
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
        """Returns the reports that end the force, free the effects and disable the motors."""
        reports = self._reports
        last_reports: list[bytes | None] = []
        for index, magnitude in zip(self._indices, self._magnitudes, strict=True):
            last_reports += [magnitude.report(0), reports.operate(index, STOP)]
        last_reports.append(reports.control(STOP_ALL))
        last_reports += [reports.free(index) for index in self._indices]
        last_reports.append(reports.control(DISABLE))
        return tuple(report for report in last_reports if report is not None)

    def close(self) -> None:
        """Sends the reports of ``farewell``."""
        for report in self.farewell():
            self._send(report)

    def _send(self, report: bytes | None) -> None:
        if report is not None:
            self._link.send(report)

    def _require_room(self, count: int) -> None:
        pool = self._reports.pool
        answer = self._link.requests.feature(*pool) if pool is not None else b""
        most = self._reports.max_effects(answer) if answer else None
        if most is not None and most < count:
            raise DeviceError(
                f"{self._name} plays {most} effect at a time; two are needed, one per axis"
            )

    def _created(self) -> int:
        """Creates an effect in the device; returns its index."""
        requests = self._link.requests
        if not requests.set_feature(self._reports.create()):
            raise DeviceError(
                f"{self._name} refuses to create a constant force; unplug it and plug it in again"
            )
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


# Scale and data sheet of a force-feedback stick

ASSUMED_NEWTONS = 10.0
"""Assumed force at full scale in N: more than that of an ordinary stick, so that forces come out
weaker than commanded. Stronger sticks exist; only a force gauge shows the true value."""

ASSUMED_TRAVEL = 0.1
"""Assumed travel from stop to stop in m: a grip some 12 cm above its pivot that turns by 24° to
each side."""

CHANGES = ("mass", "damping", "friction")
"""Numbers of the data sheet that the user may state."""

_AXES = ("x", "y")


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """Scale of a stick's counts in metres and newtons.

    Attributes:
        newtons: Force at full scale in N, > 0.
        travel: Travel of each axis from stop to stop in m, > 0.
        signs: Sign of the force per axis, shape (2,); -1 if the firmware reverses it.
    """

    newtons: float
    travel: float
    signs: NDArray[np.float64]


def scale_of(
    options: Mapping[str, object], serial: str, model: str, notify: Notify
) -> tuple[Scale, dict[str, object]]:
    """Returns the scale, and the options for the data sheet.

    The user's options take precedence over the profile of the unit or its model (``force_limit``:
    newtons at full scale; ``workspace``: travel). Without either, a value is assumed and reported.
    The scale of a measured profile cannot be changed, because its b would then have other units
    than the force.

    Args:
        options: Options of ``open_device``.
        serial: Serial number of the unit.
        model: Name that the stick reports; the profile of another model is not used.
        notify: Receives the message about an assumed scale.

    Raises:
        DeviceError: A number is out of range, contradicts the profile, or is stated without the
            scale on which it depends.
    """
    measured = _measured_with(options.get("profile"), serial, model)
    for name, value in measured.items():
        requested = options.get(name, value)
        if value is not None and requested != value:
            raise DeviceError(
                f"{name} = {requested!r}: the profile of this stick was measured with {value:g}, "
                f"and its damping holds for that only; leave out {name}=, or add profile=none"
            )
    stated = {name: options.get(name, value) for name, value in measured.items()}
    changes = {name: options[name] for name in CHANGES if name in options}
    missing = [f"{name}=" for name, value in stated.items() if value is None]
    if changes and missing:
        raise DeviceError(
            f"{next(iter(changes))} is in newtons and metres, and a stick has no scale for them: "
            f"state {' and '.join(missing)} too"
        )
    if missing:
        notify(
            f"the strength or the travel of this stick is unknown: {ASSUMED_NEWTONS:g} N at full "
            f"scale and a travel of {1e3 * ASSUMED_TRAVEL:g} mm are assumed unless stated; "
            f"{' and '.join(missing)} state it"
        )
    newtons, travel = (
        checked_number(name, assumed if value is None else value, unit, is_positive=True)
        for (name, value), assumed, unit in zip(
            stated.items(), (ASSUMED_NEWTONS, ASSUMED_TRAVEL), ("N", "m"), strict=True
        )
    )
    reverse = options.get("reverse", "")
    if reverse not in ("", "x", "y", "xy"):
        raise DeviceError(
            f"reverse is {reverse!r}; it must be 'x', 'y' or 'xy', the axes to reverse"
        )
    signs = np.array([-1.0 if axis in str(reverse) else 1.0 for axis in _AXES])
    return Scale(newtons, travel, signs), changes


def _measured_with(named: object, serial: str, model: str) -> dict[str, float | None]:
    """Returns the scale of a profile's numbers; None for an unknown part."""
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
    """Returns the data sheet of a stick.

    Its rate is that of a force on both axes, two reports. In b >= KT/2 + B the loop's period counts
    as no shorter than that. Its delay is unknown, because no firmware reports it.

    Args:
        name: Name of the device.
        serial: Its serial number.
        scale: Newtons and metres.
        step: Smallest change of deflection per axis, of -1 to 1.
        intervals: Time per report from and to the device, in s; None if unknown.
        known: Numbers of ``CHANGES``.

    Raises:
        DeviceError: A number is out of range.
    """
    read_interval, write_interval = intervals
    period = (
        None if write_interval is None else max(read_interval or 0.0, len(_AXES) * write_interval)
    )
    return DeviceInfo(
        name=name,
        serial=serial,
        axes=_AXES,
        resolution=0.5 * scale.travel * max(step),
        force_limit=scale.newtons,
        rate=None if period is None else 1.0 / period,
        **known,
    )


# Axes and buttons of a force-feedback stick, found by usage

X, Y = 0x00010030, 0x00010031
"""Usages of the axes on the page of generic desktop controls: to the right, and towards the
user."""

MAX_BUTTONS = 63
"""Largest number of buttons: the bits of a sample."""

_CONTROLLERS = {page << 16 | usage for page, usage in CONTROLLERS}
_BUTTON_PAGE = 9
"""Usage page of buttons."""


_OF_A_WHEEL = "a device of one axis, such as a wheel, is '--device wheel' (on Linux)"


class Stick:
    """Decoder of a stick's input reports.

    Args:
        layout: Layout of the device's reports.

    Attributes:
        deflection: Deflection to the right and towards the user, each -1 to 1.
        buttons: One bit per button, the first one lowest.
        step: Smallest change of deflection per axis.
        report: Number and length in bytes of the report with the X axis.

    Raises:
        DeviceError: The stick has no X or Y, or its force does not act on both.
    """

    def __init__(self, layout: Layout) -> None:
        # some devices contain a mouse or a keyboard with an X and Y of its own
        fields = [
            field
            for field in layout.fields
            if field.kind == INPUT
            and field.size <= WIDEST
            and _CONTROLLERS.intersection(field.collections[:1])
        ]
        self._layout = layout
        x, y = required(place_of(fields, X), "an X axis"), place_of(fields, Y)
        if y is None:
            raise DeviceError(f"its reports lack a Y axis; {_OF_A_WHEEL}")
        self._axes = x, y
        for place in self._axes:
            if place.field.minimum >= place.field.maximum:
                raise DeviceError("its axes have no range")
        if not {X, Y} <= forced_axes(layout):
            raise DeviceError(f"its force does not act on both X and Y; {_OF_A_WHEEL}")
        self._buttons = _buttons(fields)
        self._places = (*self._axes, *(place for _, place in self._buttons))
        self.step = tuple(2.0 / (p.field.maximum - p.field.minimum) for p in self._axes)
        number = self._axes[0].field.report
        self.report = number, layout.length(INPUT, number)
        self.deflection = [0.0, 0.0]
        self.buttons = 0

    def takes(self, report: bytes) -> bool:
        """Decodes a report; returns whether it held the position of an axis."""
        number = as_number(self._layout, report)
        received, bits = number & 0xFF, 8 * (len(report) + (not self._layout.is_numbered))
        places = [place for place in self._places if place.field.report == received]
        if not places or any(place.offset + place.field.size > bits for place in places):
            return False  # an unrelated or truncated report
        is_new = False
        for axis, place in enumerate(self._axes):
            if place.field.report == received:
                least, most = place.field.minimum, place.field.maximum
                value = min(max(place.read(number), least), most)
                self.deflection[axis] = (2 * value - least - most) / (most - least)
                is_new = True
        for bit, place in self._buttons:
            if place.field.report == received:
                pressed = place.read(number) != 0
                self.buttons = self.buttons & ~(1 << bit) | pressed << bit
        return is_new


def _buttons(fields: list[Field]) -> list[tuple[int, Place]]:
    """Returns the first buttons: bit in a sample, and place in the report."""
    found = []
    for field in fields:
        for index, usage in enumerate(field.usages[: field.count]):
            number = usage & 0xFFFF
            if usage >> 16 == _BUTTON_PAGE and field.is_variable and 0 < number <= MAX_BUTTONS:
                found.append((number - 1, element(field, index)))
    return found


LOOKS, LOOK_MS = 20, 10
"""Number and length in ms of the waits for reports at the start: 0.2 s for a silent stick at rest,
less for one that streams."""

STREAMING = 15
"""Smallest number of these waits that bring a report from a streaming stick. A stick that reports
only changes brings none in a still hand. A wrong classification costs only a flag."""

SLOTS = 4
"""Kinds of report in the loop: force and restart, for each of two effects."""


class PidDevice:
    """Force-feedback stick; its axes are x (to the right) and y (away from the user).

        p = travel/2 (X, −Y),   counts = full · F/newtons

    X and Y are the deflection, -1 to 1. The standard has no units of force or length, so both
    scales are stated (``Scale``). If a scale is wrong by a factor, every force or length is, and
    with it K, B and the b that ``identify`` measures. The condition b >= KT/2 + B is not affected.

    Each axis has a constant-force effect of its own with a fixed direction. A tick therefore sends
    one short report per axis whose count has changed, at most two. A single effect with a direction
    would need SetEffect (some 18 bytes) at each change of angle, and SetConstantForce. Pushing a
    peg into its hole that takes 1.62 reports a tick, compared to 1.44 with two effects. Between its
    two reports the force would also point in a wrong direction.

    A silent stick is at rest, because many sticks report only changes. An unplugged stick raises an
    error at the next call.

    Args:
        link: Open link for its reports, with ``SLOTS``.
        name: Name of the device in messages.
        scale: Newtons, metres, and signs.
        known: ``mass``, ``damping``, ``friction`` of the data sheet, as stated by the user.
        intervals: Polling intervals for reports from and to the device in s; None if unknown.
        serial: Its serial number.

    Attributes:
        info: Its data sheet.
        last_word: Ends the force if this process dies or hangs. None if no second process can open
            the node; then only the effects' duration (``Effects.life``) ends it.
        workspace: Travel along x, y and z in m, as stated or assumed (it has no z).

    Raises:
        DeviceError: The stick lacks a required capability; the message names it.
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
        """Starts the effects without force, and reads the stick's position.

        Raises:
            DeviceError: The period is not valid, or the stick does not report its position.
            DeviceLost: The device is gone.
        """
        checked_period(period)
        self._effects.start(period)
        self._link.take()
        received = sum(self._stick.takes(self._link.wait(LOOK_MS)) for _ in range(LOOKS))
        self._streams = received >= STREAMING
        if not received and not self._stick.takes(
            self._link.requests.input_report(*self._stick.report)
        ):
            raise DeviceError(f"{self._name} does not report its position; move it and start again")
        self._has_started = True
        if self.last_word is not None:
            self.last_word.expect(period)
        self._fill()
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the stick's position without waiting.

        The sample is stale only if a streaming stick has sent nothing since the last read.
        """
        if not self._has_started:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        is_new = False
        for report in self._link.take():
            is_new |= self._stick.takes(report)
        if is_new:
            self._fill()
        sample[0] = self._sample[0]
        return 0 if is_new or not self._streams else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a finite force along x and y, each clipped to full scale.

        Raises:
            DeviceError: It is not finite, or the loop hung and the guardian ended the force.
        """
        shares = self._shares * wrench[:2]
        if not np.isfinite(shares).all():
            raise DeviceError(f"{self._name}: a force that is not finite was not sent")
        counted = shares.tolist()
        if self.last_word is not None:
            self.last_word.beat(has_force=any(counted))
        self._effects.push(counted)

    def close(self) -> None:
        """Stops the effects, switches the motors off and releases the device."""
        if not self._is_open:
            return
        self._is_open = False
        with released(self._link, self.last_word):
            self._effects.close()

    def leave_last_word(self, path: str) -> None:
        """Starts a guardian process that ends the force, if two processes can hold the node."""
        self.last_word = guard_device_node(path, *self._effects.farewell())

    def _fill(self) -> None:
        sample = self._sample[0]
        sample["position"][:2] = self._reach * self._stick.deflection
        sample["buttons"] = self._stick.buttons


def open_pid(options: Mapping[str, object], notify: Notify, api: HidApi | None = None) -> PidDevice:
    """Finds and opens a force-feedback stick.

    The options are ``serial``, ``log``, ``newtons``, ``travel``, ``reverse``, ``profile``, and the
    numbers ``CHANGES`` of the data sheet. ``notify`` receives a message about assumed values. With
    a substitute of hidapi, ``api``, reports are sent without a thread.

    Raises:
        DeviceError: No stick is found, it cannot be opened, or it lacks a required capability.
    """
    with opened(DRIVER, options, api, slots=SLOTS) as (plugged, link):
        scale, known = scale_of(options, plugged.serial, str(plugged), notify)
        device = PidDevice(
            link,
            str(plugged),
            scale=scale,
            known=known,
            intervals=polling(plugged.path) if api is None else (None, None),
            serial=plugged.serial,
        )
    if api is None:
        device.leave_last_word(plugged.path)
    return device


DRIVER = Driver(
    name="pid",
    about="USB force-feedback sticks of the class PID, any maker's",
    ids=(),
    transport="hid",
    axes="2",
    force="percent of a maximum in N, which newtons= sets",
    rate="125 Hz to 1 kHz, one axis at a time",
    has_guardian=True,
    on_stall="its effects end by themselves after 0.1 s, on a slow bus after up to 0.4 s",
    options={
        "serial": str,
        "log": str,
        "newtons": float,
        "travel": float,
        "reverse": str,
        "profile": str,
        **dict.fromkeys(CHANGES, float),
    },
    open=open_pid,
    recognises=has_force_feedback,
)
"""Driver of a device class: devices are recognised by their report descriptor, not by a list."""
