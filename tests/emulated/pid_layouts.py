"""Two report descriptors of a force-feedback stick, and what lies where in their reports.

Both are made from one table each, which the model reads and writes its reports with. Nothing here
parses a descriptor, so the driver's parser has nothing to agree with but the standard; the kernel's
own driver reads the same bytes in the guest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby

IN, OUT, FEATURE = 0x80, 0x90, 0xB0
DESKTOP, BUTTON, ORDINAL, PID = 0x01 << 16, 0x09 << 16, 0x0A << 16, 0x0F << 16

_PHYSICAL, _APPLICATION, _LOGICAL = 0, 1, 2
_MILLISECONDS = (0x1003, -3)


@dataclass(frozen=True)
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
    return Part(name, 0, bits, 1, len(choices), PID | within, choices)


def _padding(bits: int) -> Part:
    return Part(bits=bits)


def _index(bits: int = 8) -> Part:
    return Part("index", PID | 0x22, bits, 1, 40)


def _time(name: str, usage: int, bits: int = 16, high: int = 32767) -> Part:
    return Part(name, PID | usage, bits, 0, high, unit=_MILLISECONDS)


def _bit(name: str, usage: int, within: int = 0) -> Part:
    return Part(name, usage, 1, 0, 1, within)


def _angle(name: str, number: int) -> Part:
    return Part(name, ORDINAL | number, 16, 0, 35999, PID | 0x57, unit=(0x14, -2))


def _envelope(index: int, bits: int) -> tuple[Part, ...]:
    """Returns the parts of what the model has no use for; the kernel wants it to be there."""
    levels = (Part(name, PID | usage, bits) for name, usage in (("attack", 0x5B), ("fade", 0x5D)))
    times = (_time(name, usage) for name, usage in (("attack_time", 0x5C), ("fade_time", 0x5E)))
    return (_index(index), *levels, *times)


def _layout(table: Mapping[tuple[str, int, int, int], tuple[Part, ...]]) -> dict[str, Report]:
    """Returns reports by name; a key is name, kind, number, and usage of the collection."""
    return {
        name: Report(kind=kind, number=number, usage=usage, parts=parts)
        for (name, kind, number, usage), parts in table.items()
    }


_EFFECTS = (0x26, 0x27, 0x30, 0x31, 0x40, 0x41, 0x42, 0x43)

USUAL = _layout(
    {
        ("state", IN, 1, DESKTOP | 1): (
            Part("x", DESKTOP | 0x30, 16, -32767, 32767),
            Part("y", DESKTOP | 0x31, 16, -32767, 32767),
            *(_bit(f"button{i}", BUTTON | i) for i in range(1, 9)),
        ),
        ("effect", OUT, 1, PID | 0x21): (
            _index(),
            _choice("type", 0x25, _EFFECTS),
            _time("duration", 0x50),
            _time("trigger_repeat", 0x54),
            _time("sample_period", 0x51),
            _time("delay", 0xA7),
            Part("gain", PID | 0x52),
            Part("trigger", PID | 0x53, low=1, high=8),
            _bit("enable_x", DESKTOP | 0x30, PID | 0x55),
            _bit("enable_y", DESKTOP | 0x31, PID | 0x55),
            _bit("by_direction", PID | 0x56),
            _padding(5),
            _angle("direction", 1),
            _angle("elevation", 2),
        ),
        ("force", OUT, 5, PID | 0x73): (_index(), Part("magnitude", PID | 0x70, 16, -32767, 32767)),
        ("envelope", OUT, 2, PID | 0x5A): _envelope(8, 8),
        ("operation", OUT, 10, PID | 0x77): (
            _index(),
            _choice("operation", 0x78, (0x79, 0x7A, 0x7B)),
            Part("loops", PID | 0x7C),
        ),
        ("free", OUT, 11, PID | 0x90): (_index(),),
        ("control", OUT, 12, PID | 0x95): (_choice("control", 0x96, range(0x97, 0x9D)),),
        ("gain", OUT, 13, PID | 0x7D): (Part("gain", PID | 0x7E),),
        ("create", FEATURE, 5, PID | 0xAB): (
            _choice("type", 0x25, _EFFECTS),
            Part("bytes", DESKTOP | 0x3B, 10, 0, 511),
            _padding(6),
        ),
        ("load", FEATURE, 6, PID | 0x89): (
            _index(),
            _choice("status", 0x8B, (0x8C, 0x8D, 0x8E)),
            Part("memory", PID | 0xAC, 16, 0, 32767),
        ),
        ("pool", FEATURE, 7, PID | 0x7F): (
            Part("memory", PID | 0x80, 16, 0, 32767),
            Part("most", PID | 0x83, 8, 0, 127),
            _bit("managed", PID | 0xA9),
            _bit("shared", PID | 0xAA),
            _padding(6),
        ),
    }
)
"""As most makers copy it from the standard's example."""

_ODD_EFFECTS = (0x43, 0x41, 0x40, 0x31, 0x26)

ODD = _layout(
    {
        ("pool", FEATURE, 0x21, PID | 0x7F): (
            _bit("managed", PID | 0xA9),
            _padding(3),
            Part("most", PID | 0x83, 5, 0, 31),
            Part("memory", PID | 0x80, 15, 0, 32767),
        ),
        ("control", OUT, 0x30, PID | 0x95): (
            _choice("control", 0x96, range(0x9C, 0x96, -1), bits=4),
            _padding(4),
        ),
        ("force", OUT, 0x42, PID | 0x73): (
            Part("magnitude", PID | 0x70, 11, -1000, 1000),
            _padding(3),
            _index(6),
        ),
        ("operation", OUT, 0x43, PID | 0x77): (
            Part("loops", PID | 0x7C, 7, 0, 127),
            _index(6),
            _choice("operation", 0x78, (0x7B, 0x79, 0x7A), bits=3),
        ),
        ("state", IN, 0x44, DESKTOP | 1): (
            *(_bit(f"button{i}", BUTTON | i) for i in range(1, 6)),
            Part("y", DESKTOP | 0x31, 14, 0, 16383),
            Part("rudder", DESKTOP | 0x35, 7, -64, 63),
            Part("x", DESKTOP | 0x30, 14, 0, 16383),
        ),
        ("effect", OUT, 0x45, PID | 0x21): (
            Part("gain", PID | 0x52, 7, 0, 100),
            Part("direction", ORDINAL | 1, 9, 0, 359, PID | 0x57),
            _bit("by_direction", PID | 0x56),
            _choice("type", 0x25, _ODD_EFFECTS, bits=5),
            _index(6),
            Part("trigger", PID | 0x53, 4, 1, 5),
            # hundredths of a second
            Part("duration", PID | 0x50, 12, 0, 4095, unit=(0x1003, -2)),
            _time("trigger_repeat", 0x54, 11, 2047),
            _time("delay", 0xA7, 11, 2047),
            _bit("enable_y", DESKTOP | 0x31, PID | 0x55),
            _bit("enable_x", DESKTOP | 0x30, PID | 0x55),
        ),
        ("envelope", OUT, 0x48, PID | 0x5A): _envelope(6, 9),
        ("load", FEATURE, 0x22, PID | 0x89): (
            Part("memory", PID | 0xAC, 15, 0, 32767),
            _choice("status", 0x8B, (0x8E, 0x8D, 0x8C), bits=3),
            _index(6),
        ),
        ("create", FEATURE, 0x23, PID | 0xAB): (
            Part("bytes", DESKTOP | 0x3B, 11, 0, 511),
            _choice("type", 0x25, _ODD_EFFECTS, bits=5),
        ),
        ("free", OUT, 0x46, PID | 0x90): (_padding(2), _index(6)),
        ("gain", OUT, 0x47, PID | 0x7D): (Part("gain", PID | 0x7E, 10, 0, 1000),),
    }
)
"""Other numbers, widths, ranges and order, as the standard allows: a driver that takes a number or
a place for granted fails on one of the two."""
