"""LLVM code of a function with all that it calls, neither optimised nor emitted part by part.

numba optimises a function with its callees and emits machine code for it, and again in each of its
callers. Here, numba types and lowers each function once, and LLVM sees the program as a whole, once
(``machine_code.object_code``). No function of the program is compiled for calls from Python.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import llvmlite.binding as llvm
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target


class Part(JITCodeLibrary):  # type: ignore[misc]  # numba has no types
    """Code of one function, to which the parts that it calls are known."""

    def add_ir_module(self, ir_module: Any) -> None:
        """Adds code as it was lowered."""
        self._raise_if_finalized()
        self._final_module.link_in(llvm.parse_assembly(str(ir_module)))

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
        """Returns the part compiled as numba does: an own function of numba that it links later."""
        if self._shared_module is None:
            self._finalized = False
            super().finalize()
        return super()._get_module_for_linking()

    def modules(self) -> list[Any]:
        """Returns the code of this part and of all that it calls, each once."""
        found: dict[Any, None] = {self: None}
        left = [self]
        while left:
            part = left.pop()
            for callee in part._linking_libraries if isinstance(part, Part) else ():
                if callee not in found:
                    found[callee] = None
                    left.append(callee)
        return [
            each._final_module if isinstance(each, Part) else each._get_module_for_linking()
            for each in found
        ]


_is_open = False


def is_open() -> bool:
    """Returns True if a program is being compiled as a whole."""
    return _is_open


@contextmanager
def whole_program() -> Iterator[None]:
    """Makes numba keep every function that it compiles inside as a ``Part``."""
    global _is_open  # noqa: PLW0603
    with global_compiler_lock:
        generator = cpu_target.target_context.codegen()
        before, generator._library_class, _is_open = _is_open, Part, True
        generator.set_env = lambda *_: None  # of calls from Python alone
        try:
            yield
        finally:
            _is_open = before
            if not before:
                del generator._library_class, generator.set_env

