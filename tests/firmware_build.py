"""The firmware of home-made devices, compiled here as a library."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

from hapticbridge.device.rawhid import device as driver

FIRMWARE = Path(driver.__file__).with_name("firmware")
SHIM = Path(__file__).with_name("rawhid_firmware_shim.cpp")
LIBRARY = "firmware.so"
COMPILER = shutil.which("g++") or shutil.which("clang++")


def built(folder: Path, *options: str) -> ctypes.CDLL:
    """Returns the protocol or, with ``-DSKETCH``, a whole sketch."""
    library = folder / LIBRARY
    subprocess.run(
        [str(COMPILER), "-std=c++11", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC",
         f"-I{FIRMWARE}", f"-I{folder}", *options, "-o", str(library),
         str(SHIM), str(FIRMWARE / "hb_protocol.cpp")],
        check=True,
    )  # fmt: skip
    return ctypes.CDLL(str(library))
