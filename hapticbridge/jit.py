"""How this package compiles: one decorator for every function that runs inside a tick."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar, cast

import numba
import platformdirs

_Function = TypeVar("_Function", bound=Callable[..., object])


@cache
def _cache_folder() -> str:
    """Returns where machine code is kept: one folder per state of all compiled sources.

    numba looks only at the file of the function that it loads, but compiled functions inline each
    other across files: with one folder for all, a change in one module would leave its old code in
    the callers. ``NUMBA_CACHE_DIR`` moves the folder.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"hapticbridge.jit import" in source:
            digest.update(source)
    base = numba.config.CACHE_DIR or platformdirs.user_cache_dir("hapticbridge", appauthor=False)
    return str(Path(base) / digest.hexdigest()[:16])


def compiled(function: _Function) -> _Function:
    """Compiles a function with numba: nopython, cached on disk, without the interpreter lock.

    Floating-point semantics stay IEEE (no ``fastmath``): the live loop, the sweeps and the audit's
    re-simulation inline the same functions into different callers and must agree to the bit.
    Division by zero gives inf or nan as in NumPy instead of raising, because an exception cannot
    be raised in the middle of a tick; what is not finite trips the guard.
    """
    outside = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _cache_folder()
    try:
        return cast(_Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
    finally:
        numba.config.CACHE_DIR = outside
