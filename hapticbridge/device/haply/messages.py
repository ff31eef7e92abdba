"""The Inverse Service's messages: its list of devices, their states, and what is sent to them.

Service 3.5, as its documentation has it: JSON over a WebSocket on port 10001. On connection the
service sends an inventory, then exactly one state for each message that it gets. A force holds for
its message; who sends none any more leaves the device idle. Lengths in m, forces in N.

    {"session_id": 7, "inverse3": [{"device_id": "049D", "config": {...}, "state": {...}}]}
    {"inverse3": [{"device_id": "049D", "commands": {"set_cursor_force": {"vector": {...}}}}]}

Services before 3.5 list no filters in the configuration and call the force ``values``.
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

SERVICE = "the Inverse Service"
"""What errors call it."""

FARTHEST = 10.0
"""In m: a position beyond is none. No arm is that long."""

GRIPS = ("wireless_verse_grip", "verse_grip")
"""Where the handle's buttons may be listed; the first handle that is listed counts."""

BUTTONS = ("a", "b", "c")
"""Bits 0, 1 and 2 of a sample's buttons."""

_ID = re.compile(r"[0-9A-Za-z_-]{1,64}")  # it becomes part of a profile's file name


@dataclass(frozen=True, slots=True)
class Listed:
    """A device of the inventory.

    Attributes:
        device_id: What the service knows it by.
        kind: ``inverse3``, ``minverse`` and the like.
        force_key: What the service calls a force.
        filters: What its own filters were set to, by name; None where the service has none to set.
        is_scaled: Whether it reports other lengths than the cursor's own.
    """

    device_id: str
    kind: str
    force_key: str
    filters: Mapping[str, float | None] | None
    is_scaled: bool


@dataclass(frozen=True, slots=True)
class State:
    """What a state message says of one device.

    Attributes:
        position: Of the cursor in m.
        buttons: Bit 0 is a, bit 1 b, bit 2 c.
    """

    position: tuple[float, float, float]
    buttons: int


def inventory(message: str) -> list[Listed]:
    """Returns the devices that the service's first message lists.

    Raises:
        DeviceError: It is no inventory.
    """
    told = decoded(message, SERVICE)
    if "session_id" not in told and "inverse3" not in told:
        raise DeviceError(f"{SERVICE} sent no list of devices first: {message!r:.60}")
    return [_listed(entry) for entry in _entries(told, "inverse3")]


def state(message: str, device_id: str) -> State:
    """Returns what a state message says of a device.

    Raises:
        DeviceError: It is no state message, or a number in it is none.
        DeviceLost: The device is not in it any more.
    """
    told = decoded(message, SERVICE)
    for entry in _entries(told, "inverse3"):
        if entry.get("device_id") == device_id:
            return State(_vector(_part(entry, "state"), "cursor_position"), _buttons(told))
    raise DeviceLost(f"the device '{device_id}' is gone: {SERVICE} does not list it any more")


def first_message(listed: Listed, gate_gain: float) -> str:
    """Returns what is sent first: who we are, the service's filters set, and no force.

    Args:
        listed: The device.
        gate_gain: Of the force gate, without unit.
    """
    device: dict[str, Any] = {"device_id": listed.device_id}
    if listed.filters is not None:
        device["configure"] = {"force_gate": {"gain": gate_gain}, "damping": {"scalar": 0.0}}
    zero = dict.fromkeys("xyz", 0.0)
    device["commands"] = {"set_cursor_force": {listed.force_key: zero}}
    session = {"configure": {"profile": {"name": "hapticbridge"}}}
    return json.dumps({"session": session, "inverse3": [device]})


def refuse_scaled(listed: Listed) -> None:
    """Refuses a device whose positions the service scales.

    Raises:
        DeviceError: It does.
    """
    if listed.is_scaled:
        raise DeviceError(
            f"{SERVICE} scales the positions of {listed.device_id}, so force times motion would be "
            "no work; set the scale of its mount and transform to 1"
        )


def told_filters(listed: Listed, gate_gain: float) -> str:
    """Says what the service does to forces, for the user."""
    if listed.filters is None:
        return (
            f"{SERVICE} is older than 3.5: whatever it filters forces with stays as it is, and "
            "the certificate does not know of it"
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
    """Returns the message that commands a force.

    Args:
        listed: The device.
        force: In N, finite, three numbers.
    """
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


def _entries(told: dict[str, Any], key: str) -> list[dict[str, Any]]:
    entries = told.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DeviceError(f"{SERVICE} lists under '{key}' what are no devices: {entries!r:.60}")
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


def _buttons(told: dict[str, Any]) -> int:
    for name in GRIPS:
        entries = told.get(name)
        if isinstance(entries, list) and entries and isinstance(entries[0], dict):
            pressed = _part(_part(entries[0], "state"), "buttons")
            return sum(1 << bit for bit, key in enumerate(BUTTONS) if pressed.get(key) is True)
    return 0
