"""Home-made devices that speak the open protocol of ``rawhid.md``: 1 to 6 axes, 64-byte frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    AXES,
    USUAL_FORCE_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_period,
)
from hapticbridge.device.family import Driver, Notify, UsbId, select_device
from hapticbridge.device.rawhid.protocol import (
    LARGEST,
    LONGEST_WATCHDOG_MS,
    NAME_PAGE,
    NUMBERS_PAGE,
    VERSION,
    Numbers,
    State,
    Status,
    ask_frame,
    decoded,
    force_frame,
    version_of,
)
from hapticbridge.device.transport.hid import HidApi, HidLink, Link, find
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.watchdog import (
    SHORTEST_WATCHDOG,
    ForceOffGuardian,
    SilenceDetector,
    guard_device_node,
    watchdog_time,
)
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.pose import canonical, quaternion_exp
from hapticbridge.record import SAMPLE_DTYPE, TickFlag

# What a raw HID device says of itself when it is asked, and the data sheet made of it.

ASKS, ASK_WAIT_MS = 10, 100
"""How often a page of the sheet is asked for before giving up, and how long each answer is waited
for, in ms: a device that still boots has a second for each."""

POLLING = 1e-3
"""In s: a full-speed device is asked once a millisecond, in each direction."""

_MUST_SAY = ("rate", "speed_limit")
CHANGES = (
    "mass",
    "damping",
    "rotational_inertia",
    "rotational_damping",
    "friction",
    "resolution",
    "force_limit",
    "torque_limit",
    "speed_limit",
)
"""Numbers of the data sheet that the user may know better than the device."""


def asked(link: Link, name: str) -> tuple[Numbers, str]:
    """Asks a device for both pages of its sheet.

    Args:
        link: Reports to and from the device, open.
        name: What errors call it.

    Raises:
        DeviceError: It does not answer, or speaks another version of the protocol.
        DeviceLost: It is gone.
    """
    numbers, title = _page(link, name, NUMBERS_PAGE), _page(link, name, NAME_PAGE)
    assert isinstance(numbers, Numbers)
    return numbers, str(title)


def _page(link: Link, name: str, page: int) -> Numbers | str:
    for _ in range(ASKS):
        link.write(b"\0" + ask_frame(page, page))
        for report in reports(link, ASK_WAIT_MS):
            answer = decoded(report)
            if isinstance(answer, Numbers if page == NUMBERS_PAGE else str):
                return answer
            if (version := version_of(report)) not in (None, VERSION):
                raise DeviceError(
                    f"{name} speaks version {version} of the raw HID protocol; "
                    f"this is version {VERSION}"
                )
    raise DeviceError(
        f"{name} does not answer as hapticbridge/device/rawhid.md says; is its firmware on it?"
    )


def reports(link: Link, timeout_ms: int) -> Iterator[bytes]:
    """Yields reports as they come, for about that time: one a millisecond, or waiting."""
    left = timeout_ms
    while left > 0:
        report = link.wait(min(left, 10))
        left -= 1 if report else min(left, 10)
        if report:
            yield report


def data_sheet(name: str, numbers: Numbers, title: str, changes: dict[str, Any]) -> DeviceInfo:
    """Makes a data sheet of what the device says of itself and what the user knows better.

    Args:
        name: What errors call it.
        numbers: Page 0.
        title: Page 1.
        changes: Of ``CHANGES``, by name.

    Raises:
        DeviceError: A number that nobody can guess is missing, or one is out of range.
    """
    known: dict[str, Any] = numbers.known()
    axes = numbers.axis_names
    moves, turns = (any(axis in axes for axis in kind) for kind in (AXES[:3], AXES[3:]))
    if not moves:
        known["force_limit"] = USUAL_FORCE_LIMIT
    if not turns:
        known["torque_limit"] = USUAL_TORQUE_LIMIT
    known |= changes
    must = [*_MUST_SAY, *["force_limit"] * moves, *["torque_limit"] * turns]
    if missing := [field for field in must if known[field] is None]:
        raise DeviceError(f"{name} does not say its {missing[0]}, and nobody can guess it")
    # what the device adds by itself, a state that is one of its periods old, and the bus both ways
    delay = known.pop("delay")
    try:
        return DeviceInfo(
            name=title or name,
            axes=axes,
            delay=None if delay is None else delay + 1.0 / known["rate"] + 2.0 * POLLING,
            is_prescribed=False,
            is_real=True,
            duration=None,
            **known,
        )
    except (DeviceError, ZeroDivisionError) as error:
        raise DeviceError(f"{name} claims what cannot be: {error}") from None


# The state frames of a raw HID device as they come: the newest, and what was lost on the way.

_HALF_A_TURN = 0x80000000
"""Of the device's clock, in µs: a step forwards by more is taken for one backwards."""


class StateStream:
    """Takes reports one by one and counts.

    Args:
        name: What errors call the device.

    Attributes:
        newest: The state that came last; None before the first.
        lost: State frames that never came, by their sequence.
        damaged: Reports that were no valid frame.
        repeated: State frames that came twice.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self.newest: State | None = None
        self.lost = self.damaged = self.repeated = 0

    def takes(self, report: bytes) -> bool:
        """Takes a report; returns whether it was a state frame that is newer than the last one.

        Raises:
            DeviceError: The device has restarted, or a number is not finite.
        """
        state = decoded(report)
        if not isinstance(state, State):
            self.damaged += state is None
            return False
        last, self.newest = self.newest, state
        if last is not None:
            if state.sequence == last.sequence and state.time_us == last.time_us:
                self.repeated += 1
                return False
            if (state.time_us - last.time_us) & _HALF_A_TURN:
                raise DeviceError(
                    f"{self._name} has restarted in mid-run; its pose may count from elsewhere"
                )
            self.lost += (state.sequence - last.sequence - 1) & 0xFFFF
        if not state.is_finite or max(map(abs, state.numbers)) > LARGEST:
            raise DeviceError(f"{self._name} reports a number that is not finite")
        return True


FIRST_STATE_MS = 1000
"""Longest wait in ms for the first state frame."""

NO_WRENCH = (0.0,) * 6


class RawHidDevice:
    """A device that streams its state and obeys the newest force frame.

    The device sends a state frame at its own rate, without being asked; ``read`` takes the newest
    that has come. Of frames lost on the way the newest one still is right, so they are counted and
    nothing else; a frame with a wrong CRC is dropped and counted; a number that is not finite, a
    fault that the device reports, or a clock that runs backwards (it has restarted, and may count
    its pose from another place) ends the run.

    Args:
        link: Reports to and from the device, open.
        name: What errors call it.
        changes: Numbers of the data sheet that go before what the device says of itself.
        now: Returns the time in s of a clock that only grows.

    Attributes:
        info: Its data sheet.
        last_word: Says zero to it should this process die; None where no other process can.
        states: The newest state, and how many were lost or damaged on the way.

    Raises:
        DeviceError: It does not speak the protocol, another version of it, or its data sheet is
            incomplete or out of range.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        changes: Mapping[str, Any] | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link, self._name, self._now = link, name, now
        self._sequence = 0
        self.states = StateStream(name)
        self.info = data_sheet(name, *asked(link, name), dict(changes or {}))
        self._mask = np.array([float(axis in self.info.axes) for axis in AXES])
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._watch = SilenceDetector(now())
        self._watchdog_ms = LONGEST_WATCHDOG_MS
        self._is_open, self._has_begun = True, False
        self.last_word: ForceOffGuardian | None = None

    def start(self, period: float) -> NDArray[np.void]:
        """Waits for a state frame that is newer than this call.

        Args:
            period: The loop's period in s, finite and > 0.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: The period is not, the device sends nothing, must be homed first, or
                reports a fault.
        """
        period = checked_period(period)
        self._watchdog_ms = min(math.ceil(1e3 * watchdog_time(period)), LONGEST_WATCHDOG_MS)
        self._has_begun = False
        self.states = states = StateStream(self._name)
        self._link.take()
        for report in reports(self._link, FIRST_STATE_MS):
            if states.takes(report):
                break
        if states.newest is None:
            raise DeviceError(f"{self._name} sends no state frames")
        if states.newest.status & Status.NOT_READY:
            raise DeviceError(
                f"{self._name} does not know its pose yet: home or calibrate it, as its builder "
                "says, and start again"
            )
        self._refuse_fault(states.newest)
        self._fill(states.newest)
        self._watch = SilenceDetector(self._now(), period)
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports the newest pose that has come; waits for none.

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Returns:
            0, or ``STALE_SAMPLE`` where no valid frame has come since the last read.

        Raises:
            DeviceLost: The device is gone, or silent for longer than ``SILENCE``.
            DeviceError: It has not been started, has restarted, reports a fault, or a number that
                is not finite.
        """
        states = self.states
        if states.newest is None:
            raise DeviceError(f"{self._name} is read before it was started")
        is_new = False
        for report in self._link.take():
            is_new |= states.takes(report)
        if not self._has_begun:  # between the start and the loop nobody took what was sent
            self._has_begun, states.lost = True, 0
        if self._watch.is_silent(self._now(), is_new=is_new):
            silence = 1e3 * self._watch.silence
            raise DeviceLost(f"{self._name} has sent nothing for {silence:.0f} ms")
        if not is_new:
            sample[0] = self._sample[0]
            return int(TickFlag.STALE_SAMPLE)
        self._refuse_fault(states.newest)
        self._fill(states.newest)
        sample[0] = self._sample[0]
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench, on the axes that the device has.

        Args:
            wrench: Shape (6,): force in N, torque in N m, on the device, in the device's frame.

        Raises:
            DeviceLost: The device is gone.
            DeviceError: The wrench is not finite.
        """
        values = (wrench * self._mask).tolist()
        if not all(abs(value) < LARGEST for value in values):
            raise DeviceError(f"{self._name}: a wrench that is not finite was not sent")
        self._send(force_frame(self._next(), values, self._watchdog_ms))

    def close(self) -> None:
        """Switches the motors off and lets the device go."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._send(force_frame(self._next(), NO_WRENCH, 1, is_enabled=False))
        except DeviceLost:
            pass  # its own watchdog does it
        finally:
            self._link.close()
            if self.last_word is not None:
                self.last_word.close()

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity in m/s and angular velocity in rad/s as last reported, shape (6,); 0 before."""
        state = self.states.newest
        numbers = (0.0,) * 12 if state is None else state.numbers
        moving: NDArray[np.float64] = np.array(numbers[6:]) * self._mask
        return moving

    @property
    def on_the_way(self) -> int:
        """How many force frames the device had not obeyed yet when it sent its newest state."""
        state = self.states.newest
        return 0 if state is None else (self._sequence - state.echo) & 0xFFFF

    def _refuse_fault(self, state: State) -> None:
        if state.status & (Status.FAULT | Status.NOT_READY):
            what = "a fault of its own" if state.status & Status.FAULT else "that its pose was lost"
            raise DeviceError(
                f"{self._name} reports {what} (status 0x{state.status:02x}) and gives no force"
            )

    def _fill(self, state: State) -> None:
        """Makes a sample of a state; axes that the device lacks stay where they are."""
        pose = self._mask * state.numbers[:6]
        sample = self._sample[0]
        sample["position"] = pose[:3]
        x, y, z = pose[3:].tolist()
        sample["quaternion"] = canonical(quaternion_exp((x, y, z)))
        sample["buttons"] = state.buttons

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence

    def _send(self, frame: bytes) -> None:
        self._link.write(b"\0" + frame)  # reports without a number: hidapi wants a 0 in front


# Home-made devices that speak the open protocol: finding one among what is plugged in.


def open_rawhid(
    options: Mapping[str, object],
    _tell: Notify,
    api: HidApi | None = None,
    now: Callable[[], float] = time.monotonic,
) -> RawHidDevice:
    """Finds and opens a raw HID device.

    Args:
        options: ``serial``, ``log``, and numbers of the data sheet that go before its own.
        api: hidapi or what stands for it; its reports are then not sent by a thread.
        now: Returns the time in s of a clock that only grows.

    Raises:
        DeviceError: There is none, or it cannot be opened or does not speak the protocol.
    """
    plugged = select_device(FAMILY, find(FAMILY, api), options.get("serial"))
    link = HidLink.open(plugged, api, is_overlapped=api is None, log=HexLog.asked(options))
    changes = {key: value for key, value in options.items() if key in CHANGES}
    try:
        device = RawHidDevice(link, str(plugged), changes, now)
    except BaseException:
        link.close()
        raise
    device.info = replace(device.info, serial=plugged.serial)
    if api is None:
        zero = b"\0" + force_frame(0, NO_WRENCH, 1, is_enabled=False)
        device.last_word = guard_device_node(plugged.path, zero)
    return device


FAMILY = Driver(
    name="rawhid",
    about="home-made devices that speak hapticbridge/device/rawhid.md (Teensy and the like)",
    ids=(UsbId(0x16C0, 0x0486, "Teensy raw HID"),),
    transport="hid",
    axes="1 to 6, as built",
    force="as built",
    rate="to 1 kHz, as built",
    options=("serial", "log", *CHANGES),
    open=open_rawhid,
    on_stall=f"its watchdog takes the force away after {1e3 * SHORTEST_WATCHDOG:g} ms, if it was "
    "built as the protocol says",
    usage=(0xFFAB, 0x0200),
)
"""Teensy's raw HID interface; its second interface (usage page FFC9) is an emulated serial port."""
