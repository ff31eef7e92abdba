"""How this package compiles: one decorator for every function that runs inside a tick."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compiles a function with numba: nopython, cached on disk, without the interpreter lock.

    Floating-point semantics stay IEEE (no ``fastmath``): the live loop, the sweeps and the audit's
    re-simulation inline the same functions into different callers and must agree to the bit.
    Division by zero gives inf or nan as in NumPy instead of raising, because an exception cannot
    be raised in the middle of a tick; what is not finite trips the guard.
    """
    return cast(_Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
