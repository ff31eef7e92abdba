"""Home-made devices that speak the open protocol of ``rawhid.md``: 1 to 6 axes, 64-byte frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import AXES, DeviceInfo, checked_period
from hapticbridge.device.hex_log import HexLog
from hapticbridge.device.plugged import Family, Plugged, Tell, UsbId, chosen
from hapticbridge.device.rawhid_frame import (
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
from hapticbridge.device.transport_hid import HidApi, HidLink, find
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.pose import canonical, quaternion_exp
from hapticbridge.tick import SAMPLE_DTYPE, TickFlag

ASKS, ASK_WAIT_MS = 10, 100
"""How often a page of the sheet is asked for before giving up, and how long each answer is waited
for, in ms: a device that still boots has a second for each."""

FIRST_STATE_MS = 1000
"""Longest wait in ms for the first state frame."""

LONGEST_SILENCE = 0.05
"""In s. A device that streams at 200 Hz has missed ten frames by then; longer, and the hand would
feel the force of a pose that is long gone."""

SHORTEST_WATCHDOG, WATCHDOG_PERIODS = 0.02, 10
"""The watchdog asked for is ten periods of the loop, but not less than 20 ms: an ordinary kernel
stalls a loop for some ms now and then, and a force that drops out each time would rattle."""

POLLING = 1e-3
"""In s: a full-speed device is asked once a millisecond, in each direction."""

UNFELT_FORCE_LIMIT, UNFELT_TORQUE_LIMIT = 10.0, 0.5
"""In N and N m, those of the simulated device: for a device that does not move, or does not turn.
It feels no such wrench; only what is recorded is limited."""

_NO_WRENCH = (0.0,) * 6
_MUST_SAY = ("rate", "speed_limit")
_CHANGES = (
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


class Link(Protocol):
    """What the device needs of a transport: ``HidLink``, or what stands for it."""

    def take(self) -> list[bytes]:
        """Returns the reports that have come, without waiting."""

    def wait(self, timeout_ms: int) -> bytes:
        """Returns the next report, or nothing after that time."""

    def write(self, report: bytes) -> None:
        """Sends a report, its number first."""

    def close(self) -> None:
        """Lets the device go."""


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

    Attributes:
        lost: State frames that never came, by their sequence.
        damaged: Reports that were no valid frame.
        repeated: State frames that came twice.

    Raises:
        DeviceError: It does not speak the protocol, another version of it, or its data sheet is
            incomplete or out of range.
    """

    def __init__(self, link: Link, name: str, changes: Mapping[str, Any] | None = None) -> None:
        self._link, self._name = link, name
        self._sequence = 0
        self.lost = self.damaged = self.repeated = 0
        numbers, title = self._page(NUMBERS_PAGE), self._page(NAME_PAGE)
        self.info = _data_sheet(name, numbers, str(title), dict(changes or {}))
        self._mask = np.array([float(axis in self.info.axes) for axis in AXES])
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._state: State | None = None
        self._period = self._silence = 0.0
        self._watchdog_ms = LONGEST_WATCHDOG_MS
        self._is_open = True

    def start(self, period: float) -> NDArray[np.void]:
        """Waits for a state frame that is newer than this call.

        Args:
            period: The loop's period in s, finite and > 0.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: The period is not, the device sends nothing, or it must be homed first.
        """
        self._period = checked_period(period)
        watchdog = max(SHORTEST_WATCHDOG, WATCHDOG_PERIODS * period)
        self._watchdog_ms = min(math.ceil(1e3 * watchdog), LONGEST_WATCHDOG_MS)
        self.lost = self.damaged = self.repeated = 0
        self._silence, self._state = 0.0, None
        self._link.take()
        for report in self._reports(FIRST_STATE_MS):
            if self._is_newest(report):
                break
        if self._state is None:
            raise DeviceError(f"{self._name} sends no state frames")
        if self._state.status & Status.NOT_READY:
            raise DeviceError(
                f"{self._name} does not know its pose yet: home or calibrate it, as its builder "
                "says, and start again"
            )
        self._fill()
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports the newest pose that has come; waits for none.

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Returns:
            0, or ``STALE_SAMPLE`` where no valid frame has come since the last read.

        Raises:
            DeviceLost: The device is gone, or silent for longer than ``LONGEST_SILENCE``.
            DeviceError: It has not been started, has restarted, reports a fault, or a number that
                is not finite.
        """
        if self._state is None:
            raise DeviceError(f"{self._name} is read before it was started")
        is_new = False
        for report in self._link.take():
            is_new |= self._is_newest(report)
        if not is_new:
            self._silence += self._period
            if self._silence > LONGEST_SILENCE:
                raise DeviceLost(f"{self._name} has sent nothing for {1e3 * self._silence:.0f} ms")
            sample[0] = self._sample[0]
            return int(TickFlag.STALE_SAMPLE)
        self._silence = 0.0
        if self._state.status & Status.FAULT:
            raise DeviceError(f"{self._name} reports a fault of its own and gives no force")
        self._fill()
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
            self._send(force_frame(self._next(), _NO_WRENCH, 1, is_enabled=False))
        except DeviceLost:
            pass  # its own watchdog does it
        finally:
            self._link.close()

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity in m/s and angular velocity in rad/s as last reported, shape (6,); 0 before."""
        numbers = (0.0,) * 12 if self._state is None else self._state.numbers
        moving: NDArray[np.float64] = np.array(numbers[6:]) * self._mask
        return moving

    @property
    def on_the_way(self) -> int:
        """How many force frames the device had not obeyed yet when it sent its newest state."""
        return 0 if self._state is None else (self._sequence - self._state.echo) & 0xFFFF

    def _is_newest(self, report: bytes) -> bool:
        """Takes a report if it is a state frame that is newer than the last one."""
        state = decoded(report)
        if not isinstance(state, State):
            self.damaged += state is None
            return False
        last, self._state = self._state, state
        if last is not None:
            if state.sequence == last.sequence and state.time_us == last.time_us:
                self.repeated += 1
                return False
            # the clock wraps after 71.6 min; half of that backwards is taken for backwards
            if (state.time_us - last.time_us) & 0x80000000:
                raise DeviceError(
                    f"{self._name} has restarted in mid-run; its pose may count from elsewhere"
                )
            self.lost += (state.sequence - last.sequence - 1) & 0xFFFF
        if not state.is_finite or max(map(abs, state.numbers)) > LARGEST:
            raise DeviceError(f"{self._name} reports a number that is not finite")
        return True

    def _fill(self) -> None:
        """Makes a sample of the newest state; axes that the device lacks stay where they are."""
        assert self._state is not None
        pose = self._mask * self._state.numbers[:6]
        sample = self._sample[0]
        sample["position"] = pose[:3]
        x, y, z = pose[3:].tolist()
        sample["quaternion"] = canonical(quaternion_exp((x, y, z)))
        sample["buttons"] = self._state.buttons

    def _page(self, page: int) -> Numbers | str:
        """Asks for a page of the sheet until it comes."""
        for _ in range(ASKS):
            self._send(ask_frame(self._next(), page))
            for report in self._reports(ASK_WAIT_MS):
                answer = decoded(report)
                if isinstance(answer, Numbers if page == NUMBERS_PAGE else str):
                    return answer
                if (version := version_of(report)) not in (None, VERSION):
                    raise DeviceError(
                        f"{self._name} speaks version {version} of the raw HID protocol; "
                        f"this is version {VERSION}"
                    )
        raise DeviceError(
            f"{self._name} does not answer as hapticbridge/device/rawhid.md says; "
            "is its firmware on it?"
        )

    def _reports(self, timeout_ms: int) -> Iterator[bytes]:
        """Yields reports as they come, for about that time: one a millisecond, or waiting."""
        left = timeout_ms
        while left > 0:
            report = self._link.wait(min(left, 10))
            left -= 1 if report else min(left, 10)
            if report:
                yield report

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence

    def _send(self, frame: bytes) -> None:
        self._link.write(b"\0" + frame)  # reports without a number: hidapi wants a 0 in front


def _data_sheet(
    name: str, numbers: Numbers | str, title: str, changes: dict[str, Any]
) -> DeviceInfo:
    """Makes a data sheet of what the device says of itself and what the user knows better."""
    assert isinstance(numbers, Numbers)
    known: dict[str, Any] = numbers.known()
    axes = numbers.axis_names
    moves, turns = (any(axis in axes for axis in kind) for kind in (AXES[:3], AXES[3:]))
    if not moves:
        known["force_limit"] = UNFELT_FORCE_LIMIT
    if not turns:
        known["torque_limit"] = UNFELT_TORQUE_LIMIT
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


def open_rawhid(
    options: Mapping[str, object], _tell: Tell, api: HidApi | None = None
) -> RawHidDevice:
    """Finds and opens a raw HID device.

    Args:
        options: ``serial``, ``log``, and numbers of the data sheet that go before its own.
        api: hidapi or what stands for it; its reports are then not sent by a thread.

    Raises:
        DeviceError: There is none, or it cannot be opened or does not speak the protocol.
    """
    plugged: Plugged = chosen(FAMILY, find(FAMILY, api), options.get("serial"))
    log = options.get("log")
    link = HidLink.open(
        plugged, api, is_overlapped=api is None, log=HexLog(None if log is None else str(log))
    )
    changes = {key: value for key, value in options.items() if key in _CHANGES}
    try:
        return RawHidDevice(link, str(plugged), changes)
    except BaseException:
        link.close()
        raise


FAMILY = Family(
    name="rawhid",
    about="home-made devices that speak hapticbridge/device/rawhid.md (Teensy and the like)",
    ids=(UsbId(0x16C0, 0x0486, "Teensy raw HID"),),
    transport="hid",
    axes="1 to 6, as built",
    force="as built",
    rate="to 1 kHz, as built",
    options=("serial", "log", *_CHANGES),
    open=open_rawhid,
    usage=(0xFFAB, 0x0200),
)
"""Teensy's raw HID interface; its second interface (usage page FFC9) is an emulated serial port."""
