"""The stand-in for Force Dimension's library, compiled, and its device in virtual time."""

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
from hapticbridge.device.force_dimension.device import ForceDimensionDevice
from hapticbridge.device.force_dimension.dhd import Dhd

SOURCE = Path(__file__).with_name("dhd_stub.c")
OMEGA3, OMEGA6, SIGMA7 = 33, 34, 104
CALL = 100e-6
"""In s: what each call of the library takes."""


@functools.cache
def compiled() -> str | None:
    """Returns the stub's file, compiled; None where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    target = Path(tempfile.mkdtemp()) / "libdrd_stub.so"
    subprocess.run(
        [compiler, "-O2", "-shared", "-fPIC", "-Wall", "-Werror", SOURCE, "-o", target, "-lm"],
        check=True,
    )
    return str(target)


class Stub:
    """A device behind the library, new each time; there is one at a time.

    Args:
        kind: What the library says it is.
        path: Where the hand that holds it goes, None for nobody.

    Attributes:
        now: Time in s that the device is at.
        begin: Time in s at which the hand sets out on its path.
    """

    def __init__(self, kind: int = OMEGA3, path: Motion | None = None) -> None:
        file = compiled()
        if file is None:
            pytest.skip("no C compiler (cc), so the stand-in for DHD cannot be built")
        self.file = file
        self.dhd = Dhd(file)
        self.library = ctypes.CDLL(file)
        self.library.stub_force.restype = self.library.stub_command.restype = c_double
        self.begin = 0.0
        self._path = None if path is None else path.relative()
        self.call("reset", kind)
        self.call("call", CALL)

    def call(self, name: str, *arguments: float) -> int:
        """Calls a hook of the stub: ints as they are, floats as doubles."""
        given = [c_int(a) if isinstance(a, int) else c_double(a) for a in arguments]
        return int(getattr(self.library, f"stub_{name}")(*given))

    def force(self) -> NDArray[np.float64]:
        """Returns what the motors give: nothing while they are off."""
        return np.array([self.library.stub_force(axis) for axis in range(6)])

    def command(self) -> NDArray[np.float64]:
        """Returns what they were told last."""
        return np.array([self.library.stub_command(axis) for axis in range(6)])

    @property
    def now(self) -> float:
        return self.dhd.now()

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

    def opened(self, **options: object) -> ForceDimensionDevice:
        return ForceDimensionDevice(self.dhd, **options)  # type: ignore[arg-type]
