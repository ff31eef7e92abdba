"""Axes and buttons of a force-feedback stick, found by usage."""

from __future__ import annotations

from hapticbridge.device.pid.reports import forced_axes
from hapticbridge.device.transport.hid_descriptor import INPUT, Field
from hapticbridge.device.transport.hid_layout import (
    WIDEST,
    Layout,
    Place,
    as_number,
    element,
    place_of,
    required,
)
from hapticbridge.device.transport.hid_search import CONTROLLERS
from hapticbridge.errors import DeviceError

X, Y = 0x00010030, 0x00010031
"""Usages of the axes on the page of generic desktop controls: to the right, and towards the
user."""

MOST_BUTTONS = 63
"""Largest number of buttons: the bits of a sample."""

_CONTROLLERS = {page << 16 | usage for page, usage in CONTROLLERS}
_BUTTON_PAGE = 9
"""Usage page of buttons."""


class Stick:
    """Decoder of a stick's input reports.

    Args:
        layout: Layout of the device's reports.

    Attributes:
        deflection: Deflection to the right and towards the user, each -1 to 1.
        buttons: One bit per button, the first one lowest.
        step: Smallest change of deflection per axis.
        report: Number and length in bytes of the report with the X axis.

    Raises:
        DeviceError: The stick has no X or Y, or its force does not act on both.
    """

    def __init__(self, layout: Layout) -> None:
        # some devices contain a mouse or a keyboard with an X and Y of its own
        fields = [
            field
            for field in layout.fields
            if field.kind == INPUT
            and field.size <= WIDEST
            and _CONTROLLERS.intersection(field.collections[:1])
        ]
        self._layout = layout
        self._axes = (
            required(place_of(fields, X), "an X axis"),
            required(place_of(fields, Y), "a Y axis"),
        )
        for place in self._axes:
            if place.field.minimum >= place.field.maximum:
                raise DeviceError("its axes have no range")
        if not {X, Y} <= forced_axes(layout):
            raise DeviceError(
                "its force does not act on both X and Y; it is not a stick but a wheel or similar"
            )
        self._buttons = _buttons(fields)
        self._places = (*self._axes, *(place for _, place in self._buttons))
        self.step = tuple(2.0 / (p.field.maximum - p.field.minimum) for p in self._axes)
        number = self._axes[0].field.report
        self.report = number, layout.length(INPUT, number)
        self.deflection = [0.0, 0.0]
        self.buttons = 0

    def takes(self, report: bytes) -> bool:
        """Decodes a report; returns whether it held the position of an axis."""
        number = as_number(self._layout, report)
        received, bits = number & 0xFF, 8 * (len(report) + (not self._layout.is_numbered))
        places = [place for place in self._places if place.field.report == received]
        if not places or any(place.offset + place.field.size > bits for place in places):
            return False  # an unrelated or truncated report
        is_new = False
        for axis, place in enumerate(self._axes):
            if place.field.report == received:
                least, most = place.field.minimum, place.field.maximum
                value = min(max(place.read(number), least), most)
                self.deflection[axis] = (2 * value - least - most) / (most - least)
                is_new = True
        for bit, place in self._buttons:
            if place.field.report == received:
                pressed = place.read(number) != 0
                self.buttons = self.buttons & ~(1 << bit) | pressed << bit
        return is_new


def _buttons(fields: list[Field]) -> list[tuple[int, Place]]:
    """Returns the first buttons: bit in a sample, and place in the report."""
    found = []
    for field in fields:
        for index, usage in enumerate(field.usages[: field.count]):
            number = usage & 0xFFFF
            if usage >> 16 == _BUTTON_PAGE and field.is_variable and 0 < number <= MOST_BUTTONS:
                found.append((number - 1, element(field, index)))
    return found
