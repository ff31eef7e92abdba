"""Libraries of devices' makers, which users install themselves, loaded at run time."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hapticbridge.errors import DeviceError

Signatures = Mapping[str, tuple[Any, tuple[Any, ...]]]
"""Types of result and arguments by a function's name."""


class MakerLibrary:
    """A loaded library, with every used function bound to its signature.

    Args:
        path: Its file.
        functions: Functions that are called.
        about: Name of the library and its oldest version that has them, for messages.
        optional: Functions that an older library may lack.

    Attributes:
        path: Its file.

    Raises:
        DeviceError: The library cannot be loaded, or lacks a function that is not optional.
    """

    def __init__(
        self, path: str, functions: Signatures, about: str, optional: Signatures | None = None
    ) -> None:
        try:
            library = ctypes.CDLL(path)
        except OSError as error:
            reason = " ".join(str(error).split())
            raise DeviceError(f"the library '{path}' cannot be loaded: {reason}") from None
        self.path = path
        self._functions: dict[str, Any] = {}
        optional = optional or {}
        for name, (result, arguments) in (dict(functions) | dict(optional)).items():
            try:
                function = getattr(library, name)
            except AttributeError:
                if name in optional:
                    continue
                raise DeviceError(f"'{path}' has no {name}: it is not {about}") from None
            function.restype, function.argtypes = result, arguments
            self._functions[name] = function

    def __contains__(self, name: str) -> bool:
        """Returns True if a function was bound."""
        return name in self._functions

    def __getitem__(self, name: str) -> Any:
        """Returns a function that was bound."""
        return self._functions[name]


@dataclass(frozen=True, slots=True)
class LibraryFiles:
    """Places where a maker's library may be.

    Attributes:
        variable: Environment variable with its file, used without the option ``library``.
        stems: Names for the linker, without prefix and ending.
        names: File names by ``sys.platform``.
        missing: Sentence if it is in none of them, which names its source; the option follows.
    """

    variable: str
    stems: tuple[str, ...]
    names: Mapping[str, tuple[str, ...]]
    missing: str

    def located(self, library: object = None) -> str:
        """Returns the library's file.

        Args:
            library: File named by the user; None selects the environment variable, else the usual
                names.

        Raises:
            DeviceError: The library was not found.
        """
        named = str(library or os.environ.get(self.variable, ""))
        if named:
            # the loader looks for a name without a folder in its own places alone
            return str(Path(named).absolute()) if os.access(named, os.F_OK) else named
        for stem in self.stems:
            if (found := ctypes.util.find_library(stem)) is not None:
                return found
        for name in self.names.get(sys.platform, ()):
            try:
                ctypes.CDLL(name)
            except OSError as error:
                # Linux names the file that is missing: this one, or one that it needs
                if sys.platform != "linux" or str(error).startswith(f"{name}: "):
                    continue
            return name
        raise DeviceError(f"{self.missing} and name its file with library=FILE or {self.variable}")
