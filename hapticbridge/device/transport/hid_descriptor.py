"""HID report descriptor: meaning of the bits in each report.

A report descriptor is a program for a small machine: items set the state (size, count, range,
usage) of the fields that the next main item creates. Only what is required to find fields by usage
is read; designators, strings and delimiters are skipped.

References:
    USB-IF, Device Class Definition for Human Interface Devices 1.11, sections 5 and 6.2.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field

from hapticbridge.errors import DeviceError

INPUT, OUTPUT, FEATURE = 8, 9, 11
"""Kinds of report, numbered as the main items that describe them."""

MAX_DESCRIPTOR = 4096
"""Largest descriptor in bytes, as in Linux (HID_MAX_DESCRIPTOR_SIZE)."""

MAX_REPORT_BITS = 8 * 16384
"""Largest report in bits, as in Linux (HID_MAX_BUFFER_SIZE)."""

MAX_USAGES = 1024
"""Largest number of usages kept per field. A keyboard has 256; a range of 65536 means 'any' and is
of no use."""

_MAIN, _GLOBAL, _LOCAL, _LONG = 0, 1, 2, 0xFE
_COLLECTION, _END_COLLECTION = 10, 12
_VARIABLE, _CONSTANT = 2, 1
(_PAGE, _LOGICAL_LEAST, _LOGICAL_MOST, _PHYSICAL_LEAST, _PHYSICAL_MOST, _EXPONENT, _UNIT, _SIZE,
 _REPORT, _COUNT, _PUSH, _POP) = range(12)  # fmt: skip
_USAGE, _USAGE_LEAST, _USAGE_MOST = range(3)

Number = tuple[int, int]
"""Data of an item: unsigned value, and number of bytes."""


@dataclass(frozen=True, slots=True)
class Field:
    """Field of a report: ``count`` consecutive elements of ``size`` bits.

    Attributes:
        kind: ``INPUT``, ``OUTPUT`` or ``FEATURE``.
        report: Number of the report, 0 if the device does not number them.
        offset: First bit within the report, without its number.
        size: Bits per element.
        count: Number of elements.
        is_variable: True if each element has a usage and a value of its own. Otherwise the field is
            an array: an element's value selects a usage in their order, ``minimum`` the first.
        usages: 32 bits each, with the page in the upper half; the last one applies to all further
            elements. Empty for padding.
        collections: Usages of the enclosing collections, outermost first.
        minimum: Smallest logical value.
        maximum: Largest logical value.
        physical: Smallest and largest physical value; the logical ones if the device states none.
        unit: Unit of the physical values in the standard's code; 0: none.
        exponent: Power of ten of that unit.
    """

    kind: int
    report: int
    offset: int
    size: int
    count: int
    is_variable: bool
    usages: tuple[int, ...]
    collections: tuple[int, ...]
    minimum: int
    maximum: int
    physical: tuple[int, int]
    unit: int
    exponent: int


@dataclass(slots=True)
class _State:
    """State set by the items so far."""

    globals: dict[int, Number] = dataclass_field(default_factory=dict)
    pushed: list[dict[int, Number]] = dataclass_field(default_factory=list)
    usages: list[Number] = dataclass_field(default_factory=list)
    least: Number | None = None
    collections: list[int] = dataclass_field(default_factory=list)
    lengths: dict[tuple[int, int], int] = dataclass_field(default_factory=dict)

    def value(self, item: int, *, is_signed: bool = False) -> int:
        number = self.globals.get(item, (0, 0))
        return _signed(number) if is_signed else number[0]

    def full_usages(self) -> list[int]:
        """Returns the usages since the last main item; short ones belong to the current page."""
        page = self.value(_PAGE) << 16
        return [value if size == 4 else page | value for value, size in self.usages]

    def limits(self, least: int, most: int) -> tuple[int, int]:
        """Returns a range; the upper end is signed only if the lower end is negative."""
        low = self.value(least, is_signed=True)
        return low, self.value(most, is_signed=low < 0)


def fields_of(descriptor: bytes) -> tuple[Field, ...]:
    """Returns the fields of a report descriptor; padding has no usages.

    Args:
        descriptor: Bytes of the descriptor.

    Raises:
        DeviceError: The descriptor is not valid; the message names the reason.
    """
    if not 0 < len(descriptor) <= MAX_DESCRIPTOR:
        raise DeviceError(
            f"a report descriptor has {len(descriptor)} bytes; it must have 1 to {MAX_DESCRIPTOR}"
        )
    state, fields = _State(), []
    for kind, tag, number in _items(descriptor):
        if kind == _GLOBAL:
            _set_global(state, tag, number)
        elif kind == _LOCAL:
            _set_local(state, tag, number)
        elif kind == _MAIN:
            if tag in (INPUT, OUTPUT, FEATURE):
                fields += _fields(state, tag, number[0])
            elif tag == _COLLECTION:
                state.collections.append(next(iter(state.full_usages()), 0))
            elif tag == _END_COLLECTION:
                if not state.collections:
                    raise DeviceError("a report descriptor ends a collection that never began")
                state.collections.pop()
            state.usages, state.least = [], None
    return tuple(fields)


def _items(descriptor: bytes) -> Iterator[tuple[int, int, Number]]:
    """Yields kind, tag and data of each short item; long items are skipped."""
    place = 0
    while place < len(descriptor):
        prefix = descriptor[place]
        if prefix == _LONG:
            length = 2 + (descriptor[place + 1] if place + 1 < len(descriptor) else 0)
        else:
            length = (0, 1, 2, 4)[prefix & 3]
        data = descriptor[place + 1 : place + 1 + length]
        if len(data) < length:
            raise DeviceError(f"a report descriptor ends within the item at byte {place}")
        place += 1 + length
        if prefix != _LONG:
            yield prefix >> 2 & 3, prefix >> 4, (int.from_bytes(data, "little"), length)


def _signed(number: Number) -> int:
    value, size = number
    return value - (1 << 8 * size) if size and value >> (8 * size - 1) else value


def _set_global(state: _State, tag: int, number: Number) -> None:
    if tag == _PUSH:
        state.pushed.append(dict(state.globals))
    elif tag == _POP:
        if not state.pushed:
            raise DeviceError("a report descriptor restores a state that it never stored")
        state.globals = state.pushed.pop()
    else:
        state.globals[tag] = number


def _set_local(state: _State, tag: int, number: Number) -> None:
    if tag == _USAGE:
        state.usages.append(number)
    elif tag == _USAGE_LEAST:
        state.least = number
    elif tag == _USAGE_MOST and state.least is not None:
        least, size = state.least
        room = MAX_USAGES - len(state.usages)
        last = min(number[0], least + room - 1)
        state.usages += [(usage, max(size, number[1])) for usage in range(least, last + 1)]
        state.least = None
    del state.usages[MAX_USAGES:]


def _fields(state: _State, kind: int, flags: int) -> list[Field]:
    """Returns the field created by a main item, empty for an empty one, and advances the state."""
    size, count, report = state.value(_SIZE), state.value(_COUNT), state.value(_REPORT)
    if report > 255:
        raise DeviceError(f"a report descriptor has the report number {report}; at most 255")
    offset = state.lengths.get((kind, report), 0)
    if offset + size * count > MAX_REPORT_BITS:
        raise DeviceError(
            f"a report descriptor has a report of {offset + size * count} bits; at most "
            f"{MAX_REPORT_BITS}"
        )
    state.lengths[kind, report] = offset + size * count
    usages = () if flags & _CONSTANT else tuple(state.full_usages())
    if not size or not count:
        return []
    logical = state.limits(_LOGICAL_LEAST, _LOGICAL_MOST)
    physical = state.limits(_PHYSICAL_LEAST, _PHYSICAL_MOST)
    exponent = _signed((state.value(_EXPONENT), 1)) if state.value(_EXPONENT) < 256 else 0
    if 8 <= exponent <= 15:
        exponent -= 16  # four signed bits, unless the device sent eight
    return [
        Field(
            kind=kind,
            report=report,
            offset=offset,
            size=size,
            count=count,
            is_variable=bool(flags & _VARIABLE),
            usages=usages,
            collections=tuple(state.collections),
            minimum=logical[0],
            maximum=logical[1],
            physical=physical if physical[0] < physical[1] else logical,
            unit=state.value(_UNIT),
            exponent=exponent,
        )
    ]


# Layout of a HID device's reports by usage

WIDEST = 32
"""Bits of the widest value that is read or written: the standard's own limit."""


@dataclass(frozen=True, slots=True)
class Place:
    """Place of a single value: one element of a field.

    Attributes:
        field: The field of the element.
        offset: First bit, counting the byte of the report's number.
    """

    field: Field
    offset: int

    @property
    def mask(self) -> int:
        """Mask with as many ones as the value has bits."""
        return (1 << self.field.size) - 1

    def read(self, report: int) -> int:
        """Returns the logical value in a report with its number, as one little-endian number."""
        value = report >> self.offset & self.mask
        is_negative = self.field.minimum < 0 and value >> (self.field.size - 1)
        return value - (1 << self.field.size) if is_negative else value

    def bits(self, value: int) -> int:
        """Returns a logical value, clamped to its range, as the bits of a report."""
        field = self.field
        return (min(max(value, field.minimum), field.maximum) & self.mask) << self.offset


class Layout:
    """All reports of a device, from its descriptor.

    Args:
        descriptor: The report descriptor.

    Attributes:
        fields: All fields, including padding.
        is_numbered: True if reports begin with their number.

    Raises:
        DeviceError: The descriptor is not valid.
    """

    def __init__(self, descriptor: bytes) -> None:
        self.fields = fields_of(descriptor)
        self.is_numbered = any(field.report for field in self.fields)

    def within(self, kind: int, collection: int) -> list[Field]:
        """Returns the fields of a kind inside a collection with that usage, of its first report."""
        inside = [
            field
            for field in self.fields
            if field.kind == kind and collection in field.collections and field.size <= WIDEST
        ]
        return [field for field in inside if field.report == inside[0].report]

    def length(self, kind: int, report: int) -> int:
        """Returns the length of a report in bytes, including its number."""
        ends = [
            field.offset + field.size * field.count
            for field in self.fields
            if (field.kind, field.report) == (kind, report)
        ]
        return 1 + (max(ends, default=0) + 7) // 8


def place_of(fields: list[Field], usage: int) -> Place | None:
    """Returns the place of a usage: the first variable element with it, or None."""
    for field in fields:
        if field.is_variable and usage in field.usages[: field.count]:
            return element(field, field.usages.index(usage))
    return None


def element(field: Field, index: int) -> Place:
    """Returns the place of a field's element by its index, from 0."""
    return Place(field, 8 + field.offset + index * field.size)


def chosen_bits(fields: list[Field], usage: int) -> int | None:
    """Returns the bits that select a usage among others; None if it is not available.

    In an array the element's value selects it, counted from the smallest value in the order of the
    descriptor. Otherwise each usage has a flag of its own.
    """
    for field in fields:
        if usage not in field.usages:
            continue
        if not field.is_variable:
            return element(field, 0).bits(field.minimum + field.usages.index(usage))
        if field.usages.index(usage) < field.count:
            place = element(field, field.usages.index(usage))
            return place.bits(field.maximum)
    return None


def chosen_usage(fields: list[Field], report: int) -> int | None:
    """Returns the usage that a report selects, the inverse of ``chosen_bits``; None without one."""
    for field in fields:
        if field.usages and not field.is_variable:
            index = element(field, 0).read(report) - field.minimum
            return field.usages[index] if 0 <= index < len(field.usages) else None
        for index, usage in enumerate(field.usages[: field.count]):
            if element(field, index).read(report):
                return usage
    return None


def composed(number: int, length: int, bits: int) -> bytes:
    """Returns a report with a number, a length and these bits."""
    return (number | bits).to_bytes(length, "little")


def as_number(layout: Layout, report: bytes) -> int:
    """Returns a received report as one number, with 0 for a missing report number."""
    return int.from_bytes(report if layout.is_numbered else b"\0" + report, "little")


def filled(places: Mapping[Place, int]) -> int:
    """Returns the bits of several values together."""
    bits = 0
    for place, value in places.items():
        bits |= place.bits(value)
    return bits


def required(place: Place | None, name: str) -> Place:
    """Returns the place; raises DeviceError with the name if it is None."""
    if place is None:
        raise DeviceError(f"its reports lack {name}")
    return place
