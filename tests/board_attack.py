"""The firmware's loop compiled here, and hands that try to gain energy from it."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from firmware_build import COMPILER, FIRMWARE

FLAGS = ("-std=c++11", "-Wall", "-Wextra", "-Werror", "-O2", "-ffp-contract=off", f"-I{FIRMWARE}")
"""Without contracted operations the numbers are the same on every processor."""

TICKS = 10_000
"""Periods of a run."""


def built_loop(folder: Path) -> ctypes.CDLL:
    """Compiles ``board_loop_shim.cpp`` into a folder."""
    target = folder / "loop.so"
    sources = [Path(__file__).with_name("board_loop_shim.cpp"), FIRMWARE / "hb_protocol.cpp"]
    command = [str(COMPILER), *FLAGS, "-shared", "-fPIC", *map(str, sources), "-o", str(target)]
    subprocess.run(command, check=True)
    library = ctypes.CDLL(str(target))
    library.board_new.restype = ctypes.c_void_p
    library.loop_new.restype = ctypes.c_void_p
    library.loop_new.argtypes = [ctypes.c_float, ctypes.c_int]
    library.attack.restype = ctypes.c_double
    return library


def floats(values: Any) -> Any:
    """Returns numbers as an argument of the library, in single precision."""
    return np.asarray(values, np.float32).ctypes.data_as(ctypes.POINTER(ctypes.c_float))


def gained(
    library: ctypes.CDLL, seed: int, *, turns: bool = False, stays: bool = False, **changes: float
) -> float:
    """Returns the most energy in J that a hand gets beyond the credit and the encoder's blur.

    The hand may choose every motion, the host shows anything, late, out of order or not at all, and
    either restarts. ``turns`` is true for a loop that renders rotation too, ``stays`` for one of
    rotations alone. ``changes`` replace the encoder's ``step`` in m, the device's ``damping_share``
    of what it needs, and ``trust``, 1 for a tool that is shown where nobody has paid for it.
    """
    rng = np.random.default_rng(seed)
    period, b, share = 10 ** rng.uniform(-4.3, -3.0), rng.uniform(0.5, 5.0), rng.uniform(0.2, 1.0)
    stiffness, level = share * 2.0 * b / period, 10 ** rng.uniform(0.0, 1.2)
    credit, step = 10 ** rng.uniform(-3.0, -1.0), rng.choice([0.0, 0.0, 1e-5, 5e-5])
    if stays:
        level, step, credit = 0.0, 0.0, 1e-2 * credit
    chosen = {"step": step, "damping_share": 1.0, "trust": 0.0} | changes
    b_r, k_r = 10 ** rng.uniform(-4.0, -2.0), rng.uniform(0.2, 1.0) * 2.0 / period
    turn = k_r * b_r, b_r - 0.5 * k_r * b_r * period, 10 ** rng.uniform(-1.5, 0.5)
    numbers = (period, stiffness, b - 0.5 * stiffness * period, level, credit)
    numbers = (*numbers, *chosen.values(), *turn)
    values = (ctypes.c_double * len(numbers))(*numbers)
    own = ctypes.c_uint(seed), values, ctypes.c_int(turns), ctypes.c_long(TICKS)
    return float(library.attack(*own)) - credit
