"""Packages that only some of the work needs: who wants it installs one of the project's extras."""

from __future__ import annotations

import importlib
from typing import Any

from hapticbridge.errors import HapticBridgeError


def optional_module(
    module: str, purpose: str, extra: str, error: type[HapticBridgeError], package: str = ""
) -> Any:
    """Returns a module of a package that may not be there.

    Args:
        module: What is imported, with dots.
        purpose: What needs it, for the message.
        extra: Which of the project's extras brings it.
        error: What is raised.
        package: What the user knows it as; the module's first part by default.

    Raises:
        HapticBridgeError: An ``error`` that says what to install.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        package = package or module.partition(".")[0]
        raise error(
            f"{purpose} needs {package}, which is not installed: "
            f"pip install 'hapticbridge[{extra}]'"
        ) from None
