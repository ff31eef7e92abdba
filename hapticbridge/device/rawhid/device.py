"""Home-made devices with the open protocol of ``rawhid.md``: 1 to 6 axes, 64-byte frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    AXES,
    USUAL_FORCE_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_period,
    released,
)
from hapticbridge.device.driver import Driver, Notify, UsbId
from hapticbridge.device.own_loop import BoardSetting, LoopReport, LoopState, ShownTool
from hapticbridge.device.rawhid.protocol import (
    DOCUMENT,
    GRIP_PAGE,
    LARGEST,
    MAX_WATCHDOG_MS,
    NAME_PAGE,
    NUMBERS_PAGE,
    VERSION,
    Cause,
    GripNumbers,
    LoopTurn,
    Numbers,
    State,
    Status,
    ask_frame,
    decoded,
    force_frame,
    setting_frame,
    show_frames,
    version_of,
)
from hapticbridge.device.transport.hid import HidApi, opened
from hapticbridge.device.watchdog import (
    MIN_WATCHDOG,
    ForceOffGuardian,
    SilenceDetector,
    guard_device_node,
    watchdog_time,
)
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.pose import canonical, quaternion_exp
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

SLOTS = 3
"""Kinds of frames of which the newest alone is sent: surfaces, then the tool or force that they
belong to, then the setting of a loop on the board."""
_SURFACES, _COMMAND, _SETTING = range(SLOTS)


class FrameLink(Protocol):
    """Link that carries frames: a ``HidLink``, or a ``serial.SerialLink``."""

    def take(self) -> list[bytes]:
        """Returns the frames since the last call, oldest first, without waiting."""

    def wait(self, timeout_ms: int) -> bytes:
        """Returns the next frame; empty after ``timeout_ms``, >= 1."""

    def write(self, report: bytes, slot: int = 0) -> None:
        """Sends a frame after a byte 0, which hidapi requires for reports without a number.

        It may replace an unsent one in its slot, of which there are ``SLOTS``, sent in turn.
        """

    def close(self) -> None:
        """Sends the remaining frame and releases the device."""


# Data sheet of a raw HID device

ASKS, ASK_WAIT_MS = 10, 100
"""Number of requests for a page of the sheet, and wait for each answer in ms. A booting device has
a second per page."""

POLLING = 1e-3
"""Polling interval of a full-speed device in s, in each direction."""

_MUST_SAY, _GRIP_MUST_SAY = ("rate", "speed_limit"), ("force_limit", "speed_limit")
_FIXED = ("axes", "rate", "delay")
CHANGES = tuple(name for name in Numbers._fields if name not in _FIXED)
"""Numbers of the data sheet that the user may replace."""
GRIP_CHANGES = ("grip_mass", "grip_damping", "grip_force_limit")
"""Numbers of the grip axis that the user may replace."""

_PAGES = {NUMBERS_PAGE: Numbers, NAME_PAGE: str, GRIP_PAGE: GripNumbers}


def request_sheet(link: FrameLink, name: str) -> tuple[Numbers, str, GripNumbers | None]:
    """Requests the pages of a device's sheet; the third is that of a grip axis.

    Raises:
        DeviceError: The device does not answer, or has another version of the protocol.
        DeviceLost: The device is gone.
    """
    numbers, title = _page(link, name, NUMBERS_PAGE), _page(link, name, NAME_PAGE)
    assert isinstance(numbers, Numbers)
    grip = _page(link, name, GRIP_PAGE) if numbers.has_grip else None
    assert grip is None or isinstance(grip, GripNumbers)
    return numbers, str(title), grip


def _page(link: FrameLink, name: str, page: int) -> Numbers | GripNumbers | str:
    for _ in range(ASKS):
        link.write(b"\0" + ask_frame(page, page))
        for report in reports(link, ASK_WAIT_MS):
            answer = decoded(report)
            if isinstance(answer, Numbers | GripNumbers | str) and type(answer) is _PAGES[page]:
                return answer
            refuse_other_version(report, name)
    raise DeviceError(f"{name} does not answer by the protocol of {DOCUMENT}; check its firmware")


def refuse_other_version(frame: bytes, name: str) -> None:
    """Raises DeviceError if a frame is of another version of the protocol."""
    if (version := version_of(frame)) not in (None, VERSION):
        raise DeviceError(
            f"{name} speaks version {version} of the raw HID protocol; "
            f"version {VERSION} is required, so update its firmware"
        )


def reports(link: FrameLink, timeout_ms: int) -> Iterator[bytes]:
    """Yields reports as they come, for about ``timeout_ms``; a report counts as 1 ms."""
    left = timeout_ms
    while left > 0:
        report = link.wait(min(left, 10))
        left -= 1 if report else min(left, 10)
        if report:
            yield report


def data_sheet(
    name: str,
    pages: tuple[Numbers, str, GripNumbers | None],
    changes: dict[str, Any],
    round_trip: float | None = None,
) -> DeviceInfo:
    """Returns the data sheet from the device's pages and the user's changes.

    The delay is the device's own plus ``round_trip``, the measured time in s from a written force
    to the state that confirms it. A measured delay includes what the device does not report.
    Without a measurement it is one period of the device and two polling intervals.

    Raises:
        DeviceError: A required number is missing, or one is out of range.
    """
    numbers, title, grip = pages
    known: dict[str, Any] = numbers.known()
    axes = numbers.axis_names
    of_grip = {key.removeprefix("grip_"): changes.pop(key) for key in GRIP_CHANGES & changes.keys()}
    moves, turns = (any(axis in axes for axis in kind) for kind in (AXES[:3], AXES[3:]))
    if not moves:
        known["force_limit"] = USUAL_FORCE_LIMIT
    if not turns:
        known["torque_limit"] = USUAL_TORQUE_LIMIT
    if (rate := changes.get("loop_rate")) not in (None, 0.0, known["loop_rate"]):
        raise DeviceError(
            f"loop_rate is {rate:g} Hz; it must be 0, with which the bridge's loop pulls at {name} "
            "in place of its own"
        )
    known |= changes
    must = [*_MUST_SAY, *["force_limit"] * moves, *["torque_limit"] * turns]
    if missing := [field for field in must if known[field] is None]:
        raise DeviceError(f"{name} does not report its {missing[0]}, which is required")
    delay, loop_rate = known.pop("delay"), known.pop("loop_rate")
    suits = grip is None and _loop_has(axes, is_posed=numbers.is_posed)
    known |= _own_loop(name, loop_rate if suits else None, known["loop_delay"])
    values: dict[str, Any] = {} if grip is None else grip.known() | of_grip
    if missing := [each for each in _GRIP_MUST_SAY if each in values and values[each] is None]:
        raise DeviceError(f"{name} does not report its grip's {missing[0]}, which is required")
    try:
        if round_trip is not None:
            delay = (delay or 0.0) + round_trip
        elif delay is not None:
            delay += 1.0 / known["rate"] + 2.0 * POLLING
        info = DeviceInfo(name=title or name, axes=axes, delay=delay, **known)
        if grip is None:
            return info
        own: dict[str, Any] = {"axes": AXES[:1], "rate": info.rate, "delay": delay} | values
        return replace(info, grip_axis=DeviceInfo(name=f"grip of {info.name}", **own))
    except (DeviceError, ZeroDivisionError) as error:
        raise DeviceError(f"{name} reports an impossible data sheet: {error}") from None


def _loop_has(axes: tuple[str, ...], *, is_posed: bool) -> bool:
    """Returns True for a handle on lines, about one axis, or about all where the loop has rotation.

    The orientations of a handle about two axes are no rotation vectors of these two.
    """
    turns = sum(axis in AXES[3:] for axis in axes)
    return turns in (0, 1, 3) if is_posed else turns == 0 or len(axes) == 1


def _own_loop(name: str, rate: float | None, delay: float | None) -> dict[str, float | None]:
    """Returns period and delay of a board's own loop; of none without a rate.

    Raises:
        DeviceError: The delay is unknown, with which the condition could not be judged.
    """
    if not rate:
        return {"loop_period": None, "loop_delay": 0.0}
    if not delay:
        raise DeviceError(
            f"{name} has a loop of its own and does not state its loop_delay, the time in s from "
            "reading a position to its force: name it, or leave the coupling to the bridge's loop "
            "with loop_rate=0"
        )
    return {"loop_period": 1.0 / rate, "loop_delay": delay}


# State frames of a raw HID device

_HALF_A_TURN = 0x80000000
"""Half the range of the device's clock in µs; a larger step forwards counts as a step backwards."""


class StateStream:
    """Decoder and counter of state frames.

    Args:
        name: Name of the device in messages.
        is_posed: True if states of the device's own loop have rotation, in a second frame.

    Attributes:
        newest: Newest state; None before the first.
        report: Newest counters of the device's own loop; None before the first.
        lost: Number of missing state frames, by their sequence.
        damaged: Number of reports that were not valid frames.
    """

    def __init__(self, name: str, *, is_posed: bool = False) -> None:
        self._name, self._is_posed = name, is_posed
        self._half: LoopState | None = None
        self.newest: State | LoopState | None = None
        self.report: LoopReport | None = None
        self.lost = self.damaged = 0

    def takes(self, report: bytes) -> bool:
        """Decodes a report; returns whether it was a new state frame.

        Raises:
            DeviceError: The device has restarted, or a number is not finite.
        """
        state = decoded(report)
        if isinstance(state, LoopReport):
            self.report = state
            return False
        if isinstance(state, LoopState) and self._is_posed:
            self._half = state
            return False
        if isinstance(state, LoopTurn):
            if self._half is None or self._half.sequence != state.sequence:
                return False  # its first frame was lost, which the sequence tells
            state = self._half._replace(
                rotation=state.rotation,
                angular_velocity=state.angular_velocity,
                torque=state.torque,
            )
        if not isinstance(state, State | LoopState):
            self.damaged += state is None
            return False
        last, self.newest = self.newest, state
        if last is not None:
            if state.sequence == last.sequence and state.time_us == last.time_us:
                return False
            if (state.time_us - last.time_us) & _HALF_A_TURN:
                raise DeviceError(
                    f"{self._name} has restarted during the run; its pose may have a new origin"
                )
            self.lost += (state.sequence - last.sequence - 1) & 0xFFFF
        if not state.is_finite or max(map(abs, state.numbers)) > LARGEST:
            raise DeviceError(f"{self._name} reports a number that is not finite")
        return True


FIRST_STATE_MS = 1000
"""Longest wait in ms for the first state frame."""

NO_WRENCH = (0.0,) * 6

_FAULTS: dict[int, tuple[str, str]] = {
    Cause.TEMPERATURE: ("that a motor or its driver is too hot", "let it cool, and home it"),
    Cause.ENCODER: ("that an encoder is not read", "check its cable, restart and home it"),
    Cause.DRIVER: (
        "that a motor's driver has switched off",
        "check its supply, restart and home it",
    ),
}
"""Faults by their cause, each with a remedy."""


class RawHidDevice:
    """A device that streams its state and applies the newest force frame.

    The device sends state frames at its own rate; ``read`` returns the newest. Lost frames are
    counted only, because the newest remains valid. A frame with a wrong CRC is dropped and counted.
    The run ends on a non-finite number, a reported fault, or a clock that runs backwards. The last
    means a restart, after which the pose may have another origin.

    Args:
        link: Open link for its reports.
        name: Name of the device in messages.
        changes: Numbers of the data sheet that replace those of the device.
        now: Returns the time of a monotonic clock in s.
        round_trip: Measured delay of the link in s; None for USB's own.

    Attributes:
        info: Its data sheet.
        is_posed: True if its own loop renders rotation beside lines.
        last_word: Commands zero force if this process dies or hangs; None if no second process
            can.
        states: Newest state, and numbers of lost and damaged frames.

    Raises:
        DeviceError: The device has another protocol or version, or its data sheet is incomplete or
            out of range.
    """

    def __init__(
        self,
        link: FrameLink,
        name: str,
        changes: Mapping[str, Any] | None = None,
        now: Callable[[], float] = time.monotonic,
        round_trip: float | None = None,
    ) -> None:
        self._link, self._name, self._now = link, name, now
        self._sequence = 0
        pages = request_sheet(link, name)
        self.is_posed = pages[0].is_posed
        self.states = StateStream(name, is_posed=self.is_posed)
        self.info = data_sheet(name, pages, dict(changes or {}), round_trip)
        has_loop = pages[0].loop_rate > 0.0 and (changes or {}).get("loop_rate") != 0.0
        self._has_idle_loop = has_loop and self.info.loop_period is None
        self._mask = np.array([float(axis in self.info.axes) for axis in AXES])
        self._has_grip = self.info.grip_axis is not None
        self._sample = np.zeros(1 + self._has_grip, SAMPLE_DTYPE)
        self._sample["quaternion"][:, 0] = 1.0
        self._watch = SilenceDetector(now())
        self._watchdog_ms = MAX_WATCHDOG_MS
        self._is_open, self._has_begun = True, False
        self.last_word: ForceOffGuardian | None = None

    def start(self, period: float) -> NDArray[np.void]:
        """Waits for a state frame newer than this call.

        Raises:
            DeviceError: The period is not valid, or the device sends nothing, must be homed first,
                or reports a fault.
        """
        period = checked_period(period)
        self._watchdog_ms = min(math.ceil(1e3 * watchdog_time(period)), MAX_WATCHDOG_MS)
        self._has_begun = False
        self.states = states = StateStream(self._name, is_posed=self.is_posed)
        self._link.take()
        for report in reports(self._link, FIRST_STATE_MS):
            if states.takes(report):
                if isinstance(states.newest, State):
                    break
                self._end_force()  # of a tool that an earlier program has shown
        if states.newest is None:
            raise DeviceError(
                f"{self._name} sends no state frames within {FIRST_STATE_MS} ms; check its firmware"
            )
        if isinstance(states.newest, LoopState):
            raise DeviceError(
                f"{self._name} follows a tool that another program shows; end that program"
            )
        if states.newest.status & Status.NOT_READY:
            raise DeviceError(
                f"{self._name} has no valid pose yet: home or calibrate it as its builder "
                "describes, and start again"
            )
        self._refuse_fault(states.newest)
        self._fill(states.newest)
        self._watch = SilenceDetector(self._now(), period)
        if self.last_word is not None:
            self.last_word.expect(period)
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the newest pose, and in a second sample the grip, without waiting.

        Raises:
            DeviceLost: The device is gone, or silent for longer than ``SILENCE``.
            DeviceError: The device was not started, has restarted, reports a fault, or sent a
                non-finite number.
        """
        states = self.states
        if states.newest is None:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        is_new = False
        for report in self._link.take():
            is_new |= states.takes(report)
        if not self._has_begun:  # frames between the start and the loop do not count as lost
            self._has_begun, states.lost, states.damaged = True, 0, 0
        if self._watch.is_silent(self._now(), is_new=is_new):
            silence = 1e3 * self._watch.silence
            raise DeviceLost(f"{self._name} has sent nothing for {silence:.0f} ms; check its cable")
        if not is_new:
            sample[:] = self._sample[: sample.size]
            return int(TickFlag.STALE_SAMPLE)
        self._refuse_fault(states.newest)
        self._fill(states.newest)
        sample[:] = self._sample[: sample.size]
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a finite wrench on the axes that the device has, or with that of the grip.

        Raises:
            DeviceError: It is not finite, or the loop hung and the guardian ended the force.
        """
        flat = wrench.ravel()
        values = (flat[:6] * self._mask).tolist()
        if self._has_grip and flat.size > 6:
            values.append(float(flat[6]))
        if not all(abs(value) < LARGEST for value in values):
            raise DeviceError(f"{self._name}: a wrench that is not finite was not sent")
        if self.last_word is not None:
            self.last_word.beat(has_force=any(values))
        self._send(force_frame(self._next(), values, self._watchdog_ms))

    def close(self) -> None:
        """Switches the motors off and releases the device."""
        if not self._is_open:
            return
        self._is_open = False
        with released(self._link, self.last_word):
            self._end_force()

    def say_idle_loop(self, notify: Notify) -> None:
        """Tells the user of a loop on the board that cannot render the axes of the device."""
        if self._has_idle_loop:
            notify(
                f"the loop on the board of '{self.info.name}' does not render all of its axes; "
                "the bridge's loop renders them"
            )

    def _end_force(self) -> None:
        self._send(force_frame(self._next(), NO_WRENCH, 1, is_enabled=False))

    @property
    def remark(self) -> str:
        """Numbers of lost and damaged frames, as a clause; empty if there were none."""
        lost, damaged = self.states.lost, self.states.damaged
        return f"{lost} state frames lost, {damaged} damaged" if lost or damaged else ""

    @property
    def loop_state(self) -> LoopState | None:
        """Newest state of its own loop; None while it follows ``write``."""
        state = self.states.newest
        return state if isinstance(state, LoopState) else None

    @property
    def place(self) -> tuple[float, ...]:
        """Newest position in m, or angles in rad of a device that only turns."""
        state = self.states.newest
        if state is None:
            return (0.0, 0.0, 0.0)
        is_turned = isinstance(state, State) and self._is_knob
        return state.numbers[3:6] if is_turned else state.numbers[:3]

    @property
    def loop_report(self) -> LoopReport | None:
        """Newest counters of its own loop; None before the first."""
        return self.states.report

    def set_loop(self, setting: BoardSetting) -> None:
        """Sets the coupling that its own loop renders (``device.own_loop``)."""
        self._send(setting_frame(self._next(), setting), _SETTING)

    def show(self, shown: ShownTool) -> int:
        """Shows the tool to its own loop, whose force fades after the watchdog's time without one.

        Returns the sequence that the loop's state has as its echo.

        Raises:
            DeviceError: The loop hung and the guardian ended the force.
        """
        if self.last_word is not None:
            self.last_word.beat(has_force=shown.is_enabled)
        frames = show_frames(self._next(), shown, self._watchdog_ms, is_posed=self.is_posed)
        *surfaces, tool = frames
        for frame in surfaces:
            self._send(frame, _SURFACES)
        self._send(tool)
        return self._sequence

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Last reported velocity in m/s and angular velocity in rad/s, shape (6,); initially 0."""
        state = self.states.newest
        numbers = (0.0,) * 12 if state is None else self._in_place(state)
        moving: NDArray[np.float64] = np.array(numbers[6:]) * self._mask
        if self._has_grip:  # which is in its place
            moving[3:] = 0.0
        return moving

    @property
    def on_the_way(self) -> int:
        """Number of force frames that the device had not yet applied at its newest state."""
        state = self.states.newest
        return 0 if state is None else (self._sequence - state.echo) & 0xFFFF

    def _refuse_fault(self, state: State | LoopState) -> None:
        if state.status & (Status.FAULT | Status.NOT_READY):
            what, remedy = "that its pose was lost", "restart and home it"
            if state.status & Status.FAULT:
                what, remedy = _FAULTS.get(
                    state.status & Status.CAUSE, ("a fault of its own", remedy)
                )
            raise DeviceError(
                f"{self._name} reports {what} (status 0x{state.status:02x}) and gives no force; "
                f"{remedy}"
            )

    def _fill(self, state: State | LoopState) -> None:
        """Converts a state into a sample; axes that the device lacks do not move."""
        pose = self._mask * self._in_place(state)[:6]
        sample = self._sample[0]
        sample["position"] = pose[:3]
        x, y, z = pose[3:].tolist()
        sample["quaternion"] = canonical(quaternion_exp((x, y, z)))
        sample["buttons"] = state.buttons
        if self._has_grip:
            self._sample["position"][1, 0] = state.numbers[9]

    def _in_place(self, state: State | LoopState) -> tuple[float, ...]:
        """Returns the numbers of a state; a loop's own are angles on a device that only turns."""
        if isinstance(state, State) or not self._is_knob:
            return state.numbers
        return (*state.numbers[3:6], *state.position, *state.numbers[3:6], *state.velocity)

    @property
    def _is_knob(self) -> bool:
        return not (self.info.moves or self.is_posed)

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence

    def _send(self, frame: bytes, slot: int = _COMMAND) -> None:
        # hidapi requires a leading 0 for reports without a number
        self._link.write(b"\0" + frame, slot)


# Discovery of home-made devices


def open_rawhid(
    options: Mapping[str, object],
    notify: Notify,
    api: HidApi | None = None,
    now: Callable[[], float] = time.monotonic,
) -> RawHidDevice:
    """Finds and opens a raw HID device.

    The options are ``serial``, ``log``, and numbers that replace those of the device's data sheet.
    With a substitute of hidapi, ``api``, reports are sent without a thread.

    Raises:
        DeviceError: No device is found, it cannot be opened, or it has another protocol.
    """
    changes = {key: options[key] for key in (*CHANGES, *GRIP_CHANGES) if key in options}
    with opened(DRIVER, options, api, slots=SLOTS) as (plugged, link):
        device = RawHidDevice(link, str(plugged), changes, now)
    device.info = replace(device.info, serial=plugged.serial)
    device.say_idle_loop(notify)
    if api is None:
        zero = b"\0" + force_frame(0, NO_WRENCH, 1, is_enabled=False)
        device.last_word = guard_device_node(plugged.path, zero)
    return device


DRIVER = Driver(
    name="rawhid",
    about="home-made devices with our open protocol over USB HID (as on Teensy)",
    ids=(UsbId(0x16C0, 0x0486, "Teensy raw HID"),),
    transport="hid",
    axes="1 to 6, and a grip axis, as built",
    force="as built",
    rate="to 1 kHz, as built",
    options={"serial": str, "log": str, **dict.fromkeys((*CHANGES, *GRIP_CHANGES), float)},
    open=open_rawhid,
    on_stall=f"its watchdog ends the force after {1e3 * MIN_WATCHDOG:g} ms, if it was built "
    "to the protocol",
    has_guardian=True,
    usage=(0xFFAB, 0x0200),
    products="a board of any vendor with the HID usage page ffab",
    document=DOCUMENT,
)
"""Driver of home-made devices with Teensy's raw HID interface. Its second interface (usage page
FFC9) is an emulated serial port."""
