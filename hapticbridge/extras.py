"""Import of optional packages."""

from __future__ import annotations

import importlib
from typing import Any

from hapticbridge.errors import HapticBridgeError


def optional_module(
    module: str, purpose: str, extra: str, error: type[HapticBridgeError], package: str = ""
) -> Any:
    """Imports a module of an optional package.

    ``extra`` is the project's extra that installs it. ``purpose`` and ``package`` name the feature
    and the package in the message; ``package`` defaults to the module's first part.

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
