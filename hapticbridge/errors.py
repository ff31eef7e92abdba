"""Exceptions of hapticbridge.

Every message names the fault, its place and the valid choices. The command line prints it without a
traceback and exits with 2 (3 for a safety trip).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class HapticBridgeError(Exception):
    """Root of all errors that hapticbridge raises on purpose."""


class SceneError(HapticBridgeError):
    """A scene cannot be loaded or cannot be coupled to a haptic device."""


class SceneWarning(UserWarning):
    """A run deviates from its scene's file, or a port meters too little.

    Attributes:
        concern: Sentence on what deviates, without the name of the scene.
    """

    def __init__(self, scene: object, concern: str) -> None:
        super().__init__(f"scene '{scene}': {concern}")
        self.concern = concern


class CouplingError(HapticBridgeError):
    """A virtual coupling's parameter is out of range."""


class MechanicsError(HapticBridgeError):
    """A body, motion or impact of the reference mechanics is out of range."""


class StudyError(HapticBridgeError):
    """A sweep, map or closed loop cannot be run with these settings."""


class DeviceError(HapticBridgeError):
    """A device cannot be opened, read or written, or its input file is bad."""


class DeviceLost(DeviceError):  # noqa: N818 - an event like SafetyTrip, not a mistake
    """A device was unplugged, or was silent for too long, during a run."""


class CommandError(HapticBridgeError):
    """A command to a run is refused; the run continues unchanged."""


class IdentificationError(DeviceError):
    """A recording does not determine a device: little motion, a hand on it, a saturated motor."""


class RecordingError(HapticBridgeError):
    """A recording cannot be read or written."""


class SafetyTrip(HapticBridgeError):  # noqa: N818 - the field's word for it
    """The guard stopped the bridge; zero force was commanded before this was raised.

    Attributes:
        records: Tick records of the last second (``TICK_DTYPE``), newest last.
    """

    def __init__(self, message: str, records: NDArray[np.void]) -> None:
        super().__init__(message)
        self.records = records


def nearest(name: str, names: Iterable[str]) -> str:
    """Asks for the valid name most like a mistyped one: ``did you mean 'a'? ``; else empty."""
    import difflib  # noqa: PLC0415 - for a wrong name alone

    near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.65)
    return f"did you mean '{near[0]}'? " if near else ""


def choices(names: Iterable[str]) -> str:
    """Lists valid names for an error message: ``'a_2', 'a_10'``, or ``none exist``."""

    def in_order(name: str) -> str:
        return re.sub(r"\d+", lambda number: number[0].zfill(20), name)

    listed = ", ".join(f"'{name}'" for name in sorted(names, key=in_order))
    return listed or "none exist"
