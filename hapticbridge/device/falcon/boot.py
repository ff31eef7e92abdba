"""How a Falcon is brought to speak: its serial bridge, its loader, and one question at a time.

The Falcon is a signal processor behind an FTDI serial bridge. Without power it forgets its program,
so the host sends it: at 9600 baud the loader is greeted, at 140000 baud it takes the program in
pieces and sends each back, which is all the check there is; then both go to 1.5 Mbaud and packets
(``packets``). The program is the maker's and is not shipped here.

Requests of the bridge, all without data (FTDI's names and numbers): 0 reset (value 1 empties what
came from the device, 2 what goes to it), 1 modem lines, 2 flow control, 3 baud rate, 4 data format,
6 event character, 9 latency timer in ms.

References:
    libnifalcon's source (2019) for the sequence. No device has been asked.
"""

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
"""In bytes. The four images known have 7324 to 8492; a larger file is another file."""

CHUNK = 62
"""Bytes of the program per piece: what fits beside the status bytes into one packet back."""

GREETINGS = 100
"""How often the loader is greeted, as libnifalcon does, before it is given up: 10 s in all."""

ANSWER_TIME = 0.1
"""In s: how long one answer is waited for. The slowest, a piece of the program at 140000 baud, is
on the line for 9 ms, there and back, and in the bridge for up to 16."""

PROBES = 20
"""Packets that a Falcon is asked with before it counts as not speaking: the first ones after a
change of baud rate may be lost."""

PROBE_TIME = 0.02
"""In s: how long each of them is waited for; a reply is there within 1.3 ms."""

_RESET, _MODEM, _FLOW, _BAUD, _FORMAT, _EVENT, _LATENCY = 0, 1, 2, 3, 4, 6, 9
_EMPTY_INPUT, _EMPTY_OUTPUT = 1, 2
_DTR_LOW, _DTR_HIGH, _RTS_LOW = 0x0100, 0x0101, 0x0200
_BAUD_GREETING, _BAUD_LOADING, _BAUD_RUNNING = 0x4138, 0x0015, 0x0002
_HELLO, _HELLO_ANSWER, _LOAD = b"\x0aC\x0d", b"\x0aD,\x0d", b"A"
_EVENT_AT_END = 0x0100 | ord(">")
_WRITE_MS = 100  # outside the loop a write may take its time
_NO_MOTORS = np.zeros(3, np.int64)


class Link(Protocol):
    """What the codec needs of a USB link; ``UsbLink`` is the real one."""

    def now(self) -> float:
        """Returns the time in s of a clock that only grows."""

    def control(self, request: int, value: int) -> None:
        """Sends a vendor's request without data."""

    def write(self, packet: array.array[int], timeout_ms: int = ...) -> bool:
        """Sends a packet; returns False where the device did not take it in time."""

    def take(self) -> list[bytes]:
        """Returns the packets that came since the last call, without waiting."""

    def wait(self, timeout: float) -> None:
        """Returns as soon as a packet is there, at the latest after ``timeout`` s."""

    def close(self) -> None:
        """Lets the device go."""


def read_firmware(path: str) -> bytes:
    """Reads a program for the Falcon.

    Raises:
        DeviceError: There is no such file, it cannot be read, or it cannot be one.
    """
    try:
        image = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DeviceError(f"firmware = '{path}': cannot be read ({reason})") from None
    if not 0 < len(image) <= LARGEST_FIRMWARE:
        raise DeviceError(
            f"firmware = '{path}': has {len(image)} bytes; a Falcon's program has 1 to "
            f"{LARGEST_FIRMWARE}"
        )
    return image


def enter_run_mode(link: Link) -> None:
    """Sets the bridge to packets: 1.5 Mbaud, and the shortest wait before it passes a reply on.

    That wait, the latency timer, is 1 ms. The event character asks the bridge to pass on at once
    what ends with '>'; whether a Falcon's bridge heeds it is measured, not assumed.
    """
    link.control(_LATENCY, 1)
    link.control(_BAUD, _BAUD_RUNNING)
    link.control(_EVENT, _EVENT_AT_END)
    link.control(_RESET, _EMPTY_INPUT)
    link.control(_RESET, _EMPTY_OUTPUT)


def send_question(link: Link, flags: int = 0) -> None:
    """Sends a packet without force, and waits for nothing; ``flags`` are ``Request`` bits."""
    packet = array.array("B", bytes(SIZE))
    encode(_NO_MOTORS, flags, np.frombuffer(packet, np.uint8))
    link.write(packet, _WRITE_MS)


def ask(link: Link, stream: ReplyStream, flags: int, timeout: float) -> bool:
    """Sends a packet without force and waits for the reply.

    Args:
        link: To the Falcon, in run mode.
        stream: Takes the reply.
        flags: ``Request`` bits.
        timeout: Longest wait in s.

    Returns:
        Whether there was a reply in time.
    """
    send_question(link, flags)
    return answers(link, stream, timeout) > 0


def answers(link: Link, stream: ReplyStream, timeout: float) -> int:
    """Waits until at least one reply is there; returns how many there are, 0 if none comes.

    Args:
        link: To the Falcon, in run mode.
        stream: Takes them.
        timeout: Longest wait in s.
    """
    end = link.now() + timeout
    found = 0
    while not found and (left := end - link.now()) > 0:
        link.wait(left)
        for packet in link.take():
            found += stream.feed(packet)
    return found


def speaks(link: Link, stream: ReplyStream) -> bool:
    """Returns whether a Falcon in run mode answers packets: whether it has its program."""
    return any(ask(link, stream, 0, PROBE_TIME) for _ in range(PROBES))


def upload(link: Link, image: bytes, name: str, tell: Tell) -> None:
    """Gives a Falcon its program.

    Args:
        link: To the Falcon.
        image: The program.
        name: What errors call the device.
        tell: Told how far it is, at every quarter.

    Raises:
        DeviceError: The loader does not answer, or sent back something else than was sent.
        DeviceLost: It is gone.
    """
    _greet(link, name)
    link.control(_MODEM, _DTR_LOW)
    link.control(_BAUD, _BAUD_LOADING)
    if _echo(link, _LOAD) != _LOAD:
        raise DeviceError(f"{name}: its loader does not begin to load; switch its power off and on")
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
        # a zero byte may come before the answer, from the line's being switched
        if _echo(link, _HELLO, len(_HELLO_ANSWER)).lstrip(b"\0") == _HELLO_ANSWER:
            return
    raise DeviceError(f"{name}: its loader does not answer; switch its power off and on")


def _echo(link: Link, data: bytes, length: int | None = None) -> bytes:
    """Sends bytes; returns what comes back within ``ANSWER_TIME``, as many by default."""
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
    for i, (there, back) in enumerate(zip(sent, echo, strict=False)):
        if there != back:
            return f"0x{back:02x} for byte {start + i} (0x{there:02x})"
    return f"{len(echo)} bytes for the {len(sent)} from byte {start} on"
