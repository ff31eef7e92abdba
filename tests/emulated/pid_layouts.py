"""Two report descriptors of a force-feedback stick, and what lies where in their reports.

Both are made from one table each, which the model reads and writes its reports with. Nothing here
parses a descriptor, so the driver's parser has nothing to agree with but the standard; the kernel's
own driver reads the same bytes in the guest.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

IN, OUT, FEATURE = 0x80, 0x90, 0xB0
DESKTOP, BUTTON, ORDINAL, PID = 0x01 << 16, 0x09 << 16, 0x0A << 16, 0x0F << 16

_PHYSICAL, _APPLICATION, _LOGICAL = 0, 1, 2
_MILLISECONDS = (0x1003, -3)


@dataclass(frozen=True, kw_only=True)
class Part:
    """One value of a report.

    Attributes:
        name: What the model calls it; empty: padding.
        usage: With its page above.
        bits: How wide it is.
        low: Least logical value.
        high: Most.
        within: Usage of a collection of its own, 0: none.
        choices: Usages of an array; the value counts them from ``low``.
        unit: Code and exponent.
    """

    name: str = ""
    usage: int = 0
    bits: int = 8
    low: int = 0
    high: int = 255
    within: int = 0
    choices: tuple[int, ...] = ()
    unit: tuple[int, int] = (0, 0)


@dataclass(frozen=True, kw_only=True)
class Report:
    """A report: its kind, number, the usage of its collection (0: none), and its parts."""

    kind: int
    number: int
    usage: int
    parts: tuple[Part, ...]

    @property
    def length(self) -> int:
        return 1 + (sum(part.bits for part in self.parts) + 7) // 8

    def packed(self, **values: int) -> bytes:
        """Returns the report with these values, a name each; all others zero."""
        bits, place = self.number, 8
        for part in self.parts:
            bits |= (values.get(part.name, 0) & ((1 << part.bits) - 1)) << place
            place += part.bits
        return bits.to_bytes(self.length, "little")

    def unpacked(self, data: bytes) -> dict[str, int]:
        """Returns the values by name; what is missing at the end is zero."""
        bits, place, values = int.from_bytes(data, "little"), 8, {}
        for part in self.parts:
            value = bits >> place & ((1 << part.bits) - 1)
            is_negative = part.low < 0 and value >> (part.bits - 1)
            values[part.name] = value - (1 << part.bits) if is_negative else value
            place += part.bits
        return values

    def part(self, name: str) -> Part:
        return next(part for part in self.parts if part.name == name)

    def chosen(self, name: str, value: int) -> int:
        """Returns the usage that an array's value stands for, its page left out; 0: none."""
        part = self.part(name)
        index = value - part.low
        return part.choices[index] & 0xFFFF if 0 <= index < len(part.choices) else 0


def _item(tag: int, value: int, *, is_signed: bool = False) -> bytes:
    for size, code in ((1, 1), (2, 2), (4, 3)):
        try:
            return bytes([tag | code]) + value.to_bytes(size, "little", signed=is_signed)
        except OverflowError:
            continue
    raise ValueError(value)


def _usage(usage: int) -> bytes:
    return bytes([0x0B]) + usage.to_bytes(4, "little")  # with its page, so none need be set


def _part(kind: int, part: Part) -> bytes:
    range_ = _item(0x14, part.low, is_signed=True) + _item(0x24, part.high, is_signed=True)
    # a physical range of zero: the same as the logical one
    scale = b"\x35\x00\x45\x00" + _item(0x64, part.unit[0]) + _item(0x54, part.unit[1] & 0x0F)
    size = _item(0x74, part.bits) + b"\x95\x01"
    if not part.name:
        return size + _item(kind, 3)
    usages = part.choices or (part.usage,)
    flags = 0 if part.choices else 2
    return b"".join(map(_usage, usages)) + range_ + scale + size + _item(kind, flags)


def descriptor(reports: Iterable[Report]) -> bytes:
    """Returns the report descriptor of a joystick with these reports."""
    body = bytes.fromhex("0501 0904 a101")  # joystick, application
    for report in reports:
        inner = _item(0x84, report.number)
        for within, parts in groupby(report.parts, lambda part: part.within):
            fields = b"".join(_part(report.kind, part) for part in parts)
            if within:
                fields = _usage(within) + bytes([0xA1, _LOGICAL]) + fields + b"\xc0"
            inner += fields
        if report.usage:
            kind = _PHYSICAL if report.usage >> 16 == 1 else _LOGICAL
            inner = _usage(report.usage) + bytes([0xA1, kind]) + inner + b"\xc0"
        body += inner
    return body + b"\xc0"


def _choice(name: str, within: int, usages: Iterable[int], bits: int = 8) -> Part:
    choices = tuple(PID | usage for usage in usages)
    return Part(
        name=name, within=PID | within, choices=choices, bits=bits, low=1, high=len(choices)
    )


def _padding(bits: int) -> Part:
    return Part(bits=bits)


def _index(bits: int = 8) -> Part:
    return Part(name="index", usage=PID | 0x22, bits=bits, low=1, high=40)


def _time(name: str, usage: int, bits: int = 16, high: int = 32767) -> Part:
    return Part(name=name, usage=PID | usage, bits=bits, high=high, unit=_MILLISECONDS)


def _bit(name: str, usage: int, within: int = 0) -> Part:
    return Part(name=name, usage=usage, bits=1, high=1, within=within)


def _envelope(number: int, index: int, bits: int) -> Report:
    """Returns the report of what the model has no use for; the kernel wants it to be there."""
    parts = ("attack_level", 0x5B), ("fade_level", 0x5D)
    times = ("attack_time", 0x5C), ("fade_time", 0x5E)
    return Report(
        kind=OUT,
        number=number,
        usage=PID | 0x5A,
        parts=(
            _index(index),
            *(Part(name=name, usage=PID | usage, bits=bits) for name, usage in parts),
            *(_time(name, usage) for name, usage in times),
        ),
    )


USUAL: dict[str, Report] = {
    "state": Report(
        kind=IN,
        number=1,
        usage=DESKTOP | 1,
        parts=(
            Part(name="x", usage=DESKTOP | 0x30, bits=16, low=-32767, high=32767),
            Part(name="y", usage=DESKTOP | 0x31, bits=16, low=-32767, high=32767),
            *(_bit(f"button{i}", BUTTON | i) for i in range(1, 9)),
        ),
    ),
    "effect": Report(
        kind=OUT,
        number=1,
        usage=PID | 0x21,
        parts=(
            _index(),
            _choice("type", 0x25, (0x26, 0x27, 0x30, 0x31, 0x40, 0x41, 0x42, 0x43)),
            _time("duration", 0x50),
            _time("trigger_repeat", 0x54),
            _time("sample_period", 0x51),
            _time("delay", 0xA7),
            Part(name="gain", usage=PID | 0x52),
            Part(name="trigger", usage=PID | 0x53, low=1, high=8),
            _bit("enable_x", DESKTOP | 0x30, PID | 0x55),
            _bit("enable_y", DESKTOP | 0x31, PID | 0x55),
            _bit("by_direction", PID | 0x56),
            _padding(5),
            Part(
                name="direction",
                usage=ORDINAL | 1,
                bits=16,
                high=35999,
                within=PID | 0x57,
                unit=(0x14, -2),
            ),
            Part(
                name="elevation",
                usage=ORDINAL | 2,
                bits=16,
                high=35999,
                within=PID | 0x57,
                unit=(0x14, -2),
            ),
        ),
    ),
    "force": Report(
        kind=OUT,
        number=5,
        usage=PID | 0x73,
        parts=(_index(), Part(name="magnitude", usage=PID | 0x70, bits=16, low=-32767, high=32767)),
    ),
    "envelope": _envelope(2, 8, 8),
    "operation": Report(
        kind=OUT,
        number=10,
        usage=PID | 0x77,
        parts=(
            _index(),
            _choice("operation", 0x78, (0x79, 0x7A, 0x7B)),
            Part(name="loops", usage=PID | 0x7C),
        ),
    ),
    "free": Report(kind=OUT, number=11, usage=PID | 0x90, parts=(_index(),)),
    "control": Report(
        kind=OUT,
        number=12,
        usage=PID | 0x95,
        parts=(_choice("control", 0x96, (0x97, 0x98, 0x99, 0x9A, 0x9B, 0x9C)),),
    ),
    "gain": Report(
        kind=OUT, number=13, usage=PID | 0x7D, parts=(Part(name="gain", usage=PID | 0x7E),)
    ),
    "create": Report(
        kind=FEATURE,
        number=5,
        usage=PID | 0xAB,
        parts=(
            _choice("type", 0x25, (0x26, 0x27, 0x30, 0x31, 0x40, 0x41, 0x42, 0x43)),
            Part(name="bytes", usage=DESKTOP | 0x3B, bits=10, high=511),
            _padding(6),
        ),
    ),
    "load": Report(
        kind=FEATURE,
        number=6,
        usage=PID | 0x89,
        parts=(
            _index(),
            _choice("status", 0x8B, (0x8C, 0x8D, 0x8E)),
            Part(name="memory", usage=PID | 0xAC, bits=16, high=32767),
        ),
    ),
    "pool": Report(
        kind=FEATURE,
        number=7,
        usage=PID | 0x7F,
        parts=(
            Part(name="memory", usage=PID | 0x80, bits=16, high=32767),
            Part(name="most", usage=PID | 0x83, high=127),
            _bit("managed", PID | 0xA9),
            _bit("shared", PID | 0xAA),
            _padding(6),
        ),
    ),
}
"""As most makers copy it from the standard's example."""

ODD: dict[str, Report] = {
    "pool": Report(
        kind=FEATURE,
        number=0x21,
        usage=PID | 0x7F,
        parts=(
            _bit("managed", PID | 0xA9),
            _padding(3),
            Part(name="most", usage=PID | 0x83, bits=5, high=31),
            Part(name="memory", usage=PID | 0x80, bits=15, high=32767),
        ),
    ),
    "control": Report(
        kind=OUT,
        number=0x30,
        usage=PID | 0x95,
        parts=(_choice("control", 0x96, (0x9C, 0x9B, 0x9A, 0x99, 0x98, 0x97), bits=4), _padding(4)),
    ),
    "force": Report(
        kind=OUT,
        number=0x42,
        usage=PID | 0x73,
        parts=(
            Part(name="magnitude", usage=PID | 0x70, bits=11, low=-1000, high=1000),
            _padding(3),
            _index(6),
        ),
    ),
    "operation": Report(
        kind=OUT,
        number=0x43,
        usage=PID | 0x77,
        parts=(
            Part(name="loops", usage=PID | 0x7C, bits=7, high=127),
            _index(6),
            _choice("operation", 0x78, (0x7B, 0x79, 0x7A), bits=3),
        ),
    ),
    "state": Report(
        kind=IN,
        number=0x44,
        usage=DESKTOP | 1,
        parts=(
            *(_bit(f"button{i}", BUTTON | i) for i in range(1, 6)),
            Part(name="y", usage=DESKTOP | 0x31, bits=14, high=16383),
            Part(name="rudder", usage=DESKTOP | 0x35, bits=7, low=-64, high=63),
            Part(name="x", usage=DESKTOP | 0x30, bits=14, high=16383),
        ),
    ),
    "effect": Report(
        kind=OUT,
        number=0x45,
        usage=PID | 0x21,
        parts=(
            Part(name="gain", usage=PID | 0x52, bits=7, high=100),
            Part(name="direction", usage=ORDINAL | 1, bits=9, high=359, within=PID | 0x57),
            _bit("by_direction", PID | 0x56),
            _choice("type", 0x25, (0x43, 0x41, 0x40, 0x31, 0x26), bits=5),
            _index(6),
            Part(name="trigger", usage=PID | 0x53, bits=4, low=1, high=5),
            # hundredths of a second
            Part(name="duration", usage=PID | 0x50, bits=12, high=4095, unit=(0x1003, -2)),
            _time("trigger_repeat", 0x54, 11, 2047),
            _time("delay", 0xA7, 11, 2047),
            _bit("enable_y", DESKTOP | 0x31, PID | 0x55),
            _bit("enable_x", DESKTOP | 0x30, PID | 0x55),
        ),
    ),
    "envelope": _envelope(0x48, 6, 9),
    "load": Report(
        kind=FEATURE,
        number=0x22,
        usage=PID | 0x89,
        parts=(
            Part(name="memory", usage=PID | 0xAC, bits=15, high=32767),
            _choice("status", 0x8B, (0x8E, 0x8D, 0x8C), bits=3),
            _index(6),
        ),
    ),
    "create": Report(
        kind=FEATURE,
        number=0x23,
        usage=PID | 0xAB,
        parts=(
            Part(name="bytes", usage=DESKTOP | 0x3B, bits=11, high=511),
            _choice("type", 0x25, (0x43, 0x41, 0x40, 0x31, 0x26), bits=5),
        ),
    ),
    "free": Report(kind=OUT, number=0x46, usage=PID | 0x90, parts=(_padding(2), _index(6))),
    "gain": Report(
        kind=OUT,
        number=0x47,
        usage=PID | 0x7D,
        parts=(Part(name="gain", usage=PID | 0x7E, bits=10, high=1000),),
    ),
}
"""Other numbers, widths, ranges and order, as the standard allows: whoever takes a number or a
place for granted fails on one of the two."""
