"""The firmware's loop on emulated processors of boards: its bits, its size and its instructions."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

from board_attack import FLAGS
from firmware_build import COMPILER, FIRMWARE

HERE = Path(__file__).parent

MOST = {"lines": 2500, "poses": 10_500}
"""Instructions of a period with three axes and with six, of the 15 000 that 10 kHz leaves at
150 MHz."""

TOOLS = ("arm-none-eabi-g++", "arm-none-eabi-size", "qemu-system-arm")
PACKAGES = (
    "gcc-arm-none-eabi",
    "libnewlib-arm-none-eabi",
    "libstdc++-arm-none-eabi-newlib",
    "qemu-system-arm",
)
"""Debian's packages of the tools."""


class Core(NamedTuple):
    """A processor with a single-precision unit at least, and QEMU's board that has it."""

    fpu: str
    board: str
    code: str
    data: str


CORES = {
    "cortex-m7": Core("fpv5-d16", "mps2-an500", "0", "0x20000000"),
    "cortex-m33": Core("fpv5-sp-d16", "mps2-an505", "0x10000000", "0x38000000"),
}


def missing() -> str:
    """Returns a sentence on the tools that are not installed; empty if all are."""
    absent = [tool for tool in TOOLS if shutil.which(tool) is None]
    if COMPILER is None:
        absent.insert(0, "g++")
    if not absent:
        return ""
    packages = " ".join(["g++", *PACKAGES] if COMPILER is None else PACKAGES)
    return f"{', '.join(absent)} not found; on Debian: apt install {packages}"


def _printed(*command: str | Path) -> str:
    done = subprocess.run(
        [str(word) for word in command], check=True, capture_output=True, text=True, timeout=300.0
    )
    return done.stdout + done.stderr


def _counts(text: str) -> dict[str, int]:
    return {name: int(value) for name, value in re.findall(r"^(.+) (\d+)$", text, re.MULTILINE)}


def computed_here(folder: Path) -> dict[str, int]:
    """Returns what ``board_loop_program.cpp`` computes on this machine."""
    target = folder / "native"
    _printed(str(COMPILER), *FLAGS, HERE / "board_loop_program.cpp", "-o", target)
    return _counts(_printed(target))


def _cross_compiled(core: str, folder: Path, *sources: Path | str) -> Path:
    own, target = CORES[core], folder / f"{Path(sources[0]).stem}-{core}"
    _printed(
        "arm-none-eabi-g++", *FLAGS, "-fno-exceptions", "-fno-rtti", "-fno-threadsafe-statics",
        "-ffunction-sections", "-nostartfiles", "-Wl,--gc-sections,-e,start", f"-mcpu={core}",
        "-mthumb", "-mfloat-abi=hard", f"-mfpu={own.fpu}", "-T", HERE / "board_loop.ld",
        f"-Wl,--defsym=CODE={own.code}", f"-Wl,--defsym=DATA={own.data}", *sources, "-o", target,
    )  # fmt: skip
    return target


def computed_on(core: str, folder: Path) -> dict[str, int]:
    """Returns what ``board_loop_program.cpp`` computes on a core, and its instructions."""
    program = _cross_compiled(core, folder, HERE / "board_loop_program.cpp")
    return _counts(
        _printed(
            "qemu-system-arm", "-M", CORES[core].board, "-icount", "shift=0", "-nographic",
            "-semihosting-config", "enable=on,target=native", "-kernel", program,
        )
    )  # fmt: skip


def memory_on(core: str, folder: Path, loop: str) -> tuple[int, int]:
    """Returns the bytes of flash and of memory, the stack apart, that a board's firmware takes.

    It is what the headers and ``hb_protocol.cpp`` add to the core of an Arduino. ``loop`` is one of
    ``MOST``.
    """
    define = "-DHB_SKETCH_POSE" if loop == "poses" else "-DHB_SKETCH_LINES"
    sources = HERE / "board_firmware.cpp", FIRMWARE / "hb_protocol.cpp", define
    text, data, bss = (
        _printed("arm-none-eabi-size", _cross_compiled(core, folder, *sources))
        .splitlines()[1]
        .split()[:3]
    )
    return int(text) + int(data), int(data) + int(bss)
