"""Boot protocol of a Falcon: serial bridge and loader."""

from __future__ import annotations

import array
from pathlib import Path
from typing import Protocol

import numpy as np

from hapticbridge.device.falcon.packets import SIZE, STATUS, ReplyStream, encode
from hapticbridge.device.plugged import Tell
from hapticbridge.errors import DeviceError

READ_FROM, WRITE_TO = 0x81, 0x02
"""Addresses of its bulk endpoints."""

LARGEST_FIRMWARE = 65536
"""Largest firmware file in bytes. The four known images have 7324 to 8492 bytes; a larger file is
not firmware."""

CHUNK = 62
"""Bytes of firmware per piece. The returned piece fits into one packet together with the status
bytes."""

GREETINGS = 100
"""Number of greetings to the loader, as in libnifalcon, before the boot fails: 10 s in all."""

ANSWER_TIME = 0.1
"""Longest wait for one answer of the loader in s. The slowest answer, a piece of firmware at 140000
baud, takes 9 ms on the line in both directions and up to 16 ms in the bridge."""

PROBES = 20
"""Number of packets without a reply after which a Falcon counts as not running. The first packets
after a change of baud rate may be lost."""

PROBE_TIME = 0.02
"""Longest wait for the reply to a probe in s; a reply takes up to 1.3 ms."""

_RESET, _MODEM, _FLOW, _BAUD, _FORMAT, _EVENT, _LATENCY = 0, 1, 2, 3, 4, 6, 9
_EMPTY_INPUT, _EMPTY_OUTPUT = 1, 2
_DTR_LOW, _DTR_HIGH, _RTS_LOW = 0x0100, 0x0101, 0x0200
_BAUD_GREETING, _BAUD_LOADING, _BAUD_RUNNING = 0x4138, 0x0015, 0x0002
_HELLO, _HELLO_ANSWER, _LOAD = b"\x0aC\x0d", b"\x0aD,\x0d", b"A"
_EVENT_AT_END = 0x0100 | ord(">")
_WRITE_MS = 100  # writes outside the loop are not urgent
_NO_MOTORS = np.zeros(3, np.int64)


class Link(Protocol):
    """USB link of a Falcon; ``UsbLink`` is the real one."""

    def now(self) -> float:
        """Returns the time of a monotonic clock in s."""

    def control(self, request: int, value: int) -> None:
        """Sends a vendor request without data.

        The serial bridge is an FTDI chip; its requests have FTDI's numbers. 0 is reset, with value
        1 for the data from the device and 2 for the data to it. 1 sets modem lines, 2 flow control,
        3 the baud rate, 4 the data format, 6 the event character, 9 the latency timer in ms.
        """

    def write(self, packet: array.array[int], timeout_ms: int = ...) -> bool:
        """Sends a packet; returns False if the device did not accept it in time."""

    def take(self) -> list[bytes]:
        """Returns the packets received since the last call, without waiting."""

    def wait(self, timeout: float) -> None:
        """Returns as soon as a packet is available, at the latest after ``timeout`` s."""

    def close(self) -> None:
        """Releases the device."""


def read_firmware(path: str) -> bytes:
    """Reads a firmware file for the Falcon. The firmware belongs to the maker and is not shipped.

    Raises:
        DeviceError: The file does not exist, cannot be read, or has an impossible size.
    """
    try:
        image = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DeviceError(f"firmware = '{path}': cannot be read ({reason})") from None
    if not 0 < len(image) <= LARGEST_FIRMWARE:
        raise DeviceError(
            f"firmware = '{path}': has {len(image)} bytes; a Falcon's firmware has 1 to "
            f"{LARGEST_FIRMWARE}"
        )
    return image


def enter_run_mode(link: Link) -> None:
    """Sets the bridge to packets at 1.5 Mbaud with the shortest latency.

    The latency timer is set to 1 ms. The event character requests immediate delivery of data that
    ends with '>'. Whether a Falcon's bridge obeys it is measured (``measured_timing``).
    """
    link.control(_LATENCY, 1)
    link.control(_BAUD, _BAUD_RUNNING)
    link.control(_EVENT, _EVENT_AT_END)
    link.control(_RESET, _EMPTY_INPUT)
    link.control(_RESET, _EMPTY_OUTPUT)


def send_question(link: Link, flags: int = 0) -> None:
    """Sends a packet without force and returns at once; ``flags`` are ``Request`` bits."""
    packet = array.array("B", bytes(SIZE))
    encode(_NO_MOTORS, flags, np.frombuffer(packet, np.uint8))
    link.write(packet, _WRITE_MS)


def ask(link: Link, stream: ReplyStream, flags: int, timeout: float) -> bool:
    """Sends a packet without force and returns whether a reply came within ``timeout`` s."""
    send_question(link, flags)
    return answers(link, stream, timeout) > 0


def answers(link: Link, stream: ReplyStream, timeout: float) -> int:
    """Waits up to ``timeout`` s for at least one reply, and returns the number of replies."""
    end = link.now() + timeout
    found = 0
    while not found and (left := end - link.now()) > 0:
        link.wait(left)
        for packet in link.take():
            found += stream.feed(packet)
    return found


def speaks(link: Link, stream: ReplyStream) -> bool:
    """Returns whether a Falcon in run mode answers packets, that is whether it has its firmware."""
    return any(ask(link, stream, 0, PROBE_TIME) for _ in range(PROBES))


def upload(link: Link, image: bytes, name: str, tell: Tell) -> None:
    """Loads the firmware into a Falcon, which loses it without power.

    At 9600 baud the loader is greeted. At 140000 baud it receives the firmware in pieces and
    returns each, which is the only check. ``tell`` receives the progress at every quarter.

    Raises:
        DeviceError: The loader does not answer, or returned other bytes than it received.

    References:
        libnifalcon's source (2019) for the sequence; not verified on hardware.
    """
    _greet(link, name)
    link.control(_MODEM, _DTR_LOW)
    link.control(_BAUD, _BAUD_LOADING)
    if _echo(link, _LOAD) != _LOAD:
        raise DeviceError(f"{name}: its loader does not start to load; switch its power off and on")
    quarter = 0
    for start in range(0, len(image), CHUNK):
        piece = image[start : start + CHUNK]
        if (echo := _echo(link, piece)) != piece:
            raise DeviceError(
                f"{name}: sent back {_difference(piece, echo, start)} of its firmware; switch its "
                "power off and on, and try again"
            )
        done = 4 * (start + len(piece)) // len(image)
        if done > quarter:
            quarter = done
            tell(f"{name}: firmware {25 * quarter} % loaded")


def _greet(link: Link, name: str) -> None:
    for request, value in (
        (_RESET, _EMPTY_INPUT),
        (_RESET, _EMPTY_OUTPUT),
        (_LATENCY, 16),
        (_BAUD, _BAUD_GREETING),
        (_FORMAT, 8),
        (_FLOW, 0),
        (_MODEM, _RTS_LOW),
        (_MODEM, _DTR_LOW),
        (_MODEM, _DTR_HIGH),
    ):
        link.control(request, value)
    link.take()
    for _ in range(GREETINGS):
        # switching the line may insert a zero byte before the answer
        if _echo(link, _HELLO, len(_HELLO_ANSWER)).lstrip(b"\0") == _HELLO_ANSWER:
            return
    raise DeviceError(f"{name}: its loader does not answer; switch its power off and on")


def _echo(link: Link, data: bytes, length: int | None = None) -> bytes:
    """Sends bytes and returns the answer within ``ANSWER_TIME``, by default of equal length."""
    wanted = len(data) if length is None else length
    link.write(array.array("B", data), _WRITE_MS)
    end = link.now() + ANSWER_TIME
    answer = b""
    while len(answer.lstrip(b"\0") if length else answer) < wanted:
        if (left := end - link.now()) <= 0:
            break
        link.wait(left)
        answer += b"".join(packet[STATUS:] for packet in link.take())
    return answer


def _difference(sent: bytes, echo: bytes, start: int) -> str:
    for i, (sent_byte, returned_byte) in enumerate(zip(sent, echo, strict=False)):
        if sent_byte != returned_byte:
            return f"0x{returned_byte:02x} for byte {start + i} (0x{sent_byte:02x})"
    return f"{len(echo)} bytes for the {len(sent)} from byte {start} on"
