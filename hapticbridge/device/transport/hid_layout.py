"""Layout of a HID device's reports by usage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hapticbridge.device.transport.hid_descriptor import Field, fields_of
from hapticbridge.errors import DeviceError

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

    def share(self, share: float) -> int:
        """Returns the logical value at a share of the range, 0: smallest, 1: largest."""
        return self.field.minimum + round(share * (self.field.maximum - self.field.minimum))


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


def required(found: Place | None, name: str) -> Place:
    """Returns the place; raises DeviceError with the name if it is None."""
    if found is None:
        raise DeviceError(f"its reports lack {name}")
    return found
