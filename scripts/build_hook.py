"""Machine code in a wheel: what the first run would compile, made while the wheel is built.

It needs the packages of a run, so build with ``pip wheel --no-build-isolation --no-deps .`` in an
environment that ``scripts/setup`` has made. Without them the wheel has no machine code, and the
first run compiles. The code is used where the versions of numba, llvmlite, MuJoCo, NumPy and Python
and the level of the processor are those of the build; anywhere else, the first run compiles.
"""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class MachineCode(BuildHookInterface):  # type: ignore[misc]  # no types in an environment without it
    """Adds the folder ``ready_made`` to a wheel."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compiles into a folder of its own, and names its files to the builder."""
        needed = ("numba", "mujoco", "scipy", "mcap", "platformdirs")
        if version != "standard" or sys.platform != "linux" or not all(map(find_spec, needed)):
            return
        self._folder = TemporaryDirectory()
        environment = os.environ | {"NUMBA_CACHE_DIR": self._folder.name, "PYTHONPATH": self.root}
        command = [sys.executable, "-m", "hapticbridge.run.programs"]
        subprocess.run(command, check=True, env=environment, cwd=self._folder.name)
        for path in Path(self._folder.name, "machine_code").glob("*.o"):
            path.chmod(0o644)
            build_data["force_include"][str(path)] = f"hapticbridge/ready_made/{path.name}"
        build_data["pure_python"], build_data["infer_tag"] = False, True

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes the folder."""
        del version, build_data, artifact_path
        if hasattr(self, "_folder"):
            self._folder.cleanup()
