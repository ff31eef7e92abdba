"""Machine code of compiled functions, kept on disk and called without numba.

Importing numba and its registries takes longer than all else in the start of a run. A file here
holds one function as an object file of LLVM, with an entry for CPython's vectorcall convention, so
that llvmlite alone can load it. The code is numba's own: the entry only unpacks the arguments.

A function can be kept if it needs only MuJoCo, the C library and CPython. Code that may allocate or
raise needs numba's runtime; the linker then refuses it, and the caller uses numba.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np

_ENTRY = "hapticbridge_entry"
_OBJECT = object.__basicsize__
"""Size in bytes of what every Python object begins with. An array continues with the address of
its data, the number of axes in a word of 8 bytes, and the address of its shape; a record with a
word of 8 bytes and the address of its data. Both are in NumPy's public headers."""

_FAST_CALL = 0x80
"""Flag ``METH_FASTCALL``: the function takes an array of arguments and their count."""

_RESULTS = {
    "none": ("ptr", ""),
    "bool": ("i8", "%wide = zext i8 %value to i64\n%result = call ptr @PyBool_FromLong(i64 %wide)"),
    "int64": ("i64", "%result = call ptr @PyLong_FromLongLong(i64 %value)"),
    "float64": ("double", "%result = call ptr @PyFloat_FromDouble(double %value)"),
}
"""Type in memory of a result, and its way into a Python object, by numba's name of the type."""


def kind_of(argument: object) -> str:
    """Returns the type of an argument as text, empty if an entry cannot unpack it."""
    if isinstance(argument, np.ndarray):
        flags = argument.flags
        is_plain = flags.c_contiguous and flags.writeable and argument.ndim > 0
        return f"{argument.dtype.str}:{argument.ndim}:{argument.itemsize}" if is_plain else ""
    if type(argument) is np.void:
        return f"{argument.dtype.str}:record"
    kinds = {bool: "bool", int: "int", float: "float"}
    return kinds.get(type(argument), "")


@cache
def machine() -> tuple[Any, str]:
    """Returns LLVM's description of this processor, and a text that distinguishes it."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    triple = llvm.get_process_triple()
    target = llvm.Target.from_triple(triple).create_target_machine(
        cpu=name, features=features, opt=3, reloc="pic", codemodel="default"
    )
    return target, f"{triple} {name} {features} {llvm.llvm_version_info}"


def object_code(ir: str, symbol: str, kinds: Sequence[str], result: str) -> bytes:
    """Compiles a function's optimised code together with an entry.

    Args:
        ir: LLVM code of the function and all that it calls, as numba prints it.
        symbol: The function's name there.
        kinds: Types of the arguments (``kind_of``).
        result: numba's name of the result's type.

    Raises:
        RuntimeError: LLVM does not accept the code.
        KeyError: An entry cannot return such a result.
    """
    target, _ = machine()
    module = llvm.parse_assembly(ir)
    module.link_in(llvm.parse_assembly(_entry(symbol, kinds, result)))
    for value in (*module.functions, *module.global_variables):
        if not value.is_declaration and value.name != _ENTRY:
            value.linkage = "internal"
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options()))
    return bytes(target.emit_object(module))


def _entry(symbol: str, kinds: Sequence[str], result: str) -> str:
    """Returns LLVM code that unpacks Python objects and calls a function of numba.

    numba's function takes the addresses of result and exception and returns 0 without an exception.
    An array comes as owner (none here), parent, size, size of an item, data, shape and strides.
    """
    body: list[str] = []
    types: list[str] = ["ptr", "ptr"]
    values: list[str] = ["%place", "%exception"]

    def pass_on(kind: str, value: str) -> None:
        types.append(kind)
        values.append(value)

    for number, kind in enumerate(kinds):
        a = f"%a{number}"
        body += [
            f"{a}.slot = getelementptr ptr, ptr %arguments, i64 {number}",
            f"{a} = load ptr, ptr {a}.slot",
        ]
        if kind == "float":
            body.append(f"{a}.value = call double @PyFloat_AsDouble(ptr {a})")
            pass_on("double", f"{a}.value")
        elif kind in ("int", "bool"):
            body.append(f"{a}.value = call i64 @PyLong_AsLongLong(ptr {a})")
            if kind == "bool":
                body.append(f"{a}.byte = trunc i64 {a}.value to i8")
            pass_on(*(("i8", f"{a}.byte") if kind == "bool" else ("i64", f"{a}.value")))
        elif kind.endswith(":record"):
            body += [
                f"{a}.fields = getelementptr i8, ptr {a}, i64 {_OBJECT + 8}",
                f"{a}.data = load ptr, ptr {a}.fields",
            ]
            pass_on("ptr", f"{a}.data")
        else:
            _, axes, size = kind.rsplit(":", 2)
            lengths = [f"{a}.length{axis}" for axis in range(int(axes))]
            body += [
                f"{a}.fields = getelementptr i8, ptr {a}, i64 {_OBJECT}",
                f"{a}.data = load ptr, ptr {a}.fields",
                f"{a}.place = getelementptr i8, ptr {a}, i64 {_OBJECT + 16}",
                f"{a}.shape = load ptr, ptr {a}.place",
            ]
            strides, total = [size], size
            for axis, length in enumerate(lengths):
                body += [
                    f"{length}.place = getelementptr i64, ptr {a}.shape, i64 {axis}",
                    f"{length} = load i64, ptr {length}.place",
                ]
            for length in reversed(lengths):
                body.append(f"{length}.stride = mul i64 {length}, {total}")
                total = f"{length}.stride"
                strides.append(total)
            body.append(f"{a}.size = udiv i64 {total}, {size}")
            pass_on("ptr", "null")
            pass_on("ptr", "null")
            pass_on("i64", f"{a}.size")
            pass_on("i64", size)
            pass_on("ptr", f"{a}.data")
            for value in (*lengths, *reversed(strides[:-1])):
                pass_on("i64", value)
    kind, convert = _RESULTS[result]
    declared = ", ".join(types)
    passed = ", ".join(f"{kind} {value}" for kind, value in zip(types, values, strict=True))
    lines = "\n".join(body)
    give = (
        f"%value = load {kind}, ptr %place\n{convert}\nret ptr %result"
        if convert
        else ("call void @Py_IncRef(ptr @_Py_NoneStruct)\nret ptr @_Py_NoneStruct")
    )
    return f"""
declare i32 @"{symbol}"({declared})
declare double @PyFloat_AsDouble(ptr)
declare i64 @PyLong_AsLongLong(ptr)
declare ptr @PyBool_FromLong(i64)
declare ptr @PyLong_FromLongLong(i64)
declare ptr @PyFloat_FromDouble(double)
declare void @Py_IncRef(ptr)
@_Py_NoneStruct = external global i8
define ptr @{_ENTRY}(ptr %self, ptr %arguments, i64 %count) {{
%place = alloca {kind}
%exception = alloca ptr
{lines}
%status = call i32 @"{symbol}"({passed})
%failed = icmp ne i32 %status, 0
br i1 %failed, label %fail, label %done
fail:
ret ptr null
done:
{give}
}}
"""


class _Definition(ctypes.Structure):
    """``PyMethodDef``."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    )


_loaded: list[object] = []
"""All that must live as long as the functions, which is as long as the process."""


def load(code: bytes, name: str) -> Callable[..., Any]:
    """Returns a Python function that runs object code.

    Raises:
        RuntimeError: It needs a symbol that neither MuJoCo nor this process has, or is no object
            file of this machine.
    """
    target, _ = machine()
    linker = llvm.create_lljit_compiler(target)
    # numba's release of an array's owner; arrays that come through the entry have none
    unused = ctypes.cast(ctypes.pythonapi.Py_FatalError, ctypes.c_void_p).value
    builder = llvm.JITLibraryBuilder().add_object_img(code).add_current_process()
    builder.import_symbol("NRT_MemInfo_call_dtor", unused).export_symbol(_ENTRY)
    library = builder.link(linker, name)
    definition = _Definition(name.encode(), library[_ENTRY], _FAST_CALL, None)
    _loaded.extend((linker, library, definition))
    create = ctypes.pythonapi.PyCFunction_NewEx
    create.restype = ctypes.py_object
    create.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)
    function: Callable[..., Any] = create(ctypes.addressof(definition), None, None)
    return function


def read(path: Path) -> bytes | None:
    """Returns the object code of a file; None if there is none, or it is damaged or another's."""
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            if hasattr(os, "getuid") and (
                status.st_uid not in (0, os.getuid()) or status.st_mode & 0o022
            ):
                return None
            content = file.read()
    except OSError:
        return None
    digest, code = content[:32], content[32:]
    return code if hashlib.sha256(code).digest() == digest else None


def write(path: Path, code: bytes) -> None:
    """Writes object code behind its digest, as a whole or not at all."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            try:
                file.write(hashlib.sha256(code).digest() + code)
                file.close()
                Path(file.name).replace(path)
            except BaseException:
                Path(file.name).unlink(missing_ok=True)
                raise
