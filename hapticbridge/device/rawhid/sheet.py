"""Data sheet of a raw HID device."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from hapticbridge.device.data_sheet import (
    AXES,
    USUAL_FORCE_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
)
from hapticbridge.device.rawhid.frame import (
    NAME_PAGE,
    NUMBERS_PAGE,
    VERSION,
    Numbers,
    ask_frame,
    decoded,
    version_of,
)
from hapticbridge.device.transport.hid import Link
from hapticbridge.errors import DeviceError

ASKS, ASK_WAIT_MS = 10, 100
"""Number of requests for a page of the sheet, and wait for each answer in ms. A booting device has
a second per page."""

POLLING = 1e-3
"""Polling interval of a full-speed device in s, in each direction."""

_MUST_SAY = ("rate", "speed_limit")
CHANGES = (
    "mass",
    "damping",
    "rotational_inertia",
    "rotational_damping",
    "friction",
    "resolution",
    "force_limit",
    "torque_limit",
    "speed_limit",
)
"""Numbers of the data sheet that the user may replace."""


def asked(link: Link, name: str) -> tuple[Numbers, str]:
    """Requests both pages of a device's sheet.

    Raises:
        DeviceError: The device does not answer, or has another version of the protocol.
        DeviceLost: The device is gone.
    """
    numbers, title = _page(link, name, NUMBERS_PAGE), _page(link, name, NAME_PAGE)
    assert isinstance(numbers, Numbers)
    return numbers, str(title)


def _page(link: Link, name: str, page: int) -> Numbers | str:
    for _ in range(ASKS):
        link.write(b"\0" + ask_frame(page, page))
        for report in reports(link, ASK_WAIT_MS):
            answer = decoded(report)
            if isinstance(answer, Numbers if page == NUMBERS_PAGE else str):
                return answer
            if (version := version_of(report)) not in (None, VERSION):
                raise DeviceError(
                    f"{name} speaks version {version} of the raw HID protocol; "
                    f"version {VERSION} is required, so update its firmware"
                )
    raise DeviceError(
        f"{name} does not answer by the protocol hapticbridge/device/rawhid.md; check its firmware"
    )


def reports(link: Link, timeout_ms: int) -> Iterator[bytes]:
    """Yields reports as they come, for about ``timeout_ms``; a report counts as 1 ms."""
    left = timeout_ms
    while left > 0:
        report = link.wait(min(left, 10))
        left -= 1 if report else min(left, 10)
        if report:
            yield report


def data_sheet(name: str, numbers: Numbers, title: str, changes: dict[str, Any]) -> DeviceInfo:
    """Returns the data sheet from the device's numbers, its title and the user's changes.

    Raises:
        DeviceError: A required number is missing, or one is out of range.
    """
    known: dict[str, Any] = numbers.known()
    axes = numbers.axis_names
    moves, turns = (any(axis in axes for axis in kind) for kind in (AXES[:3], AXES[3:]))
    if not moves:
        known["force_limit"] = USUAL_FORCE_LIMIT
    if not turns:
        known["torque_limit"] = USUAL_TORQUE_LIMIT
    known |= changes
    must = [*_MUST_SAY, *["force_limit"] * moves, *["torque_limit"] * turns]
    if missing := [field for field in must if known[field] is None]:
        raise DeviceError(f"{name} does not report its {missing[0]}, which is required")
    # the device's own delay, plus a state up to one of its periods old, plus the bus both ways
    delay = known.pop("delay")
    try:
        return DeviceInfo(
            name=title or name,
            axes=axes,
            delay=None if delay is None else delay + 1.0 / known["rate"] + 2.0 * POLLING,
            is_prescribed=False,
            is_real=True,
            duration=None,
            **known,
        )
    except (DeviceError, ZeroDivisionError) as error:
        raise DeviceError(f"{name} reports an impossible data sheet: {error}") from None
