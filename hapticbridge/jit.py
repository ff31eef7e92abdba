"""Compilation of the functions that run inside a tick."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property, update_wrapper
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite
import mujoco
import numpy as np
import platformdirs

from hapticbridge import machine_code

_Function = TypeVar("_Function", bound=Callable[..., object])


@cache
def cache_folder() -> Path:
    """Returns the folder of the machine code, one per state of all compiled sources.

    numba checks only the file of the function that it loads, but compiled functions inline each
    other across files, and the kernel's constants too. With one folder for all, callers would keep
    the old code of a changed module. ``NUMBA_CACHE_DIR`` moves the folder.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        source = path.read_bytes()
        if b"hapticbridge.jit import" in source or path.parent.name == "kernel":
            digest.update(source)
    base = os.environ.get("NUMBA_CACHE_DIR") or platformdirs.user_cache_dir(
        "hapticbridge", appauthor=False
    )
    return Path(base) / digest.hexdigest()[:16]


@cache
def _environment() -> str:
    """Returns all that decides a function's machine code besides the sources, as text."""
    numba = find_spec("numba")  # without importing it
    version = (
        Path(numba.origin).with_name("_version.py").read_text() if numba and numba.origin else ""
    )
    settings = sorted(item for item in os.environ.items() if item[0].startswith("NUMBA_"))
    _, machine = machine_code.machine()
    versions = version, llvmlite.__version__, mujoco.__version__, np.__version__
    return repr((Path(machine_code.__file__).read_bytes(), versions, settings, machine))


_decorating = threading.Lock()


class Deferred:
    """Object of numba, built when numba first compiles a caller or Python first calls it.

    Args:
        build: Returns what numba makes of the function.
    """

    def __init__(self, build: Callable[[], Any]) -> None:
        self._build = build

    @cached_property
    def built(self) -> Any:
        """What numba made."""
        return self._build()

    @cached_property
    def _numba_type_(self) -> Any:
        """Type by which numba treats this object in a caller as what was built."""
        from numba.core.registry import cpu_target

        context, built = cpu_target.typing_context, self.built
        context.refresh()  # an intrinsic has just been registered
        return context.resolve_value_type(built)

    def __call__(self, *arguments: object) -> Any:
        return self.built(*arguments)


class Compiled(Deferred):
    """Function that numba compiles, cached on disk.

    Args:
        function: The function in Python.
        nogil: True to release the interpreter lock in calls from Python.
    """

    def __init__(self, function: Callable[..., object], *, nogil: bool) -> None:
        super().__init__(lambda: self._decorated(is_cached=True))
        update_wrapper(self, function)
        self._function, self._nogil = function, nogil
        self._direct: dict[tuple[str, ...], Callable[..., Any]] = {}

    def _decorated(self, *, is_cached: bool) -> Any:
        """Returns the function as numba's dispatcher."""
        import numba

        decorate = numba.njit(cache=is_cached, nogil=self._nogil, error_model="numpy")
        with _decorating:
            outside = numba.config.CACHE_DIR
            numba.config.CACHE_DIR = str(cache_folder())
            try:
                return decorate(self._function)
            finally:
                numba.config.CACHE_DIR = outside

    def direct(self, arguments: tuple[object, ...]) -> Callable[..., Any]:
        """Returns the machine code for arguments of these types (``jit.direct``)."""
        kinds = tuple(machine_code.kind_of(argument) for argument in arguments)
        if self._nogil or not all(kinds):
            return cast(Callable[..., Any], self.built.compile(_signature(arguments)))
        if kinds not in self._direct:
            self._direct[kinds] = self._loaded(kinds, arguments)
        return self._direct[kinds]

    def _path(self, kinds: tuple[str, ...]) -> Path:
        function = self._function
        what = f"{function.__module__}.{function.__qualname__} {kinds} {_environment()}"
        digest = hashlib.sha256(what.encode()).hexdigest()[:16]
        return cache_folder() / f"{function.__name__}-{digest}.o"

    def _loaded(self, kinds: tuple[str, ...], arguments: tuple[object, ...]) -> Callable[..., Any]:
        path, name = self._path(kinds), self._function.__name__
        code = machine_code.read(path)
        if code is None:
            code = self._object_code(kinds, _signature(arguments))
            machine_code.write(path, code)
        if code:
            with suppress(RuntimeError):
                return machine_code.load(code, name)
        return cast(Callable[..., Any], self.built.compile(_signature(arguments)))

    def _object_code(self, kinds: tuple[str, ...], signature: tuple[Any, ...]) -> bytes:
        """Returns the object code, empty if the function needs numba's runtime."""
        dispatcher = self._decorated(is_cached=False)  # numba prints no code of a cached function
        dispatcher.compile(signature)
        found = dispatcher.overloads[signature]
        try:
            code = machine_code.object_code(
                dispatcher.inspect_llvm(signature),
                found.fndesc.llvm_func_name,
                kinds,
                str(found.signature.return_type),
            )
            machine_code.load(code, self._function.__name__)
        except (RuntimeError, KeyError):
            return b""
        return code


def _signature(arguments: tuple[object, ...]) -> tuple[Any, ...]:
    import numba

    return tuple(numba.typeof(argument) for argument in arguments)


def compiled(function: _Function) -> _Function:
    """Compiles a function with numba: nopython, cached on disk, holding the interpreter lock.

    Floating-point semantics stay IEEE (no ``fastmath``). The live loop, the sweeps and the audit's
    re-simulation inline the functions into different callers and must agree to the bit. Division by
    zero gives inf or nan as in NumPy, because a tick must not raise; a result that is not finite
    trips the guard. The lock is held because a tick that releases it for a microsecond may wait
    milliseconds to regain it.
    """
    return cast(_Function, Compiled(function, nogil=False))


def compiled_for_threads(function: _Function) -> _Function:
    """Compiles like ``compiled``, but releases the interpreter lock: for whole runs in threads."""
    return cast(_Function, Compiled(function, nogil=True))


def intrinsic(function: Callable[..., Any]) -> Any:
    """Declares a function that writes LLVM code (``numba.extending.intrinsic``)."""

    def build() -> Any:
        import numba.extending

        return numba.extending.intrinsic(function)

    return Deferred(build)


def external(symbol: str, signature: str) -> Any:
    """Declares a C function for compiled callers, with a signature such as "void(intp, intp)"."""

    def build() -> Any:
        from numba import types
        from numba.core import sigutils

        arguments, result = sigutils.normalize_signature(signature)
        return types.ExternalFunction(symbol, result(*arguments))

    return Deferred(build)


def direct(function: _Function, *arguments: object) -> _Function:
    """Returns a compiled function's machine code for arguments of these types, without calling it.

    It skips the dispatcher, which checks the types of all arguments in every call: 0.6 µs with
    three structured arrays, while the call itself takes 0.2 µs. If the machine code is on disk,
    numba is not imported (``machine_code``).

    Args:
        function: Function from ``compiled``.
        *arguments: Examples of the arguments, for their types. The result must never be called with
            other types; nothing checks them.
    """
    return cast(_Function, cast(Compiled, function).direct(arguments))
