"""Base of the stand-ins for makers' libraries: compiled C, and its device in virtual time."""

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

from hapticbridge.device import Motion


@functools.cache
def compiled(source: str) -> str:
    """Returns the file of a stub beside this one, compiled; skips the test without a compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip(f"no C compiler (cc), so {source} cannot be built")
    target = Path(tempfile.mkdtemp()) / f"lib{Path(source).stem}.so"
    words = ["-O2", "-shared", "-fPIC", "-Wall", "-Werror", str(Path(__file__).with_name(source))]
    subprocess.run([compiler, *words, "-o", target, "-lm", "-lpthread"], check=True)
    return str(target)


class LibraryStub:
    """A device behind a stand-in, new each time; there is one at a time.

    Args:
        source: The stub's file.
        path: Where the hand that holds it goes, None for nobody.

    Attributes:
        file: The compiled library.
        begin: Time in s at which the hand sets out on its path.
    """

    def __init__(self, source: str, path: Motion | None = None) -> None:
        self.file = compiled(source)
        self.library = ctypes.CDLL(self.file)
        self.begin = 0.0
        self._path = None if path is None else path.relative()

    def call(self, name: str, *arguments: float) -> int:
        """Calls a hook of the stub: ints as they are, floats as doubles."""
        given = [c_int(a) if isinstance(a, int) else c_double(a) for a in arguments]
        return int(getattr(self.library, f"stub_{name}")(*given))

    def number(self, name: str, *arguments: int) -> float:
        """Returns a hook's number with digits."""
        hook = getattr(self.library, f"stub_{name}")
        hook.restype = c_double
        return float(hook(*arguments))

    def advance(self, now: float) -> None:
        """Moves the device's time on, and the hand along its path."""
        if self._path is not None:
            table = self._path.table
            place = [
                float(np.interp(now - self.begin, table[:, 0], table[:, 1 + i])) for i in range(3)
            ]
            self.call("target", *place)
        self.call("advance", float(now))
