"""Reports of USB force feedback (class PID), found by usage in a device's descriptor.

Report numbers, widths, ranges and the order of fields differ between devices; only usages are
standardised. A constant force is streamed as follows:

1. DeviceControl enables the device's actuators. 2. CreateNewEffect creates an effect of type
constant, and BlockLoad returns its index. Both are feature reports. 3. SetEffect sets its direction
and its duration. 4. EffectOperation starts it. 5. From then on SetConstantForce alone changes it.

References:
    USB-IF, Device Class Definition for Physical Interface Devices (PID) 1.0, sections 4 and 5.
"""

from __future__ import annotations

from dataclasses import dataclass

from hapticbridge.device.transport.hid_descriptor import (
    FEATURE,
    OUTPUT,
    Field,
    Layout,
    Place,
    as_number,
    chosen_bits,
    chosen_usage,
    composed,
    filled,
    place_of,
    required,
)
from hapticbridge.errors import DeviceError

PAGE = 0x0F
"""Usage page of physical interface devices."""

_P = PAGE << 16
SET_EFFECT, EFFECT_TYPE, CONSTANT = _P | 0x21, _P | 0x25, _P | 0x26
BLOCK_INDEX, DURATION, GAIN, AXES_ENABLE = _P | 0x22, _P | 0x50, _P | 0x52, _P | 0x55
DIRECTION_ENABLE, DIRECTION = _P | 0x56, _P | 0x57
SET_CONSTANT_FORCE, MAGNITUDE = _P | 0x73, _P | 0x70
EFFECT_OPERATION, START, STOP = _P | 0x77, _P | 0x79, _P | 0x7B
LOOP_COUNT, DEVICE_GAIN_REPORT, DEVICE_GAIN = _P | 0x7C, _P | 0x7D, _P | 0x7E
POOL, MAX_EFFECTS, BLOCK_FREE, CREATE = _P | 0x7F, _P | 0x83, _P | 0x90, _P | 0xAB
BLOCK_LOAD, LOAD_STATUS, LOADED, FULL = _P | 0x89, _P | 0x8B, _P | 0x8C, _P | 0x8D
DEVICE_CONTROL = _P | 0x95
ENABLE, DISABLE, STOP_ALL, RESET = _P | 0x97, _P | 0x98, _P | 0x99, _P | 0x9A

_MILLI = -3
"""Power of ten, in s, of durations without a unit in the descriptor: all drivers assume ms."""

_FULL_TURN = 360.0  # degrees, the standard's unit of directions


@dataclass(frozen=True, slots=True)
class Magnitude:
    """Report that changes one effect's force.

    Attributes:
        blank: The report with a force of zero, as a number.
        place: Place of the force in the report.
        full: Largest magnitude in counts available in both directions.
        length: Length of the report in bytes.
    """

    blank: int
    place: Place
    full: int
    length: int

    def report(self, counts: int) -> bytes:
        """Returns the report for a force in counts, -``full`` to ``full``."""
        return (self.blank | self.place.bits(counts)).to_bytes(self.length, "little")


class PidReports:
    """Encoder and decoder of one device's reports.

    Args:
        layout: Layout of its reports.

    Raises:
        DeviceError: The reports lack a requirement of a streamed constant force; the message names
            it.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._set_effect = self._fields(OUTPUT, SET_EFFECT, "SetEffect")
        self._set_force = self._fields(OUTPUT, SET_CONSTANT_FORCE, "SetConstantForce")
        self._operation = self._fields(OUTPUT, EFFECT_OPERATION, "EffectOperation")
        self._control = self._fields(OUTPUT, DEVICE_CONTROL, "DeviceControl")
        self._create = self._fields(FEATURE, CREATE, "CreateNewEffect")
        self._load = self._fields(FEATURE, BLOCK_LOAD, "BlockLoad")
        self._pool = layout.within(FEATURE, POOL)
        self._free = layout.within(OUTPUT, BLOCK_FREE)
        self._gain = layout.within(OUTPUT, DEVICE_GAIN_REPORT)
        self._loaded_index = required(place_of(self._load, BLOCK_INDEX), "BlockLoad's index")
        self._duration = required(place_of(self._set_effect, DURATION), "a duration")
        self._direction = required(_direction(self._set_effect), "a direction")
        self._force = required(place_of(self._set_force, MAGNITUDE), "a magnitude")
        required(place_of(self._set_effect, DIRECTION_ENABLE), "DirectionEnable")
        for fields, usage, name in (
            (self._create, CONSTANT, "constant force"),
            (self._operation, START, "the operation that starts an effect"),
            (self._operation, STOP, "the operation that stops an effect"),
            (self._load, LOADED, "BlockLoad's status"),
        ):
            if chosen_bits(fields, usage) is None:
                raise DeviceError(f"its reports lack {name}")
        if self._force.field.minimum >= 0 or self._force.field.maximum <= 0:
            raise DeviceError(
                f"its constant force goes from {self._force.field.minimum} to "
                f"{self._force.field.maximum}: it has no sign, and cannot push both ways"
            )
        if self.longest() <= 0.0:
            raise DeviceError("its durations have no range")

    def control(self, usage: int) -> bytes | None:
        """Returns the report that enables, disables, stops or resets; None if it is missing."""
        bits = chosen_bits(self._control, usage)
        return None if bits is None else self._report(self._control, bits)

    def full_gain(self) -> bytes | None:
        """Returns the report that sets the device's gain to its maximum, or None."""
        place = place_of(self._gain, DEVICE_GAIN)
        if place is None:
            return None
        return self._report(self._gain, place.bits(place.field.maximum))

    def create(self) -> bytes:
        """Returns the feature report that creates an effect of type constant."""
        return self._report(self._create, chosen_bits(self._create, CONSTANT) or 0)

    @property
    def load(self) -> tuple[int, int]:
        """Number and length in bytes of the feature report with the result of a creation."""
        return self._feature_request(self._load)

    @property
    def pool(self) -> tuple[int, int] | None:
        """Number and length in bytes of the feature report with the number of possible effects."""
        return self._feature_request(self._pool) if place_of(self._pool, MAX_EFFECTS) else None

    def loaded(self, answer: bytes) -> tuple[int | None, int]:
        """Returns the result of a creation (``LOADED``, ``FULL``, other) and the effect's index."""
        report = as_number(self._layout, answer)
        return chosen_usage(self._status, report), self._loaded_index.read(report)

    def max_effects(self, answer: bytes) -> int | None:
        """Returns the number of effects that can play at once; None if unknown."""
        place = place_of(self._pool, MAX_EFFECTS)
        return None if place is None else place.read(as_number(self._layout, answer)) or None

    def longest(self) -> float:
        """Returns the longest finite duration in s of an effect."""
        # the largest value may mean an infinite duration, as 65535 does
        return (self._duration.field.maximum - 1) * self._second_per_count

    def set_effect(self, index: int, angle: float, duration: float) -> bytes:
        """Returns the report with an effect's properties; it plays with full gain.

        Args:
            index: Index of the effect.
            angle: Origin of the force in degrees clockwise from north (away from the user): 0
                pushes towards the user, 90 to the left.
            duration: Duration in s after a start, at most ``longest``.
        """
        field = self._direction.field
        turns = angle / _FULL_TURN % 1.0
        places = {
            self._duration: max(round(duration / self._second_per_count), 1),
            # plus one, because ranges such as 0 to 255 and 0 to 35999 exclude the full turn
            self._direction: field.minimum + round(turns * (field.maximum - field.minimum + 1)),
        }
        for usage, value in ((BLOCK_INDEX, index), (GAIN, 1 << 31), (DIRECTION_ENABLE, 1)):
            place = place_of(self._set_effect, usage)
            if place is not None:
                places[place] = value
        kind = chosen_bits(_inside(self._set_effect, EFFECT_TYPE), CONSTANT) or 0
        return self._report(self._set_effect, filled(places) | kind)

    def magnitude(self, index: int) -> Magnitude:
        """Returns the template of an effect's SetConstantForce reports."""
        place = place_of(self._set_force, BLOCK_INDEX)
        blank = self._report(self._set_force, 0 if place is None else place.bits(index))
        full = min(self._force.field.maximum, -self._force.field.minimum)
        return Magnitude(int.from_bytes(blank, "little"), self._force, full, len(blank))

    def operate(self, index: int, usage: int) -> bytes:
        """Returns the report that starts an effect once, or anew if it plays, or stops it."""
        bits = chosen_bits(self._operation, usage) or 0
        for required_usage, value in ((BLOCK_INDEX, index), (LOOP_COUNT, 1)):
            place = place_of(self._operation, required_usage)
            if place is not None:
                bits |= place.bits(value)
        return self._report(self._operation, bits)

    def free(self, index: int) -> bytes | None:
        """Returns the report that frees an effect's memory; None if the device lacks it."""
        place = place_of(self._free, BLOCK_INDEX)
        return None if place is None else self._report(self._free, place.bits(index))

    @property
    def _status(self) -> list[Field]:
        return _inside(self._load, LOAD_STATUS)

    @property
    def _second_per_count(self) -> float:
        field = self._duration.field
        least, most = field.physical
        scale = (most - least) / max(field.maximum - field.minimum, 1)
        return scale * 10.0 ** (field.exponent if field.unit else _MILLI)

    def _fields(self, kind: int, collection: int, name: str) -> list[Field]:
        fields = self._layout.within(kind, collection)
        if not fields:
            raise DeviceError(f"its reports lack {name}")
        return fields

    def _feature_request(self, fields: list[Field]) -> tuple[int, int]:
        report = fields[0].report
        return report, self._layout.length(FEATURE, report)

    def _report(self, fields: list[Field], bits: int) -> bytes:
        first = fields[0]
        return composed(first.report, self._layout.length(first.kind, first.report), bits)


def has_force_feedback(descriptor: bytes) -> bool:
    """Returns whether a report descriptor has force-feedback reports to the device."""
    try:
        layout = Layout(descriptor)
    except DeviceError:
        return False
    return bool(layout.within(OUTPUT, SET_EFFECT) or layout.within(OUTPUT, SET_CONSTANT_FORCE))


def forced_axes(layout: Layout) -> set[int]:
    """Returns the usages of the axes that effects can act on."""
    fields = _inside(layout.within(OUTPUT, SET_EFFECT), AXES_ENABLE)
    return {usage for field in fields for usage in field.usages}


def _inside(fields: list[Field], collection: int) -> list[Field]:
    return [field for field in fields if collection in field.collections]


def _direction(fields: list[Field]) -> Place | None:
    """Returns the place of a direction's first angle, from its collection or by its usage."""
    for field in fields:
        if DIRECTION in field.collections and field.usages:
            return Place(field, 8 + field.offset)
    return place_of(fields, DIRECTION)
