"""Home-made devices on a serial port: the frames of ``rawhid.md`` back to back, through pyserial.

Hapkit, Arduino and ESP32 boards have a serial port over USB instead of raw HID. A port says nothing
about what is behind it, so a board is recognised by its answer.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from hapticbridge.device.base import (
    TIMING,
    calling_on_error,
    checked_number,
    usual_delay,
)
from hapticbridge.device.driver import (
    RULES_COMMAND,
    Driver,
    FoundDevice,
    Notify,
    access_problem,
    is_refused,
)
from hapticbridge.device.rawhid.device import (
    CHANGES,
    GRIP_CHANGES,
    NO_WRENCH,
    SLOTS,
    RawHidDevice,
    refuse_other_version,
)
from hapticbridge.device.rawhid.protocol import (
    DOCUMENT,
    NUMBERS_PAGE,
    FrameReader,
    State,
    ask_frame,
    decoded,
    force_frame,
)
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.watchdog import MIN_WATCHDOG, guard_device_node
from hapticbridge.errors import DeviceError, DeviceLost, choices

# Serial ports of this machine, from pyserial

BAUDS = (1_000_000, 500_000, 250_000, 115_200, 2_000_000)
"""Baud rates in bit/s that are tried, in this order. At 1 Mbaud a frame takes 0.64 ms. An AVR at
16 MHz makes the first three exactly. A board with USB of its own ignores the number."""

MAX_WRITE = 0.05
"""Longest time in s for a port to accept a frame, which takes 5.6 ms at 115200 baud."""


class SerialPort(Protocol):
    """An open port of pyserial: the part that is used."""

    baudrate: int

    @property
    def in_waiting(self) -> int:
        """Number of received bytes."""

    @property
    def out_waiting(self) -> int:
        """Number of bytes not sent yet."""

    def read(self, size: int) -> bytes:
        """Returns received bytes, without waiting for more."""

    def write(self, data: bytes) -> int | None:
        """Sends bytes; waits for at most ``MAX_WRITE``."""

    def reset_input_buffer(self) -> None:
        """Discards received bytes."""

    def reset_output_buffer(self) -> None:
        """Discards bytes not sent yet."""

    def close(self) -> None:
        """Releases the port."""


class SystemPorts:
    """Serial ports of this machine, and its clock; tests replace it by a model."""

    def found(self) -> list[FoundDevice]:
        """Lists the serial ports on USB; none of them is opened."""
        try:
            listing = importlib.import_module("serial.tools.list_ports")
        except ImportError:
            return []
        return [
            FoundDevice(
                driver="serial",
                name=port.product or port.description or "serial port",
                serial=port.serial_number or "",
                path=port.device,
                vendor=port.vid,
                product=port.pid or 0,
                transport="serial",
                problem=access_problem(port.device) if port.device.startswith("/") else None,
                lacks_permission=port.device.startswith("/") and is_refused(port.device),
            )
            for port in listing.comports()
            if port.vid is not None
        ]

    def open(self, path: str, baud: int) -> SerialPort:
        """Opens a port for this process alone.

        Raises:
            DeviceError: pyserial is missing, or the port is missing, not permitted or in use.
        """
        try:
            serial: Any = importlib.import_module("serial")
        except ImportError:
            raise DeviceError(
                "pyserial cannot be loaded; 'pip install pyserial' installs it"
            ) from None
        try:
            port: SerialPort = serial.Serial(
                path, baud, timeout=0, write_timeout=MAX_WRITE, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise DeviceError(self._reason(path, baud, error)) from None
        return port

    def now(self) -> float:
        """Returns the time of a monotonic clock in s."""
        return time.monotonic()

    def sleep(self, duration: float) -> None:
        """Waits for a duration in s."""
        time.sleep(duration)

    def _reason(self, path: str, baud: int, error: Exception) -> str:
        number = getattr(error, "errno", None)
        if number == errno.EACCES:
            return (
                f"no permission to open {path}; '{RULES_COMMAND}' prints the rule that grants it, "
                "and so does membership of the group that owns it: "
                f"'sudo usermod -aG {_group(path)} $USER', then log in again"
            )
        if number == errno.ENOENT or "FileNotFoundError" in str(error):
            there = [port.path for port in self.found()]
            plugged = f"plugged in: {choices(there)}" if there else "no serial port is plugged in"
            return f"there is no serial port {path}; {plugged}"
        if number in (errno.EAGAIN, errno.EBUSY) or "PermissionError" in str(error):
            return f"{path} is in use by another program; close it (such as a serial monitor)"
        return f"{path} cannot be opened at {baud} baud: {error}"


def _group(path: str) -> str:
    """Returns the name of the group that owns a port; Debian's where there is none to be read.

    There is none without the port, for a group without a name, and on Windows.
    """
    try:
        import grp  # noqa: PLC0415 - not on Windows

        return grp.getgrgid(Path(path).stat().st_gid).gr_name
    except (ImportError, OSError, KeyError):
        return "dialout"


# Link over a serial line

PAUSE = 0.5e-3
"""Time in s between two looks at a port, outside the loop."""

FULL, FRESH_MS = 4000, 5
"""Number of bytes that were received at once after a long pause, and longest wait in ms for a new
frame then. A terminal of Linux keeps 4095 bytes and loses or delays what comes after them."""


class SerialLink:
    """An open port: newest frames without waiting, and frames to the board.

    A frame is sent only when the one before has left, so that none waits in a queue. A frame that
    cannot be sent yet is replaced by the next one.

    Args:
        port: The open port.
        name: Name of the board in messages.
        ports: Clock of the port.
        log: Log of the transferred bytes.

    Attributes:
        frames: Decoder of the received bytes.
        received: Number of received bytes.
    """

    def __init__(self, port: SerialPort, name: str, ports: SystemPorts, log: HexLog) -> None:
        self._port, self._name, self._ports, self._log = port, name, ports, log
        self._waiting: deque[bytes] = deque()
        self._newest: list[bytes | None] = [None] * SLOTS
        self._turn = 0
        self._idle_since = ports.now()
        self._lost, self._is_open = "", True
        self.frames, self.received = FrameReader(), 0

    def take(self) -> list[bytes]:
        """Returns the frames since the last call, oldest first, without waiting.

        Only after a pause that filled the port's queue does it wait for a new frame, up to
        ``FRESH_MS``.

        Raises:
            DeviceLost: The port is gone.
        """
        before = self.received
        self._receive()
        if self.received - before >= FULL:
            self._await_news(FRESH_MS)
        frames = list(self._waiting)
        self._waiting.clear()
        return frames

    def wait(self, timeout_ms: int) -> bytes:
        """Returns the next frame; empty after ``timeout_ms``, >= 1."""
        if not self._waiting:
            self._await_news(timeout_ms)
        return self._waiting.popleft() if self._waiting else b""

    def write(self, report: bytes, slot: int = 0) -> None:
        """Sends a frame after a byte 0, which is not sent; it replaces an unsent one in its slot.

        Raises:
            DeviceLost: The port is gone, or accepted nothing for ``MAX_WRITE``.
        """
        self._newest[slot] = report[1:]
        self._send()

    def close(self) -> None:
        """Sends the remaining frames, each for at most ``MAX_WRITE``, and releases the port."""
        if not self._is_open:
            return
        try:
            with contextlib.suppress(DeviceLost, OSError):
                if not self._is_drained():
                    self._port.reset_output_buffer()  # the port would wait for it on closing
                while any(self._newest) and self._is_drained():
                    self._send()
                self._is_drained()
        finally:
            self._is_open = False
            with contextlib.suppress(OSError):
                self._port.close()
            self._log.close()

    def _await_news(self, timeout_ms: int) -> None:
        """Waits until a frame joins those that wait, or the time is over."""
        end, count = self._ports.now() + 1e-3 * timeout_ms, len(self._waiting)
        while True:
            self._receive()
            if len(self._waiting) > count or self._ports.now() >= end:
                return
            self._ports.sleep(PAUSE)

    def _receive(self) -> None:
        self._refuse_lost()
        try:
            count = self._port.in_waiting
            data = self._port.read(count) if count else b""
        except (OSError, TypeError):  # TypeError: pyserial after another thread's close
            self._lost = f"{self._name} is gone: unplugged, or switched off"
            raise DeviceLost(self._lost) from None
        if not data:
            return
        if self._log.is_on:
            self._log.add("<", data)
        self.received += len(data)
        self._waiting += self.frames.take(data)

    def _send(self) -> None:
        self._refuse_lost()
        waiting = [slot for slot, each in enumerate(self._newest) if each is not None]
        if not waiting:
            return
        later = [slot for slot in waiting if slot > self._turn]  # slots take turns
        slot = later[0] if later else waiting[0]
        frame = self._newest[slot] or b""
        now = self._ports.now()
        try:
            if self._port.out_waiting:
                if now - self._idle_since > MAX_WRITE:
                    raise TimeoutError
                return
            self._idle_since, self._newest[slot], self._turn = now, None, slot
            if self._port.write(frame) != len(frame):
                raise TimeoutError
        except OSError:  # among them pyserial's own errors
            self._lost = f"{self._name} accepts no bytes any more; unplug it and plug it in again"
            raise DeviceLost(self._lost) from None
        if self._log.is_on:
            self._log.add(">", frame)

    def _is_drained(self) -> bool:
        end = self._ports.now() + MAX_WRITE
        while self._port.out_waiting:
            if self._ports.now() >= end:
                return False
            self._ports.sleep(PAUSE)
        return True

    def _refuse_lost(self) -> None:
        if self._lost or not self._is_open:
            raise DeviceLost(self._lost or f"{self._name} is closed")


# Recognition of a board, and its baud rate and delay

BOOT = 4.0
"""Longest wait in s for a board's first frame. Opening the port restarts many boards, and their
boot loader waits for one or two seconds."""

LISTENING_MS = 60
"""Time in ms for which one baud rate is tried. The board streams states; at 115200 baud one takes
5.6 ms."""


def connect(
    ports: SystemPorts, plugged: FoundDevice, bauds: tuple[int, ...], log: HexLog
) -> tuple[SerialLink, int]:
    """Opens a port, and tries the baud rates until a board answers by the protocol.

    Returns:
        The link, and the baud rate in bit/s.

    Raises:
        DeviceError: The port cannot be opened, no board answers within ``BOOT``, or it has another
            version of the protocol.
    """
    port = ports.open(plugged.path, bauds[0])
    link = SerialLink(port, str(plugged), ports, log)
    with calling_on_error(link.close):
        end = ports.now() + BOOT
        while ports.now() < end:
            for baud in bauds:
                _set_baud(port, baud, plugged.path)
                link.write(b"\0" + ask_frame(NUMBERS_PAGE, NUMBERS_PAGE))
                if frame := link.wait(LISTENING_MS):
                    refuse_other_version(frame, str(plugged))
                    return link, baud
        tried = " or ".join(f"{baud}" for baud in bauds)
        if link.received:
            raise DeviceError(
                f"{plugged} at {plugged.path} sends bytes, but no frames of {DOCUMENT} "
                f"at {tried} baud; set its own rate with baud=, or load the firmware"
            )
        raise DeviceError(
            f"{plugged} at {plugged.path} is silent at {tried} baud; load the firmware of "
            f"{DOCUMENT.parent / 'rawhid' / 'firmware'}, or check power and cable"
        )


def _set_baud(port: SerialPort, baud: int, path: str) -> None:
    try:
        if port.baudrate != baud:
            port.baudrate = baud
        port.reset_input_buffer()
    except (OSError, ValueError) as error:
        raise DeviceError(f"{path} cannot be set to {baud} baud: {error}") from None


def measured_round_trip(link: SerialLink, ports: SystemPorts, name: str) -> float:
    """Returns the time in s from a force frame to the state that confirms it, in 95 % of cases.

    It contains the line both ways, the board's work, and the wait for its next state. The frames do
    not enable the motors.

    Raises:
        DeviceError: The board confirms none.
        DeviceLost: The port is gone.
    """
    times: list[float] = []
    number, end = 0, ports.now() + 10.0 * TIMING
    enough = ports.now() + TIMING
    while ports.now() < end and (ports.now() < enough or len(times) < MEASURED):
        number += 1
        sent = ports.now()
        link.write(b"\0" + force_frame(number, NO_WRENCH, 1, is_enabled=False))
        while ports.now() - sent < TIMING and (frame := link.wait(LISTENING_MS)):
            state = decoded(frame)
            if isinstance(state, State) and state.echo == number:
                times.append(ports.now() - sent)
                break
    if not times:
        raise DeviceError(
            f"{name} confirms no force frame (its states echo none); check its firmware, and that "
            "its receiving line is connected"
        )
    return usual_delay(times)


MEASURED = 20
"""Smallest number of measured round trips, unless ten times the usual time is over."""


def open_serial(
    options: Mapping[str, object], notify: Notify, ports: SystemPorts | None = None
) -> RawHidDevice:
    """Finds and opens a board on a serial port.

    The options are ``port``, ``baud``, ``serial``, ``log``, and numbers that replace those of the
    board's data sheet. Without ``port`` the ports on USB are asked in turn, which restarts some
    boards.

    Raises:
        DeviceError: No port can be opened, or no board answers by the protocol.
    """
    source = SystemPorts() if ports is None else ports
    bauds: tuple[int, ...] = BAUDS
    if "baud" in options:
        baud = checked_number("baud", options["baud"], "bit/s", is_positive=True)
        bauds = (round(baud),)
    changes = {key: options[key] for key in (*CHANGES, *GRIP_CHANGES) if key in options}
    plugged, (link, baud) = _first_answer(
        _candidates(options, source), source, bauds, notify, options
    )
    with calling_on_error(link.close):
        round_trip = measured_round_trip(link, source, str(plugged))
        device = RawHidDevice(link, str(plugged), changes, source.now, round_trip)
    notify(f"{plugged.path} at {baud} baud: a force is confirmed within {1e3 * round_trip:.1f} ms")
    device.info = replace(device.info, serial=plugged.serial)
    device.say_idle_loop(notify)
    if ports is None:
        zero = force_frame(0, NO_WRENCH, 1, is_enabled=False)
        device.last_word = guard_device_node(plugged.path, zero)
    return device


def _candidates(options: Mapping[str, object], ports: SystemPorts) -> list[FoundDevice]:
    plugged_in = ports.found()
    if (path := options.get("port")) is not None:
        path = str(path)
        if Path(path).is_symlink():  # such as those of /dev/serial/by-id
            path = os.path.realpath(path)
        listed = [port for port in plugged_in if port.path == path]
        return listed or [
            FoundDevice(driver="serial", name=path, serial="", path=path, transport="serial")
        ]
    if (serial := options.get("serial")) is not None:
        plugged_in = [port for port in plugged_in if port.serial == serial]
    if not plugged_in:
        of = "" if serial is None else f" of serial '{serial}'"
        raise DeviceError(
            f"no serial port{of} is plugged in on USB; name one that is not on USB: 'serial:PORT'"
        )
    return plugged_in


def _first_answer(
    candidates: Iterable[FoundDevice],
    ports: SystemPorts,
    bauds: tuple[int, ...],
    notify: Notify,
    options: Mapping[str, object],
) -> tuple[FoundDevice, tuple[SerialLink, int]]:
    reasons = []
    for plugged in candidates:
        notify(f"asking {plugged.path}")
        try:
            return plugged, connect(ports, plugged, bauds, HexLog.from_options(options))
        except DeviceError as error:
            reasons.append(str(error))
    raise DeviceError("; ".join(reasons))


def find() -> list[FoundDevice]:
    """Lists the serial ports on USB, of which any may be a board of this protocol."""
    return SystemPorts().found()


DRIVER = Driver(
    name="serial",
    about="home-made devices with our open protocol on a serial port (Hapkit, Arduino, ESP32)",
    ids=(),
    transport="serial",
    axes="1 to 6, as built",
    force="as built",
    rate="as built; 500 Hz on a Hapkit",
    options={
        "port": str,
        "baud": int,
        "serial": str,
        "log": str,
        **dict.fromkeys((*CHANGES, *GRIP_CHANGES), float),
    },
    open=open_serial,
    on_stall=f"its watchdog ends the force after {1e3 * MIN_WATCHDOG:g} ms, if it was built "
    "to the protocol",
    has_guardian=True,
    find=find,
    first="port",
    document=DOCUMENT,
    products="a serial port on USB",
)
"""Driver of home-made devices on a serial port."""
