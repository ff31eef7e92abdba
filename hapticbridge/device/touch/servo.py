"""OpenHaptics' low-level library (HD), and the compiled callback in its servo thread.

The library is not part of this project; it is loaded at run time. Signatures and codes follow the
maker's header ``hdDefines.h`` and API reference, version 3. Lengths in mm, forces in N. Errors are
queued by the library: a call returns nothing, and ``hdGetError`` removes the newest one from the
queue.

The library runs the callback at 1 kHz in a thread of its own. It is compiled, so it takes neither
Python's lock nor memory: a loop that stalls, or holds the lock, does not stop it. In each servo
tick it reads the pose, sends the newest force, and publishes both:

    force = share · f_newest,  ‖f‖ <= limit,  share = 1 − (age − hold)/fade, clamped to 0 … 1

``age`` is the number of servo ticks since the driver's newest force. So a force that no loop renews
fades to zero, which is the watchdog. An error of the library, a lost calibration and a force that
is not finite end the force too.

Both directions are rings of ``SLOTS`` entries with one writer each. A writer completes an entry,
then raises its counter; a reader takes the entry of the counter that it read. An entry is written
again only after ``SLOTS`` − 1 further ticks.
"""

from __future__ import annotations

import ctypes
import sys
from ctypes import c_char_p, c_double, c_int, c_uint, c_uint64, c_ulong, c_ushort, c_void_p
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.transport.maker_library import LibraryFiles, MakerLibrary
from hapticbridge.errors import DeviceError

# Functions and codes of the library

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


# Compiled callback in the library's thread

SLOTS = 8
"""Entries of a ring. A reader that is interrupted for 7 servo ticks while it copies one finds that
the counter has moved on and copies again."""

SERVO_DTYPE = np.dtype(
    [
        ("address", "<i8"),
        ("device", "<u4"),
        ("calibration", "<u4"),
        ("ticks", "<i8"),
        ("positions", "<f8", (SLOTS, 3)),
        ("transforms", "<f8", (SLOTS, 16)),
        ("buttons", "<i4", SLOTS),
        ("command", "<i8"),
        ("forces", "<f8", (SLOTS, 3)),
        ("hold", "<i8"),
        ("fade", "<i8"),
        ("limit", "<f8"),
        ("seen", "<i8"),
        ("age", "<i8"),
        ("faded", "<i8"),
        ("force", "<f8", 3),
        ("error", "<i8"),
        ("news", "<u4", 4),
    ],
    align=True,
)
"""Shared memory. The driver writes ``command``, ``forces``, ``hold``, ``fade``, ``limit``, and
resets ``error``; the callback writes the rest. ``hold`` and ``fade`` in servo ticks, ``fade`` > 0;
``limit`` and ``force`` in N, ``positions`` in mm; ``faded`` counts the ticks with a lowered force;
``error`` is the first code since the reset, ``news`` the newest entry of the queue."""

DONE, AGAIN = 0, 1
"""Answers of a callback: it is removed from the scheduler, or runs in the next tick too."""


def _place(name: str) -> int:
    return int(SERVO_DTYPE.fields[name][1])  # type: ignore[index]


POSITIONS, TRANSFORMS, BUTTONS, FORCE, NEWS = map(
    _place, ("positions", "transforms", "buttons", "force", "news")
)


def _function(hd: Hd, name: str, result: Any, *arguments: Any) -> Any:
    """Returns a function of the library that compiled code can call, with pointers as integers."""
    address = ctypes.cast(hd[name], ctypes.c_void_p).value
    assert address is not None
    return ctypes.CFUNCTYPE(result, *arguments)(address)


def compiled_servo(hd: Hd) -> Any:
    """Compiles the callback for a library; the result must be kept while it is scheduled."""
    numba = import_module("numba")
    types = import_module("numba.core.types")
    word = ctypes.c_ssize_t
    begin_frame = _function(hd, "hdBeginFrame", None, c_uint)
    end_frame = _function(hd, "hdEndFrame", None, c_uint)
    get_doubles = _function(hd, "hdGetDoublev", None, c_uint, word)
    get_integers = _function(hd, "hdGetIntegerv", None, c_uint, word)
    set_doubles = _function(hd, "hdSetDoublev", None, c_uint, word)
    check_calibration = _function(hd, "hdCheckCalibration", c_uint)
    # hdGetError returns 12 bytes by value. By the calling conventions of Linux and macOS the first
    # 8 come back in a register, the code in their lower half; by that of Windows the caller names
    # the memory for them.
    is_in_memory = sys.platform == "win32"
    take_error = _function(hd, "hdGetError", c_uint64)
    store_error = _function(hd, "hdGetError", c_uint64, word)
    carray = numba.carray

    def servo(pointer: Any) -> int:
        s = carray(pointer, 1)[0]
        begin_frame(s.device)
        slot = (s.ticks + 1) % SLOTS
        get_doubles(CURRENT_POSITION, s.address + POSITIONS + 24 * slot)
        get_doubles(CURRENT_TRANSFORM, s.address + TRANSFORMS + 128 * slot)
        get_integers(CURRENT_BUTTONS, s.address + BUTTONS + 4 * slot)
        newest = s.command
        s.age = 0 if newest != s.seen else s.age + 1
        s.seen = newest
        share = min(max(1.0 - (s.age - s.hold) / s.fade, 0.0), 1.0)
        x = s.forces[newest % SLOTS][0]
        y = s.forces[newest % SLOTS][1]
        z = s.forces[newest % SLOTS][2]
        size = np.sqrt(x * x + y * y + z * z)
        if share < 1.0 and size > 0.0:
            s.faded += 1
        if size > s.limit:
            share *= s.limit / size
        if s.error != 0 or s.calibration != CALIBRATED or not size < np.inf:
            share = x = y = z = 0.0
        s.force[0], s.force[1], s.force[2] = share * x, share * y, share * z
        set_doubles(CURRENT_FORCE, s.address + FORCE)
        end_frame(s.device)
        for _ in range(MANY):
            if is_in_memory:
                store_error(s.address + NEWS)
            else:
                s.news[0] = take_error() & 0xFFFFFFFF
            code = s.news[0]
            if code == 0:
                break
            if s.error == 0:
                s.error = code
        s.calibration = check_calibration()
        s.ticks += 1
        return AGAIN

    record = numba.from_dtype(SERVO_DTYPE)
    return numba.cfunc(types.uint32(types.CPointer(record)))(servo)


@dataclass(frozen=True, slots=True)
class ServoSample:
    """Newest servo tick.

    Attributes:
        ticks: Number of servo ticks so far; 0 before the first.
        position: In mm, shape (3,).
        transform: Column by column, shape (16,).
        buttons: One bit per button.
    """

    ticks: int
    position: NDArray[np.float64]
    transform: NDArray[np.float64]
    buttons: int


class Servo:
    """The driver's side of the shared memory.

    Args:
        hd: The library.
        device: Handle of the open device.
        limit: Largest force in N.
    """

    def __init__(self, hd: Hd, device: int, limit: float) -> None:
        self.callback = compiled_servo(hd)
        self.memory = np.zeros(1, SERVO_DTYPE)
        self._shared = self.memory[0]
        self.memory["address"] = self.address
        self.memory["device"], self.memory["calibration"] = device, CALIBRATED
        self.memory["limit"], self.memory["fade"] = limit, 1

    @property
    def address(self) -> int:
        """Address of the shared memory, which the callback is given."""
        return int(self.memory.ctypes.data)

    def watch(self, hold: int, fade: int) -> None:
        """Sets the watchdog: servo ticks at full force without a new one, and of the fading."""
        self.memory["hold"], self.memory["fade"] = hold, fade

    def send(self, force: tuple[float, float, float]) -> None:
        """Publishes a force in N."""
        number = int(self._shared["command"]) + 1
        self._shared["forces"][number % SLOTS] = force
        self._shared["command"] = number

    def newest(self) -> ServoSample:
        """Returns the newest sample, copied while the servo thread goes on."""
        shared = self._shared
        while True:
            ticks = int(shared["ticks"])
            slot = ticks % SLOTS
            sample = ServoSample(
                ticks,
                shared["positions"][slot].copy(),
                shared["transforms"][slot].copy(),
                int(shared["buttons"][slot]),
            )
            if int(shared["ticks"]) - ticks < SLOTS - 1:
                return sample

    @property
    def error(self) -> int:
        """Code of the first error since ``forget``; 0 if there was none."""
        return int(self._shared["error"])

    def forget(self) -> None:
        """Forgets a past error."""
        self._shared["error"] = 0

    @property
    def is_calibrated(self) -> bool:
        """True if the device was calibrated in the newest servo tick."""
        return int(self._shared["calibration"]) == CALIBRATED

    @property
    def faded(self) -> int:
        """Number of servo ticks in which the watchdog lowered the force."""
        return int(self._shared["faded"])
