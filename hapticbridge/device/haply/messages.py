"""Messages of the Inverse Service: list of devices, states and forces.

The protocol is that of service 3.5, as documented by the maker: JSON over a WebSocket on port
10001. On connection the service sends an inventory, then exactly one state per received message. A
force lasts for its message; without messages the device idles. Lengths in m, forces in N.

    {"session_id": 7, "inverse3": [{"device_id": "049D", "config": {...}, "state": {...}}]}
    {"inverse3": [{"device_id": "049D", "commands": {"set_cursor_force": {"vector": {...}}}}]}

Services before 3.5 list no filters in the configuration and use the key ``values`` for the force.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hapticbridge.device.transport.websocket import decoded
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.pose import Quaternion, canonical

SERVICE = "the Inverse Service"
"""Name of the service in messages."""

FARTHEST = 10.0
"""Largest plausible coordinate in m; no arm is that long."""

GRIPS = ("wireless_verse_grip", "verse_grip")
"""Keys under which VerseGrips are listed, the wireless ones first; the first grip is used."""

BUTTONS = ("a", "b", "c")
"""Bits 0, 1 and 2 of a sample's buttons. A wired grip has one ``button``, which is bit 0."""

ROUNDING = 0.02
"""Largest deviation of a quaternion's norm from 1 that counts as rounding, without unit. The
maker's example has multiples of 2⁻¹⁴; a larger one is another kind of number."""

_ID = re.compile(r"[0-9A-Za-z_-]{1,64}")  # part of a profile's file name


@dataclass(frozen=True, slots=True)
class Listed:
    """A device of the inventory.

    Attributes:
        device_id: Identifier of the device in the service.
        kind: ``inverse3``, ``minverse`` or another type.
        force_key: Key of a force in messages.
        filters: Previous settings of the service's filters, by name; None if it has none.
        is_scaled: True if the service scales the cursor's position.
    """

    device_id: str
    kind: str
    force_key: str
    filters: Mapping[str, float | None] | None
    is_scaled: bool


@dataclass(frozen=True, slots=True)
class State:
    """State of one device.

    Attributes:
        position: Position of the cursor in m.
        buttons: Bit 0 is a, bit 1 b, bit 2 c.
        orientation: Unit quaternion of the VerseGrip in the frame of the position; None without a
            grip, or before it has sent one.
    """

    position: tuple[float, float, float]
    buttons: int
    orientation: Quaternion | None = None


def inventory(message: str) -> list[Listed]:
    """Returns the devices listed in the service's first message."""
    content = decoded(message, SERVICE)
    if "session_id" not in content and "inverse3" not in content:
        raise DeviceError(f"{SERVICE} sent no list of devices first: {message!r:.60}")
    return [_listed(entry) for entry in _entries(content, "inverse3")]


def state(message: str, device_id: str) -> State:
    """Returns a device's state from a state message.

    Raises:
        DeviceError: The message is not a state message, or a number is invalid.
        DeviceLost: The device is no longer listed.
    """
    content = decoded(message, SERVICE)
    for entry in _entries(content, "inverse3"):
        if entry.get("device_id") == device_id:
            grip = _grip(content)
            return State(
                _vector(_part(entry, "state"), "cursor_position"),
                _buttons(grip),
                _orientation(grip),
            )
    raise DeviceLost(f"the device '{device_id}' is gone: {SERVICE} does not list it any more")


def first_message(listed: Listed, gate_gain: float) -> str:
    """Returns the first message: session name, gain of the force gate, and zero force."""
    device: dict[str, Any] = {"device_id": listed.device_id}
    if listed.filters is not None:
        device["configure"] = {"force_gate": {"gain": gate_gain}, "damping": {"scalar": 0.0}}
    zero = dict.fromkeys("xyz", 0.0)
    device["commands"] = {"set_cursor_force": {listed.force_key: zero}}
    session = {"configure": {"profile": {"name": "hapticbridge"}}}
    return json.dumps({"session": session, "inverse3": [device]})


def refuse_scaled(listed: Listed) -> None:
    """Raises DeviceError for a device whose positions the service scales."""
    if listed.is_scaled:
        raise DeviceError(
            f"{SERVICE} scales the positions of {listed.device_id}, so force times motion would "
            "not be work; set the scale of its mount and transform to 1"
        )


def describe_filters(listed: Listed, gate_gain: float) -> str:
    """Returns a sentence for the user on the service's force filters."""
    if listed.filters is None:
        return (
            f"{SERVICE} is older than 3.5: its force filters stay as they are, and the certificate "
            "does not account for them"
        )
    before = ", ".join(
        f"{name} was {'unknown' if value is None else f'{value:g}'}"
        for name, value in listed.filters.items()
    )
    return (
        f"{SERVICE}: force_gate.gain set to {gate_gain:g}, damping.scalar to 0 ({before}); its "
        "oscillation damper cannot be switched off, and its setting devices/force_scale must be 1"
    )


def force_message(listed: Listed, force: Sequence[float]) -> str:
    """Returns the message that commands a force of three finite numbers in N."""
    x, y, z = force
    return (
        f'{{"inverse3":[{{"device_id":{json.dumps(listed.device_id)},"commands":'
        f'{{"set_cursor_force":{{"{listed.force_key}":{{"x":{x!r},"y":{y!r},"z":{z!r}}}}}}}}}]}}'
    )


def _listed(entry: dict[str, Any]) -> Listed:
    device_id = entry.get("device_id")
    if not isinstance(device_id, str) or not _ID.fullmatch(device_id):
        raise DeviceError(f"{SERVICE} lists a device without a device_id: {entry!r:.60}")
    config = entry.get("config")
    config = config if isinstance(config, dict) else {}
    raw = config.get("filters")
    filters = None
    if isinstance(raw, dict):
        filters = {
            f"{name}.{field}": _number(raw.get(name), field)
            for name, field in (("force_gate", "gain"), ("damping", "scalar"))
        }
    mount, transform = config.get("mount"), _part(entry, "state").get("transform")
    return Listed(
        device_id=device_id,
        kind=str(config.get("type") or "inverse3"),
        force_key="values" if filters is None else "vector",
        filters=filters,
        is_scaled=_is_scaled(mount) or _is_scaled(transform),
    )


def _is_scaled(place: object) -> bool:
    scale = place.get("scale") if isinstance(place, dict) else None
    return isinstance(scale, dict) and any(_number(scale, axis) != 1.0 for axis in "xyz")


def _entries(content: dict[str, Any], key: str) -> list[dict[str, Any]]:
    entries = content.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DeviceError(f"{SERVICE} lists invalid devices under '{key}': {entries!r:.60}")
    return entries


def _part(entry: dict[str, Any], key: str) -> dict[str, Any]:
    part = entry.get(key, {})
    return part if isinstance(part, dict) else {}


def _number(where: object, key: str) -> float | None:
    value = where.get(key) if isinstance(where, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if abs(value) < 1e300 else math.inf


def _vector(where: dict[str, Any], key: str) -> tuple[float, float, float]:
    x, y, z = (_number(where.get(key), axis) for axis in "xyz")
    if x is None or y is None or z is None or not all(abs(v) < FARTHEST for v in (x, y, z)):
        raise DeviceError(f"{SERVICE} reports no position: {key} = {where.get(key)!r:.60}")
    return x, y, z


def _grip(content: dict[str, Any]) -> dict[str, Any]:
    """Returns the state of the first VerseGrip; empty without one."""
    for name in GRIPS:
        entries = content.get(name)
        if isinstance(entries, list) and entries and isinstance(entries[0], dict):
            return _part(entries[0], "state")
    return {}


def _buttons(grip: dict[str, Any]) -> int:
    pressed = _part(grip, "buttons")
    bits = sum(1 << bit for bit, key in enumerate(BUTTONS) if pressed.get(key) is True)
    return bits | (grip.get("button") is True)


def _orientation(grip: dict[str, Any]) -> Quaternion | None:
    """Returns a grip's orientation, of unit length; None if it has sent none yet."""
    if "orientation" not in grip:
        return None
    numbers = [_number(grip["orientation"], axis) for axis in "wxyz"]
    if numbers == [0.0] * 4:
        return None
    size = math.hypot(*(math.nan if number is None else number for number in numbers))
    if not abs(size - 1.0) < ROUNDING:
        raise DeviceError(
            f"{SERVICE} reports no orientation of the VerseGrip: {grip['orientation']!r:.60}"
        )
    w, x, y, z = (float(number or 0.0) / size for number in numbers)
    return canonical((w, x, y, z))
