"""Table of the hardware drivers. A driver is imported when one of its devices is opened."""

from __future__ import annotations

from importlib import import_module

from hapticbridge.device.plugged import Family

DRIVERS = {
    "falcon": "hapticbridge.device.falcon.finding",
    "spacemouse": "hapticbridge.device.spacemouse.driver",
    "rawhid": "hapticbridge.device.rawhid.finding",
    "pid": "hapticbridge.device.pid.driver",
    "haply": "hapticbridge.device.haply.finding",
    "forcedimension": "hapticbridge.device.forcedimension.finding",
}
"""Module of each family by the family's name, in the order in which families are listed. The module
holds the ``Family`` as ``FAMILY``."""


def family_named(name: str) -> Family | None:
    """Returns the family that ``open_device`` knows by a name, or None."""
    if name not in DRIVERS:
        return None
    family: Family = import_module(DRIVERS[name]).FAMILY
    return family


def all_families() -> tuple[Family, ...]:
    """Returns every family; imports all drivers."""
    return tuple(family for name in DRIVERS if (family := family_named(name)) is not None)
