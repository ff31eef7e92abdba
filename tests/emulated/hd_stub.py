"""The stand-in for OpenHaptics' library, compiled, and its device in virtual time."""

from __future__ import annotations

import ctypes
import functools
import shutil
import subprocess
import tempfile
from ctypes import c_double, c_int
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticbridge.device import Motion
from hapticbridge.device.touch.device import TouchDevice
from hapticbridge.device.touch.hd import Hd

SOURCE = Path(__file__).with_name("hd_stub.c")


@functools.cache
def compiled() -> str | None:
    """Returns the stub's file, compiled; None where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    target = Path(tempfile.mkdtemp()) / "libHD_stub.so"
    arguments = ["-O2", "-shared", "-fPIC", "-Wall", "-Werror", str(SOURCE), "-o", str(target)]
    subprocess.run([compiler, *arguments, "-lm", "-lpthread"], check=True)
    return str(target)


class HdStub:
    """A Touch behind the library, new each time; there is one at a time.

    Args:
        path: Where the hand that holds it goes, None for nobody.

    Attributes:
        now: Time in s that the device is at.
        begin: Time in s at which the hand sets out on its path.
    """

    def __init__(self, path: Motion | None = None) -> None:
        file = compiled()
        if file is None:
            pytest.skip("no C compiler (cc), so the stand-in for OpenHaptics cannot be built")
        self.file = file
        self.hd = Hd(file)
        self.library = ctypes.CDLL(file)
        self.library.stub_force.restype = self.library.stub_now.restype = c_double
        self.begin = 0.0
        self._path = None if path is None else path.relative()
        self.call("reset")

    def call(self, name: str, *arguments: float) -> int:
        """Calls a hook of the stub: ints as they are, floats as doubles."""
        given = [c_int(a) if isinstance(a, int) else c_double(a) for a in arguments]
        return int(getattr(self.library, f"stub_{name}")(*given))

    def force(self) -> NDArray[np.float64]:
        """Returns what the motors give, in the driver's axes: nothing while they are off."""
        x, y, z = (self.library.stub_force(axis) for axis in range(3))
        return np.array([x, -z, y])

    @property
    def now(self) -> float:
        return float(self.library.stub_now())

    @now.setter
    def now(self, now: float) -> None:
        self.advance(now)

    def advance(self, now: float) -> None:
        if self._path is not None:
            table = self._path.table
            place = [
                float(np.interp(now - self.begin, table[:, 0], table[:, 1 + i])) for i in range(3)
            ]
            self.call("target", *place)
        self.call("advance", float(now))

    def opened(self, **options: object) -> TouchDevice:
        return TouchDevice(self.hd, waiting=Virtual(self), **options)  # type: ignore[arg-type]


class Virtual:
    """The stub's time as the driver's."""

    def __init__(self, stub: HdStub) -> None:
        self._stub = stub

    def now(self) -> float:
        return self._stub.now

    def sleep(self, seconds: float) -> None:
        self._stub.advance(self._stub.now + seconds)
