"""Bindings of OpenHaptics' low-level library (HD), loaded at run time.

The library is not part of this project. Signatures and codes follow the maker's header
``hdDefines.h`` and API reference, version 3. Lengths in mm, forces in N. Errors are queued by the
library: a call returns nothing, and ``hdGetError`` removes the newest one from the queue.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char_p, c_double, c_int, c_uint, c_ulong, c_ushort, c_void_p
from typing import Any

from hapticbridge.device.transport.maker_library import LibraryFiles, MakerLibrary
from hapticbridge.errors import DeviceError

CURRENT_BUTTONS, CURRENT_POSITION, CURRENT_TRANSFORM = 0x2000, 0x2050, 0x2052
CURRENT_FORCE = 0x2700
MODEL, SERIAL_NUMBER = 0x2501, 0x2504
MAX_WORKSPACE, CALIBRATION_STYLE = 0x2550, 0x2555
MAX_FORCE, MAX_CONTINUOUS_FORCE = 0x2603, 0x2604
"""Parameters that are read or set. A transform has 16 numbers column by column; a workspace six:
the least x, y, z, then the largest."""

FORCE_OUTPUT, MAX_FORCE_CLAMPING = 0x4000, 0x4001
"""Capabilities that are enabled."""

CALIBRATED, NEEDS_UPDATE = 0x5000, 0x5001
"""Answers of ``hdCheckCalibration``; any other one asks for the user's hand."""

BY_ENCODER_RESET, BY_ITSELF, BY_INKWELL = 1, 2, 4
"""Bits of the styles in which a device can be calibrated."""

NO_DEVICE = 0xFFFFFFFF
"""Handle of a device that could not be opened."""

TOP_PRIORITY = 0xFFFF
"""Largest priority of a callback: it runs first in each servo tick."""

ERRORS = {
    0x0200: "its motors are too warm: let it cool down, and lower --force-limit",
    0x0201: "it was sent more than its largest force",
    0x0202: "its force changed too fast: lower --stiffness, or raise --ramp",
    0x0203: "it moved faster than its library allows",
    0x0204: "its library reports a fault of the force",
    0x0300: "its library reports a fault of the device: check its power and its cable",
    0x0301: "another program has it, or it was not released: close the other program",
    0x0302: "its library lost the connection: check its cable and its power",
    0x0303: "its connection is not set up: run the maker's Touch Setup",
    0x0304: "the timer of its library failed: close other programs",
    0x0600: "the licence of OpenHaptics is not valid",
}
"""Causes by error code, with the remedy; the library's own words serve for any other code."""


class ErrorInfo(ctypes.Structure):
    """Entry of the library's queue of errors; ``hdGetError`` returns it by value."""

    _fields_ = [("code", c_uint), ("internal", c_int), ("device", c_uint)]


CALLBACK = ctypes.CFUNCTYPE(c_uint, c_void_p)
"""Callback of the scheduler; it receives the pointer that was given with it."""

FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "hdInitDevice": (c_uint, (c_char_p,)),
    "hdDisableDevice": (None, (c_uint,)),
    "hdMakeCurrentDevice": (None, (c_uint,)),
    "hdBeginFrame": (None, (c_uint,)),
    "hdEndFrame": (None, (c_uint,)),
    "hdEnable": (None, (c_uint,)),
    "hdDisable": (None, (c_uint,)),
    "hdGetDoublev": (None, (c_uint, c_void_p)),
    "hdGetIntegerv": (None, (c_uint, c_void_p)),
    "hdSetDoublev": (None, (c_uint, c_void_p)),
    "hdGetString": (c_char_p, (c_uint,)),
    "hdGetError": (ErrorInfo, ()),
    "hdGetErrorString": (c_char_p, (c_uint,)),
    "hdCheckCalibration": (c_uint, ()),
    "hdUpdateCalibration": (None, (c_uint,)),
    "hdStartScheduler": (None, ()),
    "hdStopScheduler": (None, ()),
    "hdScheduleAsynchronous": (c_ulong, (CALLBACK, c_void_p, c_ushort)),
    "hdUnschedule": (None, (c_ulong,)),
}
"""Functions that are called, with the types of result and arguments."""

FILES = LibraryFiles(
    variable="HAPTICBRIDGE_HD",
    stems=("HD",),
    names={"linux": ("libHD.so.3.4", "libHD.so.3", "libHD.so"), "win32": ("hd.dll",)},
    missing="OpenHaptics' library (libHD) was not found: install OpenHaptics and the Touch driver "
    "of 3D Systems",
)
"""Files of the library."""

MANY = 64
"""Largest number of errors taken from the queue at once, so that a broken library cannot hang."""


class Hd(MakerLibrary):
    """The loaded library.

    Raises:
        DeviceError: It cannot be loaded, or lacks a function.
    """

    def __init__(self, path: str) -> None:
        super().__init__(path, FUNCTIONS, "OpenHaptics' library (HD), or is older than 3.0")

    def errors(self) -> list[int]:
        """Empties the library's queue of errors; returns their codes, the newest first."""
        codes: list[int] = []
        while len(codes) < MANY and (code := int(self["hdGetError"]().code)):
            codes.append(code)
        return codes

    def refuse_errors(self, what: str) -> None:
        """Raises DeviceError if the queue holds an error; the message is ``what`` and its cause."""
        if codes := self.errors():
            raise DeviceError(f"{what}: {self.cause(codes[-1])}")

    def cause(self, code: int) -> str:
        """Describes an error code in words, with a remedy where one is known."""
        if code in ERRORS:
            return ERRORS[code]
        text = self["hdGetErrorString"](code)
        return text.decode(errors="replace") if text else f"error {code:#06x} of its library"

    def text(self, parameter: int) -> str:
        """Returns a text parameter; empty if the device has none."""
        text = self["hdGetString"](parameter)
        return "" if self.errors() or not text else text.decode(errors="replace")

    def numbers(self, parameter: int, count: int) -> list[float] | None:
        """Returns a parameter of ``count`` numbers; None if the device has none."""
        values = (c_double * count)()
        self["hdGetDoublev"](parameter, ctypes.addressof(values))
        return None if self.errors() else list(values)

    def integer(self, parameter: int) -> int:
        """Returns a whole number; 0 if the device has none."""
        value = c_int()
        self["hdGetIntegerv"](parameter, ctypes.addressof(value))
        return 0 if self.errors() else value.value
