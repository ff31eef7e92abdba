"""What a raw HID device says of itself when it is asked, and the data sheet made of it."""

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
"""How often a page of the sheet is asked for before giving up, and how long each answer is waited
for, in ms: a device that still boots has a second for each."""

POLLING = 1e-3
"""In s: a full-speed device is asked once a millisecond, in each direction."""

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
"""Numbers of the data sheet that the user may know better than the device."""


def asked(link: Link, name: str) -> tuple[Numbers, str]:
    """Asks a device for both pages of its sheet.

    Args:
        link: Reports to and from the device, open.
        name: What errors call it.

    Raises:
        DeviceError: It does not answer, or speaks another version of the protocol.
        DeviceLost: It is gone.
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
                    f"this is version {VERSION}"
                )
    raise DeviceError(
        f"{name} does not answer as hapticbridge/device/rawhid.md says; is its firmware on it?"
    )


def reports(link: Link, timeout_ms: int) -> Iterator[bytes]:
    """Yields reports as they come, for about that time: one a millisecond, or waiting."""
    left = timeout_ms
    while left > 0:
        report = link.wait(min(left, 10))
        left -= 1 if report else min(left, 10)
        if report:
            yield report


def data_sheet(name: str, numbers: Numbers, title: str, changes: dict[str, Any]) -> DeviceInfo:
    """Makes a data sheet of what the device says of itself and what the user knows better.

    Args:
        name: What errors call it.
        numbers: Page 0.
        title: Page 1.
        changes: Of ``CHANGES``, by name.

    Raises:
        DeviceError: A number that nobody can guess is missing, or one is out of range.
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
        raise DeviceError(f"{name} does not say its {missing[0]}, and nobody can guess it")
    # what the device adds by itself, a state that is one of its periods old, and the bus both ways
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
        raise DeviceError(f"{name} claims what cannot be: {error}") from None
