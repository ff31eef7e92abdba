"""What can go wrong, as one small family of exceptions.

Every message says what is wrong, where, and what would be valid. The command line prints it and
exits with 2 (3 for a safety trip); nothing of the family is ever a traceback to a user.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class HapticBridgeError(Exception):
    """Root of all errors that hapticbridge raises on purpose."""


class SceneError(HapticBridgeError):
    """A scene cannot be loaded, or cannot be put behind a haptic device."""


class CouplingError(HapticBridgeError):
    """A virtual coupling's parameters are out of range."""


class MechanicsError(HapticBridgeError):
    """A body, motion or impact of the reference mechanics is out of range."""


class StudyError(HapticBridgeError):
    """A sweep, a map or a closed loop cannot be run as asked."""


class DeviceError(HapticBridgeError):
    """A device cannot be opened, read or written, or its input file is bad."""


class DeviceLost(DeviceError):  # noqa: N818 - as SafetyTrip: what happened, not a mistake
    """A device is gone in mid-run: unplugged, or silent for longer than it may be."""


class CommandError(HapticBridgeError):
    """A command to a run that goes on is refused; the run goes on as it was."""


class IdentificationError(DeviceError):
    """A run does not tell what a device is: too little motion, a hand on it, a motor at its end."""


class RecordingError(HapticBridgeError):
    """A recording cannot be read or written."""


class SafetyTrip(HapticBridgeError):  # noqa: N818 - the field's word for it
    """The bridge stopped itself: zero force was commanded first, then this was raised.

    Attributes:
        records: The last second of tick records (``TICK_DTYPE``), newest last.
    """

    def __init__(self, message: str, records: NDArray[np.void]) -> None:
        super().__init__(message)
        self.records = records


def choices(names: Iterable[str]) -> str:
    """Lists valid names for an error message: ``'a', 'b'``, or ``none exist``."""
    listed = ", ".join(f"'{name}'" for name in sorted(names))
    return listed or "none exist"
