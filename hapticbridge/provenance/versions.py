"""Software versions and processor of a run."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import version


def versions() -> dict[str, str]:
    """Returns the versions on which a bit-exact repetition depends."""
    packages = ("hapticbridge", "mujoco", "numba", "numpy", "scipy", "mcap")
    found = {name: _version_of(name) for name in packages}
    return found | {"python": platform.python_version()}


_version_of = cache(version)  # parses the package's metadata: 2 ms each


def processor() -> str:
    """Returns the processor's model, or its architecture if the system does not report it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:  # noqa: PTH123 - not a file to keep
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
