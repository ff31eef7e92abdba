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
def cache_folder() -> str:
    """Returns where machine code is kept: one folder per state of all compiled sources.

    numba looks only at the file of the function that it loads, but compiled functions inline each
    other across files, and the kernel's constants too: with one folder for all, a change in one
    module would leave its old code in the callers. ``NUMBA_CACHE_DIR`` moves the folder.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"hapticbridge.jit import" in source or path.parent.name == "kernel":
            digest.update(source)
    base = numba.config.CACHE_DIR or platformdirs.user_cache_dir("hapticbridge", appauthor=False)
    return str(Path(base) / digest.hexdigest()[:16])


def _compiled(function: _Function, *, nogil: bool) -> _Function:
    outside = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = cache_folder()
    try:
        decorate = numba.njit(cache=True, nogil=nogil, error_model="numpy")
        return cast(_Function, decorate(function))
    finally:
        numba.config.CACHE_DIR = outside


def compiled(function: _Function) -> _Function:
    """Compiles a function with numba: nopython, cached on disk, holding the interpreter lock.

    Floating-point semantics stay IEEE (no ``fastmath``): the live loop, the sweeps and the audit's
    re-simulation inline the same functions into different callers and must agree to the bit.
    Division by zero gives inf or nan as in NumPy instead of raising, because an exception cannot
    be raised in the middle of a tick; what is not finite trips the guard. The lock is held because
    a tick that lets it go for a microsecond may wait milliseconds to get it back.
    """
    return _compiled(function, nogil=False)


def compiled_for_threads(function: _Function) -> _Function:
    """As ``compiled``, but lets the interpreter lock go: for whole runs in several threads."""
    return _compiled(function, nogil=True)


def direct(function: _Function, *arguments: object) -> _Function:
    """Returns a compiled function's machine code for arguments of these types.

    Calling it skips the dispatcher, which looks at the types of all arguments in every call: with
    three structured arrays that takes 0.6 µs, the call itself 0.2 µs. Compiles, or loads from the
    cache, but does not call.

    Args:
        function: What ``compiled`` returned.
        *arguments: Examples of the arguments; only their types matter. The result must never be
            called with others: nothing checks them any more.
    """
    dispatcher = cast(numba.core.dispatcher.Dispatcher, function)
    signature = tuple(numba.typeof(argument) for argument in arguments)
    return cast(_Function, dispatcher.compile(signature))
