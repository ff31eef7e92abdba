"""Compilation of the functions that run inside a tick."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import EnumType
from functools import cache, cached_property, partial, update_wrapper
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from types import CodeType, FunctionType
from typing import Any, NamedTuple, TypeVar, cast

import llvmlite
import mujoco
import numpy as np
import platformdirs

from hapticbridge.errors import HapticBridgeError
from hapticbridge.files import NO_HOME, user_folder
from hapticbridge.kernel import machine_code

_Function = TypeVar("_Function", bound=Callable[..., object])


@cache
def cache_folder() -> Path | None:
    """Returns the folder of the machine code; None if it cannot be kept there safely.

    ``NUMBA_CACHE_DIR`` moves the folder. Without a folder everything is compiled in memory, in
    every process; a warning has the reason.
    """
    set_by_user = os.environ.get("NUMBA_CACHE_DIR")
    above = Path(set_by_user) if set_by_user else user_folder(platformdirs.user_cache_dir)
    folder = above and (above / "machine_code").resolve()
    fault = machine_code.fault_of(folder) if folder else f"{NO_HOME} or NUMBA_CACHE_DIR"
    if fault:
        warnings.warn(
            f"machine code is not kept, so every start compiles for a minute: {fault}",
            stacklevel=2,
        )
    return None if fault else folder


def _digest(function: Callable[..., object], *more: object) -> str:
    """Returns a digest of all that decides a function's machine code.

    Compiled functions inline each other across files, and constants too; numba's own cache checks
    only the file of the function that it loads. Code and constants are those in memory: a file may
    have changed since it was imported.
    """
    texts, left = [_environment(), repr(more)], [cast(FunctionType, function)]
    found = set(left)
    while left:
        text, callees = _ingredients(left.pop())
        texts.append(text)
        left += (callee for callee in dict.fromkeys(callees) if callee not in found)
        found.update(callees)
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


@cache
def _ingredients(function: FunctionType) -> tuple[str, tuple[FunctionType, ...]]:
    """Returns a function's name, code and constants as text, and the functions that it names."""
    parts: list[object] = [function.__module__, function.__qualname__]
    callees: list[FunctionType] = []

    def note(value: object) -> None:
        if isinstance(value, Deferred):
            value = value.source
        if isinstance(value, tuple):
            parts.append(len(value))
            for item in value:
                note(item)
        elif isinstance(value, FunctionType):
            parts.append(value.__qualname__)
            callees.append(value)
        else:
            parts.append(_content(value))

    codes = [function.__code__]
    for code in codes:
        codes += (item for item in code.co_consts if isinstance(item, CodeType))
        parts.append((code.co_code, code.co_exceptiontable, code.co_names))
        note(tuple(item for item in code.co_consts if not isinstance(item, CodeType)))
        note(tuple(function.__globals__.get(name) for name in code.co_names))
    note(function.__defaults__)
    note(tuple(cell.cell_contents for cell in function.__closure__ or ()))
    return repr(parts), tuple(callees)


def _content(value: object) -> object:
    """Returns what numba compiles into a function for a constant of it or a global name."""
    if isinstance(value, np.ndarray):
        return value.dtype, value.shape, value.tobytes()
    if isinstance(value, EnumType):
        return value.__qualname__, [(each.name, each.value) for each in cast(Any, value)]
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    if isinstance(value, bool | int | float | str | bytes | np.generic | np.dtype):
        return type(value).__qualname__, repr(value)
    # a module, a class or a C function; the versions of packages are counted
    names = "__name__", "_fields", "symbol", "sig"
    return type(value).__qualname__, [str(getattr(value, name, "")) for name in names]


@cache
def _environment() -> str:
    """Returns the rest of what decides a function's machine code, as text."""
    numba = find_spec("numba")  # the version without an import
    assert numba is not None and numba.origin is not None
    own = Path(machine_code.__file__)
    files = Path(numba.origin).with_name("_version.py"), own, own.with_name("whole_program.py")
    versions = llvmlite.__version__, mujoco.__version__, np.__version__, sys.version_info[:2]
    settings = sorted(
        item
        for item in os.environ.items()
        if item[0].startswith("NUMBA_") and item[0] != "NUMBA_CACHE_DIR"
    )
    contents = tuple(file.read_bytes() for file in files)
    return repr((contents, versions, settings, machine_code.processor()))


class Deferred:
    """Object of numba that is built when numba compiles its first caller, or Python calls it.

    Args:
        build: Returns the object.
    """

    def __init__(self, build: Callable[[], Any]) -> None:
        self._build = build

    @property
    def source(self) -> Callable[..., object]:
        """Function in Python that decides what is built."""
        return self._build

    @cached_property
    def built(self) -> Any:
        """The object of numba."""
        return self._build()

    @cached_property
    def _numba_type_(self) -> Any:
        """Type that numba sees in a caller: that of the object which was built."""
        context = import_module("numba.core.registry").cpu_target.typing_context
        built = self.built
        context.refresh()  # building an intrinsic has registered it
        return context.resolve_value_type(built)

    def __call__(self, *arguments: object) -> Any:
        """Calls the object of numba."""
        return self.built(*arguments)


class Compiled(Deferred):
    """Function that numba compiles, or that was compiled before and is on disk.

    Args:
        function: The function in Python.
        nogil: True to release the interpreter lock in calls from Python.
    """

    def __init__(self, function: Callable[..., object], *, nogil: bool) -> None:
        super().__init__(self._decorated)
        update_wrapper(self, function)
        self._function, self._nogil = function, nogil
        self._direct: dict[tuple[machine_code.Kind, ...], Callable[..., Any]] = {}

    @property
    def source(self) -> Callable[..., object]:
        """The function in Python."""
        return self._function

    def __call__(self, *arguments: object) -> Any:
        """Calls the machine code for arguments of these types."""
        return self.direct(arguments)(*arguments)

    def direct(self, arguments: tuple[object, ...]) -> Callable[..., Any]:
        """Returns the machine code for arguments of these types (``jit.direct``)."""
        found = [machine_code.kind_of(argument) for argument in arguments]
        kinds = tuple(kind for kind in found if kind is not None)
        # the linker's rules for other systems are untested
        if len(kinds) < len(found) or sys.platform != "linux":
            return self._by_numba(arguments)
        if kinds not in self._direct:
            self._direct[kinds] = self._loaded(arguments) or self._by_numba(arguments)
        return self._direct[kinds]

    def callback(self, c_types: tuple[str, ...]) -> int:
        """Returns the address of a C function that calls the machine code (``jit.callback``)."""
        arguments = examples(c_types)
        code = b""
        if sys.platform == "linux":
            code = self._object_code(arguments, c_types)
        with suppress(RuntimeError):  # the linker refuses it
            if code:
                return machine_code.address_of(code, self._function.__name__)
        return self._c(c_types)

    def _c(self, c_types: tuple[str, ...]) -> int:
        numba, called = _numba(), self.built
        names = {"ptr": "intp", "i64": "intp", "i32": "int32", "double": "float64"}
        signature = f"int32({', '.join(names[kind] for kind in c_types)})"

        def call(a: int, b: int, c: int, d: int, e: int, f: float) -> int:  # cfunc takes no *args
            return int(called(a, b, c, d, e, f))

        function = numba.cfunc(signature)(call)
        _callbacks.append(function)
        return int(function.address)

    def _by_numba(self, arguments: tuple[object, ...]) -> Callable[..., Any]:
        return cast(Callable[..., Any], self.built.compile(_signature(arguments)))

    def _loaded(self, arguments: tuple[object, ...]) -> Callable[..., Any] | None:
        code = self._object_code(arguments)
        try:
            return machine_code.load(code, self._function.__name__) if code else None
        except RuntimeError:
            return None

    def _object_code(
        self,
        arguments: tuple[object, ...],
        c_types: tuple[str, ...] = (),
    ) -> bytes:
        """Returns the machine code on disk, compiled before if it is not there."""
        folder, name = cache_folder(), self.file_name(arguments, c_types)
        code = machine_code.read(READY_MADE / name)
        if code is None and folder is not None:
            code = machine_code.read(folder / name)
        if code is None:
            program = self.program(arguments, c_types)
            code = machine_code.object_code(program)
            if folder is not None and (code or not program):  # no room now may be room later
                machine_code.write(folder / name, code)
        return code

    def file_name(self, arguments: tuple[object, ...], c_types: tuple[str, ...] = ()) -> str:
        """Returns the name of the file of the machine code for arguments of these types."""
        kinds = (cast(machine_code.Kind, machine_code.kind_of(each)) for each in arguments)
        types = *map(machine_code.name_of, kinds), *c_types
        return f"{self._function.__name__}-{_digest(self._function, types, self._nogil)}.o"

    def program(self, arguments: tuple[object, ...], c_types: tuple[str, ...] = ()) -> bytes:
        """Returns the function with all that it calls and an entry, as LLVM's bitcode.

        It is empty if numba must compile the function for itself.
        """
        signature = _signature(arguments)
        try:
            with import_module("hapticbridge.kernel.whole_program").whole_program():
                self._part.compile(signature)
                found = self._part.overloads[signature]
                return machine_code.program(
                    found.library.modules(),
                    found.fndesc.llvm_func_name,
                    [cast(machine_code.Kind, machine_code.kind_of(each)) for each in arguments],
                    str(found.signature.return_type),
                    c_types=c_types,
                    releases_lock=self._nogil,
                )
        except (ImportError, AttributeError):  # with a numba whose inner parts are others
            return b""

    @cached_property
    def _part(self) -> Any:
        """The function as a part of a program that is compiled as a whole."""
        return _numba().njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(
            self._function
        )

    @property
    def _numba_type_(self) -> Any:
        """Type that numba sees in a caller."""
        is_part = import_module("hapticbridge.kernel.whole_program").is_open()
        return (self._part if is_part else self.built)._numba_type_

    def _decorated(self) -> Any:
        numba = _numba()
        decorate = partial(numba.njit, nogil=self._nogil, error_model="numpy")
        folder = cache_folder()
        if folder is None:
            return decorate()(self._function)
        own = folder / f"{self._function.__name__}-{_digest(self._function)}"
        with _decorating:
            outside = numba.config.CACHE_DIR
            numba.config.CACHE_DIR = str(own)
            try:
                function = decorate(cache=True)(self._function)
            finally:
                numba.config.CACHE_DIR = outside
        # where it cannot write, numba turns to folders beside the sources and of other programs
        is_ours = Path(function.stats.cache_path).is_relative_to(own)
        return function if is_ours else decorate()(self._function)


def _numba() -> Any:
    """Imports numba.

    Raises:
        HapticBridgeError: The user disabled its compiler, or has a setting that it refuses.
    """
    try:
        numba = import_module("numba")
    except ValueError as error:
        names = ", ".join(sorted(name for name in os.environ if name.startswith("NUMBA_")))
        raise HapticBridgeError(
            f"the compiler numba refuses a setting of the environment: {error} Set are "
            f"{names or 'none'}; unset the one that it means"
        ) from None
    if numba.config.DISABLE_JIT:
        raise HapticBridgeError(
            "NUMBA_DISABLE_JIT is set, and a tick calls MuJoCo from compiled code alone; unset it"
        )
    return numba


def examples(c_types: tuple[str, ...]) -> tuple[object, ...]:
    """Returns arguments of the types of a C function."""
    return tuple(0.0 if kind == "double" else 0 for kind in c_types)


class Program(NamedTuple):
    """Function from ``compiled`` with examples of its arguments, or its types as a C function."""

    function: Any
    arguments: tuple[object, ...]
    c_types: tuple[str, ...] = ()


def prepare(programs: Sequence[Program], note: Callable[[int], None]) -> None:
    """Compiles the programs whose machine code is not on disk, on two processors.

    This process types and lowers one program while a child optimises another.

    Args:
        programs: What is to be on disk.
        note: Called with the number of programs that are left, before each.
    """
    folder = cache_folder()
    if folder is None or sys.platform != "linux":
        return
    missing: dict[str, Program] = {}
    for each in programs:
        name = each.function.file_name(each.arguments, each.c_types)
        if not any((place / name).exists() for place in (READY_MADE, folder)):
            missing[name] = each
    if not missing:
        return
    command = [sys.executable, "-c", "from hapticbridge.kernel.machine_code import serve; serve()"]
    with TemporaryDirectory(dir=folder) as place, suppress(OSError):  # no child, or it was ended
        # in a session of its own: Ctrl-C reaches this process, which ends the child
        child = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, start_new_session=True)
        assert child.stdin is not None
        with child:
            try:
                for count, (name, each) in enumerate(missing.items()):
                    note(len(missing) - count)
                    path = Path(place, name).with_suffix(".bc")
                    path.write_bytes(each.function.program(each.arguments, each.c_types))
                    child.stdin.write(f"{path}\n")
                    child.stdin.flush()
            except BaseException:
                child.kill()
                raise
        for name in missing:
            with suppress(FileNotFoundError):  # the child was ended; compiled when it is needed
                if code := Path(place, name).read_bytes():
                    machine_code.write(folder / name, code)


READY_MADE = Path(__file__).parents[1] / "ready_made"
"""Folder of machine code that was made with the wheel; a checkout has none."""

_callbacks: list[object] = []
"""C functions that numba made, which must live until the process ends."""

_decorating = threading.Lock()
"""Held while numba's setting of the cache folder is another one."""


def _signature(arguments: tuple[object, ...]) -> tuple[Any, ...]:
    return tuple(map(_numba().typeof, arguments))


def compiled(function: _Function) -> _Function:
    """Compiles a function with numba: nopython, cached on disk, holding the interpreter lock.

    Floating-point semantics stay IEEE (no ``fastmath``). The live loop, the sweeps and the audit's
    re-simulation inline the functions into different callers and must agree to the bit. Division by
    zero gives inf or nan as in NumPy, because a tick must not raise; a result that is not finite
    trips the guard. The lock is held because a tick that releases it for a microsecond may wait
    milliseconds to regain it.
    """
    return cast(_Function, Compiled(function, nogil=False))


def source_of(function: _Function) -> _Function:
    """Returns the function in Python of one from ``compiled``, for calls outside of the loop."""
    return cast(_Function, cast(Any, function).source)


def compiled_for_threads(function: _Function) -> _Function:
    """Compiles like ``compiled``, but releases the interpreter lock: for whole runs in threads."""
    return cast(_Function, Compiled(function, nogil=True))


def intrinsic(function: Callable[..., Any]) -> Any:
    """Declares a function that writes LLVM code (``numba.extending.intrinsic``)."""
    return Deferred(lambda: import_module("numba.extending").intrinsic(function))


def stack_floats(count: int) -> Any:
    """Declares a function that returns the address of ``count`` doubles on its caller's stack.

    The memory belongs to the compiled function that calls it, until that returns.
    """

    def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        types, lir = import_module("numba.core.types"), import_module("llvmlite.ir")
        cgutils = import_module("numba.core.cgutils")
        block = cgutils.alloca_once(builder, lir.ArrayType(lir.DoubleType(), count))
        return builder.ptrtoint(block, context.get_value_type(types.intp))

    def address(_typing: Any) -> Any:
        return import_module("numba.core.types").intp(), generate

    return intrinsic(address)


def external(symbol: str, signature: str) -> Any:
    """Declares a C function for compiled callers, with a signature such as "void(intp, intp)"."""

    def build() -> Any:
        sigutils = import_module("numba.core.sigutils")
        arguments, result = sigutils.normalize_signature(signature)
        return import_module("numba.core.types").ExternalFunction(symbol, result(*arguments))

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


def callback(function: Callable[..., int], *c_types: str) -> int:
    """Returns the address of a C function that calls a compiled function and returns an ``int``.

    Args:
        function: Function from ``compiled`` that returns an integer, allocates nothing and raises
            nothing. Python calls it with addresses as integers.
        *c_types: Types of the six arguments: "i64" (also for pointers), "i32" or "double".
    """
    return cast(Compiled, function).callback(c_types)
