"""A wheel behind the calls on Linux's input devices, in virtual time.

Written from ``linux/input.h``, not from the driver: events of 24 bytes, effects of 48, requests by
number and size. It behaves as the kernel's core of force feedback does: an effect belongs to its
file, plays for its length, and ends when the file is closed.
"""

from __future__ import annotations

import errno
import math
import struct
from dataclasses import dataclass, field
from typing import Any

from emulated.handle import Handle
from hapticbridge.device import SimulatedDevice

PATH = "/dev/input/event7"

_EV_SYN, _EV_KEY, _EV_ABS, _EV_FF = 0, 1, 3, 0x15
_SYN_DROPPED, _QUEUE = 3, 64
_CONSTANT, _RUMBLE, _GAIN, _AUTOCENTER = 0x52, 0x50, 0x60, 0x61
_ROOM = 4
"""Effects that fit into the device."""


@dataclass
class Effect:
    """An effect in the device; ``until`` is the time in s at which it ends, 0 if it is stopped."""

    level: int = 0
    direction: int = 0
    length: float = 0.0
    until: float = 0.0


@dataclass
class WheelModel:
    """A wheel, and the calls of the kernel on it.

    Attributes:
        mechanics: What turns.
        strength: Torque in N m at full level.
        degrees: Rotation from stop to stop.
        can_push: Whether it has a constant force, or only shakes.
        counts: Range of its axis.
        now: In s.
        is_plugged: Whether it is there.
        allows: Whether this user may open the node.
        buttons: Codes of the buttons that are pressed.
    """

    mechanics: SimulatedDevice = field(default_factory=SimulatedDevice)
    strength: float = 2.0
    degrees: float = 900.0
    can_push: bool = True
    counts: tuple[int, int] = (0, 65535)
    now: float = 0.0
    is_plugged: bool = True
    allows: bool = True
    buttons: set[int] = field(default_factory=set)
    effects: dict[int, Effect] = field(default_factory=dict)
    gain: int = 0x4000
    autocenter: int = 0xFFFF
    uploads: int = 0
    files: int = 0

    def __post_init__(self) -> None:
        self._handle = Handle(self.mechanics)
        self._angle = self._turns = 0.0
        self._events: list[bytes] = []
        self._told = self.count()
        self._handle.advance(0.0)

    # what a test does

    def advance(self, now: float) -> None:
        while self.now + 1e-3 <= now + 1e-9:  # it reports at 1 kHz
            self.now += 1e-3
            self._handle.force[5] = self.torque()
            self._handle.advance(self.now)
            w, z = self._handle.pose()[1][[0, 3]]
            angle = 2.0 * math.atan2(z, w)
            self._turns += round((self._angle - angle) / (2.0 * math.pi))
            self._angle = angle
            if (count := self.count()) != self._told:
                self._told = count
                self._event(_EV_ABS, 0, count)
        self.now = max(self.now, now)

    def angle(self) -> float:
        return self._angle + 2.0 * math.pi * self._turns

    def count(self) -> int:
        least, most = self.counts
        share = self.angle() / math.radians(self.degrees)
        return round(min(max(0.5 + share, 0.0), 1.0) * (most - least)) + least

    def torque(self) -> float:
        """Returns what the motor gives in N m, positive to the right."""
        total = -self.autocenter / 0xFFFF * self.angle()
        for effect in self.effects.values():
            if self.now < effect.until:
                share = effect.level / 0x7FFF * self.gain / 0xFFFF
                total -= self.strength * share * math.sin(math.pi * effect.direction / 0x8000)
        return total

    def press(self, code: int, *, is_down: bool) -> None:
        (self.buttons.add if is_down else self.buttons.discard)(code)
        self._event(_EV_KEY, code, int(is_down))

    def _event(self, kind: int, code: int, value: int) -> None:
        news = [struct.pack("<qqHHi", 0, 0, *words) for words in ((kind, code, value), (0, 0, 0))]
        if len(self._events) + len(news) > _QUEUE:  # all is lost, and said to be
            self._events = [struct.pack("<qqHHi", 0, 0, _EV_SYN, _SYN_DROPPED, 0)]
        else:
            self._events += news

    # the kernel's side

    def nodes(self) -> list[str]:
        return ["/dev/input/event0", PATH] if self.is_plugged else ["/dev/input/event0"]

    def open(self, path: str) -> int:
        if path != PATH or not self.allows:
            raise PermissionError(errno.EACCES, "Permission denied")
        self.files += 1
        return 40

    def close(self, file: int) -> None:
        assert file == 40
        self.files -= 1
        if self.files == 0:
            self.effects.clear()

    def ioctl(self, file: int, request: int, argument: Any) -> None:
        self._require(file)
        size, number = request >> 16 & 0x3FFF, request & 0xFF
        assert request >> 8 & 0xFF == ord("E")
        if request == 0x80084502:
            argument[:] = struct.pack("<4H", 3, 0x046D, 0xC24F, 0x111)
        elif number == 0x06:
            argument[:14] = b"Racing Wheel\0\0"
        elif number == 0x08:
            raise OSError(errno.ENOENT, "No such file or directory")
        elif number == 0x18:
            self._bits(argument, self.buttons)
        elif request == 0x40304580:
            self._upload(argument)
        elif request == 0x40044581:
            del self.effects[argument]
        elif request == 0x80184540:
            argument[:] = struct.pack("<6i", self.count(), *self.counts, 0, 0, 0)
        elif 0x20 <= number < 0x40:
            kinds = {_CONSTANT, _GAIN, _AUTOCENTER} if self.can_push else {_RUMBLE, _GAIN}
            has = {_EV_KEY: {30, 0x120, 0x121, 0x122}, _EV_ABS: {0, 1}, _EV_FF: kinds}
            self._bits(argument, has[number - 0x20])
            assert size == len(argument)
        else:
            raise OSError(errno.EINVAL, "Invalid argument")

    def read(self, file: int, size: int) -> bytes:
        self._require(file)
        if not self._events:
            raise BlockingIOError(errno.EAGAIN, "nothing")
        count = size // 24
        taken, self._events = self._events[:count], self._events[count:]
        return b"".join(taken)

    def write(self, file: int, data: bytes) -> None:
        self._require(file)
        _, _, kind, code, value = struct.unpack("<qqHHi", data)
        assert kind == _EV_FF
        if code == _GAIN:
            self.gain = value
        elif code == _AUTOCENTER:
            self.autocenter = value
        else:
            effect = self.effects[code]
            effect.until = self.now + (effect.length or math.inf) if value else 0.0

    def _upload(self, argument: bytearray) -> None:
        words = struct.unpack_from("<HhHHHHHxxh4H", argument)
        kind, number, direction, button, interval, length, delay, level, *envelope = words
        assert (kind, button, interval, delay, envelope) == (_CONSTANT, 0, 0, 0, [0] * 4)
        self.uploads += 1
        if number < 0:
            number = len(self.effects)
            if number >= _ROOM:
                raise OSError(errno.ENOSPC, "No space left on device")
            struct.pack_into("<h", argument, 2, number)
            self.effects[number] = Effect()
        effect = self.effects[number]
        effect.level, effect.direction, effect.length = level, direction, 1e-3 * length

    def _require(self, file: int) -> None:
        assert file == 40
        if not self.is_plugged:
            raise OSError(errno.ENODEV, "No such device")

    @staticmethod
    def _bits(argument: bytearray, codes: set[int]) -> None:
        for code in codes:
            if code // 8 < len(argument):
                argument[code // 8] |= 1 << code % 8
