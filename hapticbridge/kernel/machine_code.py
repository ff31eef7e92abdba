"""Machine code of compiled functions, kept on disk and called without numba.

Importing numba and its registries takes longer than all else at the start of a run. A file of this
module holds one function as an object file, which llvmlite loads alone. The code is numba's own;
an entry in front of it takes Python objects apart (``METH_FASTCALL``).

A function can be kept if it needs only MuJoCo, the C library and CPython. Code that may allocate or
raise needs numba's runtime; the linker then refuses it, and the caller uses numba.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, TypeAlias

import llvmlite.binding as llvm
import numpy as np

if sys.platform != "win32":
    import grp
    import pwd

Kind: TypeAlias = "type | tuple[np.dtype[Any], int] | tuple[Kind, ...]"
"""Type of an argument: ``bool``, ``int`` or ``float``; the type of an array's items and the number
of its axes, 0 for a record; or the types of a tuple's items."""

_ENTRY = "hapticbridge_entry"

_HEADER = object.__basicsize__
"""Size in bytes of the header of Python objects. In an array, the address of the data follows, the
number of axes in 8 bytes, and the address of the shape; in a record, a size in 8 bytes and the
address of the data. NumPy's public C headers declare both."""

_FAST_CALL = 0x80
"""Flag ``METH_FASTCALL``: a function is called with an array of arguments and their number."""

_RESULTS = {
    "none": ("ptr", "call void @Py_IncRef(ptr @_Py_NoneStruct)\nret ptr @_Py_NoneStruct"),
    "bool": (
        "i8",
        "%byte = load i8, ptr %place\n%wide = zext i8 %byte to i64\n"
        "%object = call ptr @PyBool_FromLong(i64 %wide)\nret ptr %object",
    ),
    "int64": (
        "i64",
        "%number = load i64, ptr %place\n"
        "%object = call ptr @PyLong_FromLongLong(i64 %number)\nret ptr %object",
    ),
    "float64": (
        "double",
        "%number = load double, ptr %place\n"
        "%object = call ptr @PyFloat_FromDouble(double %number)\nret ptr %object",
    ),
}
"""Type of a result in memory and the code that returns it as an object, by numba's name of it."""

_DECLARATIONS = """
declare double @PyFloat_AsDouble(ptr)
declare i64 @PyLong_AsLongLong(ptr)
declare i32 @PyObject_IsTrue(ptr)
declare ptr @PyTuple_GetItem(ptr, i64)
declare ptr @PyBool_FromLong(i64)
declare ptr @PyLong_FromLongLong(i64)
declare ptr @PyFloat_FromDouble(double)
declare void @Py_IncRef(ptr)
declare ptr @PyEval_SaveThread()
declare void @PyEval_RestoreThread(ptr)
@_Py_NoneStruct = external global i8
"""


def kind_of(argument: object) -> Kind | None:
    """Returns the type of an argument; None if an entry cannot take it apart."""
    if isinstance(argument, np.ndarray):
        flags = argument.flags
        is_plain = flags.c_contiguous and flags.writeable and argument.ndim > 0
        return (argument.dtype, argument.ndim) if is_plain else None
    if type(argument) is np.void:
        return (argument.dtype, 0)
    if type(argument) is tuple:
        kinds = tuple(kind for kind in map(kind_of, argument) if kind is not None)
        return kinds if kinds and len(kinds) == len(argument) else None
    return type(argument) if type(argument) in (bool, int, float) else None


@cache
def name_of(kind: Kind) -> str:
    """Returns a text that distinguishes the type from others, in every process."""
    return repr(kind)


@cache
def _machine() -> tuple[Any, Any]:
    """Returns LLVM's description of this processor, and a linker for it."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu, features = processor()
    target = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
        cpu=cpu, features=features, opt=3, reloc="pic", codemodel="default"
    )
    # one stretch of memory for all sections: apart by more than 2 GB, as in a process that reserves
    # much address space, they could not refer to each other, and the other linker aborts
    return target, llvm.create_lljit_compiler(target, use_jit_link=True, suppress_errors=True)


@cache
def processor() -> tuple[str, str]:
    """Returns name and features of the processor for which the code is made.

    That is level 3 of x86-64 if this processor has it, the baseline of 64-bit ARM, or else this
    processor. Code that was made on another machine of that level fits. No number depends on the
    level, because floating-point operations are never contracted or reordered.
    """
    name, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features()
    machine = llvm.get_process_triple().partition("-")[0]
    if machine == "x86_64" and all(features.get(each) for each in _LEVEL_3):
        return "x86-64-v3", ""
    return ("generic", "") if machine == "aarch64" else (name, features.flatten())


_LEVEL_3 = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "sse4.2", "popcnt")
"""Features of the third level of x86-64, as LLVM names them."""


def program(
    parts: Sequence[Any],
    symbol: str,
    kinds: Sequence[Kind],
    result: str,
    *,
    c_types: Sequence[str] = (),
    releases_lock: bool = False,
) -> bytes:
    """Links a function with all that it calls and an entry.

    Args:
        parts: LLVM modules of the function and all that it calls, not optimised.
        symbol: Name of the function there.
        kinds: Types of the arguments.
        result: numba's name of the result's type.
        c_types: If given, LLVM's types of the arguments of a C function that returns an ``int``;
            the entry is then that function. Otherwise it takes Python objects.
        releases_lock: True to release the interpreter lock in calls from Python.

    Returns:
        LLVM's bitcode, empty if there is no entry for it.
    """
    if result not in _RESULTS:
        return b""
    target, _ = _machine()
    entry = _c_entry(symbol, c_types) if c_types else _entry(symbol, kinds, result, releases_lock)
    try:
        module = llvm.parse_assembly(entry)
        module.triple, module.data_layout = target.triple, str(target.target_data)
        for part in parts:
            module.link_in(part, preserve=True)
    except RuntimeError:  # with an LLVM whose pointers have types
        return b""
    for value in (*module.functions, *module.global_variables):
        if not value.is_declaration and value.name != _ENTRY:
            value.linkage = "internal"
    return bytes(module.as_bitcode())


def object_code(bitcode: bytes) -> bytes:
    """Optimises and compiles a program, at LLVM's level 3 as numba does.

    Returns:
        The object code, empty if it cannot be used without numba's runtime.
    """
    if not bitcode:
        return b""
    target, _ = _machine()
    try:
        module = llvm.parse_bitcode(bitcode)
        options = llvm.create_pipeline_tuning_options(3)
        options.loop_vectorization, options.slp_vectorization = True, False
        builder = llvm.create_pass_builder(target, options)
        passes = builder.getModulePassManager()
        passes.add_refprune_pass()
        passes.run(module, builder)
        return bytes(target.emit_object(module))
    except (RuntimeError, AttributeError):  # the latter with an llvmlite that lacks such a pass
        return b""


def serve() -> None:
    """Compiles the programs in the files named on standard input, each into a file beside it."""
    for line in sys.stdin:
        path = Path(line.rstrip("\n"))
        made = path.with_suffix(".part")
        made.write_bytes(object_code(path.read_bytes()))
        made.replace(path.with_suffix(".o"))


def _entry(symbol: str, kinds: Sequence[Kind], result: str, releases_lock: bool) -> str:
    """Returns LLVM code that calls a function of numba with Python objects.

    The function takes places for its result and for an exception, and returns 0 without one. NULL
    as the entry's result becomes a ``SystemError``.
    """
    lines: list[str] = []
    passed = ["ptr %place", "ptr %exception"]
    for number, kind in enumerate(kinds):
        code, values = _unpacked(f"%a{number}", kind)
        lines += (
            f"%a{number}.place = getelementptr ptr, ptr %arguments, i64 {number}",
            f"%a{number} = load ptr, ptr %a{number}.place",
            *code,
        )
        passed += values
    place, give = _RESULTS[result]
    types = ", ".join(value.split()[0] for value in passed)
    body = "\n".join(lines)
    release = "%thread = call ptr @PyEval_SaveThread()" if releases_lock else ""
    regain = "call void @PyEval_RestoreThread(ptr %thread)" if releases_lock else ""
    return f"""{_DECLARATIONS}
declare i32 @"{symbol}"({types})
define ptr @{_ENTRY}(ptr %self, ptr %arguments, i64 %count) {{
%place = alloca {place}
%exception = alloca ptr
{body}
{release}
%status = call i32 @"{symbol}"({", ".join(passed)})
{regain}
%failed = icmp ne i32 %status, 0
br i1 %failed, label %fail, label %done
fail:
ret ptr null
done:
{give}
}}
"""


def _c_entry(symbol: str, c_types: Sequence[str]) -> str:
    """Returns LLVM code of a C function that calls a function of numba with 64-bit integers."""
    declared = ", ".join(f"{kind} %c{number}" for number, kind in enumerate(c_types))
    lines, passed = list[str](), ["ptr %place", "ptr %exception"]
    for number, kind in enumerate(c_types):
        wide = kind
        if kind == "i32":
            lines.append(f"%a{number} = sext i32 %c{number} to i64")
            wide = "i64"
        passed.append(f"{wide} %{'a' if kind == 'i32' else 'c'}{number}")
    types = ", ".join(value.split()[0] for value in passed)
    body = "\n".join(lines)
    return f"""declare i32 @"{symbol}"({types})
define i32 @{_ENTRY}({declared}) {{
%place = alloca i64
%exception = alloca ptr
{body}
%status = call i32 @"{symbol}"({", ".join(passed)})
%value = load i64, ptr %place
%short = trunc i64 %value to i32
ret i32 %short
}}
"""


def _unpacked(a: str, kind: Kind) -> tuple[list[str], list[str]]:
    """Returns the code that takes the object ``a`` apart, and what numba's function is passed.

    An array is passed as owner (none), parent, size, size of an item, data, shape and strides.
    """
    if kind is float:
        return [f"{a}.value = call double @PyFloat_AsDouble(ptr {a})"], [f"double {a}.value"]
    if kind is int:
        return [f"{a}.value = call i64 @PyLong_AsLongLong(ptr {a})"], [f"i64 {a}.value"]
    if isinstance(kind, type):
        lines = [f"{a}.truth = call i32 @PyObject_IsTrue(ptr {a})"]
        return [*lines, f"{a}.value = trunc i32 {a}.truth to i8"], [f"i8 {a}.value"]
    if not isinstance(kind[0], np.dtype):
        lines, values = list[str](), list[str]()
        for number, each in enumerate(kind):
            code, parts = _unpacked(f"{a}.{number}", each)
            lines += (f"{a}.{number} = call ptr @PyTuple_GetItem(ptr {a}, i64 {number})", *code)
            values += parts
        return lines, values
    dtype, axes = kind
    offset = _HEADER if axes else _HEADER + 8
    lines = [
        f"{a}.field = getelementptr i8, ptr {a}, i64 {offset}",
        f"{a}.data = load ptr, ptr {a}.field",
    ]
    if not axes:
        return lines, [f"ptr {a}.data"]
    lines += [
        f"{a}.last = getelementptr i8, ptr {a}, i64 {_HEADER + 16}",
        f"{a}.shape = load ptr, ptr {a}.last",
        f"{a}.stride{axes} = add i64 0, {dtype.itemsize}",
    ]
    for axis in reversed(range(axes)):
        lines += [
            f"{a}.place{axis} = getelementptr i64, ptr {a}.shape, i64 {axis}",
            f"{a}.length{axis} = load i64, ptr {a}.place{axis}",
            f"{a}.stride{axis} = mul i64 {a}.length{axis}, {a}.stride{axis + 1}",
        ]
    lines.append(f"{a}.size = udiv i64 {a}.stride0, {dtype.itemsize}")
    lengths = [f"i64 {a}.length{axis}" for axis in range(axes)]
    strides = [f"i64 {a}.stride{axis + 1}" for axis in range(axes)]
    start = ["ptr null", "ptr null", f"i64 {a}.size", f"i64 {dtype.itemsize}", f"ptr {a}.data"]
    return lines, [*start, *lengths, *strides]


class _Definition(ctypes.Structure):
    """``PyMethodDef``."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    )


_new_function = ctypes.PYFUNCTYPE(
    ctypes.py_object, ctypes.c_void_p, ctypes.py_object, ctypes.c_void_p
)(("PyCFunction_NewEx", ctypes.pythonapi))
"""Makes a function from a definition's address, the object that the function owns, and no module.
Python reads the definition once more when it releases the function, so the function must own it:
at the end of a process a module's list may be released before the function."""

_numbers = count()
"""Numbers of libraries, whose names must differ."""

_loaded: list[object] = []
"""Libraries, which must live as long as their functions, which is as long as the process."""


def load(code: bytes, name: str) -> Callable[..., Any]:
    """Returns a function of Python objects that runs object code.

    Raises:
        RuntimeError: As ``address_of``.
    """
    definition = _Definition(name.encode(), address_of(code, name), _FAST_CALL, None)
    address = ctypes.addressof(definition)
    function: Callable[..., Any] = _new_function(address, definition, None)
    return function


def address_of(code: bytes, name: str) -> int:
    """Returns the address of the entry of object code, which stays until the process ends.

    Raises:
        RuntimeError: It needs a symbol that neither MuJoCo nor this process has, or is no object
            file of this machine.
    """
    _, linker = _machine()
    # numba's release of an array's owner, never called: arrays from an entry have none
    unused = ctypes.cast(ctypes.pythonapi.Py_FatalError, ctypes.c_void_p).value
    builder = llvm.JITLibraryBuilder().add_object_img(code).add_current_process()
    builder.import_symbol("NRT_MemInfo_call_dtor", unused).export_symbol(_ENTRY)
    library = builder.link(linker, f"{name} {next(_numbers)}")
    _loaded.append(library)
    return int(library[_ENTRY])


def fault_of(folder: Path) -> str:
    """Returns the reason why no code may be kept in a folder; empty if it may. Makes the folder.

    Code from the folder runs as this user. No other user may therefore write there, nor exchange
    the folder or one above it.
    """
    try:
        for each in (*reversed(folder.parents), folder):
            each.mkdir(mode=0o700, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            return f"'{folder}' cannot be written"
        if sys.platform == "win32":
            return ""
        if not _is_trusted(folder.lstat(), 0o077):
            return f"'{folder}' is open to other users (chmod 700, or set NUMBA_CACHE_DIR)"
        for above in folder.parents:
            status = above.lstat()
            writers = 0o002 if status.st_gid == _own_group() else 0o022
            # a folder such as /tmp lets users exchange only what is theirs
            writers = 0 if status.st_mode & stat.S_ISVTX else writers
            if not _is_trusted(status, writers):
                return f"other users can write '{above}' (chmod go-w, or set NUMBA_CACHE_DIR)"
    except OSError as error:
        return f"'{folder}' cannot be written: {error.strerror}"
    return ""


def _is_trusted(status: os.stat_result, forbidden: int) -> bool:
    """Returns True for what belongs to this user, root or the owner of this program's sources.

    The last can run anything as this user anyway. None of the ``forbidden`` permissions is given.
    """
    owners = (0, os.getuid(), Path(__file__).stat().st_uid)
    return status.st_uid in owners and not status.st_mode & forbidden


@cache
def _own_group() -> int | None:
    """Returns the group that holds this user alone, as many systems make for each; else None."""
    with suppress(KeyError):
        user = pwd.getpwuid(os.getuid())
        group = grp.getgrgid(user.pw_gid)
        if group.gr_name == user.pw_name and set(group.gr_mem) <= {user.pw_name}:
            return group.gr_gid
    return None


def read(path: Path) -> bytes | None:
    """Returns the object code of a file; None if there is none, or it is damaged or another's."""
    try:
        with path.open("rb") as file:
            if sys.platform != "win32" and not _is_trusted(os.fstat(file.fileno()), 0o022):
                return None
            content = file.read()
    except OSError:
        return None
    digest, code = content[:32], content[32:]
    return code if hashlib.sha256(code).digest() == digest else None


def write(path: Path, code: bytes) -> None:
    """Writes object code behind its digest, as a whole or not at all."""
    with suppress(OSError), tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        try:
            file.write(hashlib.sha256(code).digest() + code)
            file.close()
            Path(file.name).replace(path)
        except BaseException:
            Path(file.name).unlink(missing_ok=True)
            raise
