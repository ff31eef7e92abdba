"""Import of optional packages."""

from __future__ import annotations

import importlib
from typing import Any

from hapticbridge.errors import HapticBridgeError


def optional_module(
    module: str, purpose: str, extra: str, error: type[HapticBridgeError], package: str = ""
) -> Any:
    """Imports a module of an optional package.

    Args:
        module: Dotted name of the module.
        purpose: Feature that needs it, for the message.
        extra: The project's extra that installs it.
        error: Exception to raise.
        package: Name of the package for the user; the module's first part by default.

    Raises:
        HapticBridgeError: ``error``, with the command that installs the package.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        package = package or module.partition(".")[0]
        raise error(
            f"{purpose} needs {package}, which is not installed: "
            f"pip install 'hapticbridge[{extra}]'"
        ) from None
