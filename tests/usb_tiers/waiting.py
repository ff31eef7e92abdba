"""Waiting for a system to notice what was plugged in or pulled out."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

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
