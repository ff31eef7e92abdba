"""LLVM code of a function with all that it calls, neither optimised nor emitted part by part.

numba optimises a function with its callees and emits machine code for it, and again in each of its
callers. Here, numba types and lowers each function once, and LLVM sees the program as a whole, once
(``machine_code.object_code``). No function of the program is compiled for calls from Python.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any
from unittest.mock import patch

import llvmlite.binding as llvm
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target
from numba.core.types import Record


class Part(JITCodeLibrary):  # type: ignore[misc]  # numba has no types
    """Code of one function, to which the parts that it calls are known."""

    def __init__(self, codegen: Any, name: str) -> None:
        CodeLibrary.__init__(self, codegen, name)
        self._linking_libraries: list[Any] = []
        self._shared_module: Any = None
        self._modules: list[Any] = []

    def add_ir_module(self, ir_module: Any) -> None:
        """Adds code as it was lowered."""
        self._modules.append(llvm.parse_assembly(str(ir_module)))

    def add_linking_library(self, library: Any) -> None:
        """Notes a part that this one calls."""
        self._linking_libraries.append(library)

    def finalize(self) -> None:
        """Ends the lowering."""
        self._finalized = True

    def get_pointer_to_function(self, _name: str) -> int:
        """Returns null, which numba keeps for a function that Python cannot call."""
        return 0

    def _get_module_for_linking(self) -> Any:
        """Returns the part compiled as numba does, for a program that is not compiled as a whole.

        The part is then a function of numba's own; those of ``jit`` are compiled for either use.
        """
        if self._shared_module is None:
            own = JITCodeLibrary(self._codegen, self.name)
            for module in self._modules:
                own.add_llvm_module(module.clone())
            for library in self._linking_libraries:
                own.add_linking_library(library)
            own.finalize()
            self._own, self._shared_module = own, own._get_module_for_linking()
        return self._shared_module

    def modules(self) -> list[Any]:
        """Returns the code of this part and of all that it calls, each once."""
        reached: dict[Any, None] = {self: None}
        left: list[Any] = [self]
        while left:
            for callee in getattr(left.pop(), "_linking_libraries", ()):
                if callee not in reached:
                    reached[callee] = None
                    if isinstance(callee, Part):
                        left.append(callee)
        whole: list[Any] = []
        for each in reached:
            whole += each._modules if isinstance(each, Part) else [each._get_module_for_linking()]
        return whole


_is_open = False


def is_open() -> bool:
    """Returns True if a program is being compiled as a whole."""
    return _is_open


@contextmanager
def whole_program() -> Iterator[None]:
    """Makes numba keep every function that it compiles inside as a ``Part``.

    Inside, two things are not done again for every variable and every pass: an LLVM module for
    the size of a type, and the text of a record's type, which is 44 kB for the state of a tick.
    """
    global _is_open  # noqa: PLW0603
    with global_compiler_lock, ExitStack() as stack:
        if _is_open:
            yield
            return
        context = cpu_target.target_context
        generator = context.codegen()
        for owner, name, value in (
            (generator, "_library_class", Part),
            (generator, "set_env", lambda *_: None),  # of calls from Python
            (context, "get_abi_sizeof", cache(context.get_abi_sizeof)),
            (Record, "__repr__", Record.__str__),
        ):
            stack.enter_context(patch.object(owner, name, value))
        _is_open = True
        try:
            yield
        finally:
            _is_open = False
