"""Waiting for a system to notice what was plugged in or pulled out."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from hapticbridge.device.discovery import plugged_devices
from hapticbridge.device.driver import FoundDevice

_Found = TypeVar("_Found")


def wait_for(look: Callable[[], _Found], seconds: float = 10.0) -> _Found:
    """Looks every 10 ms until what is seen is true.

    Raises:
        TimeoutError: It is not within this time.
    """
    end = time.monotonic() + seconds
    while not (found := look()):
        if time.monotonic() > end:
            raise TimeoutError(f"not within {seconds:g} s")
        time.sleep(0.01)
    return found


def usable_devices() -> list[FoundDevice]:
    """Lists what can be opened: the kernel tells of a device before its node is there."""
    return [device for device in plugged_devices() if device.problem is None]
