"""Keeps what an engine's C code prints away from the results on stdout."""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import BinaryIO

_STDOUT = 1
"""File descriptor that C code prints to, whatever Python's ``sys.stdout`` is."""


@contextmanager
def caught_prints(told: Callable[[str], None]) -> Iterator[None]:
    """Catches everything that is printed on stdout inside, from C too, and tells it afterwards.

    PyBullet prints two lines whenever a world is opened; between braces of JSON they would be the
    end of it. Each line is told once, however often it was printed.

    Args:
        told: Called with each different line, in the order of their first appearance.
    """
    try:
        kept = os.dup(_STDOUT)
    except OSError:  # a process without stdout has none to keep clean
        yield
        return
    with tempfile.TemporaryFile() as file:
        try:
            _flush()
            os.dup2(file.fileno(), _STDOUT)
            try:
                yield
            finally:
                # C keeps lines in memory where stdout is no terminal; they belong to this file
                _flush()
                os.dup2(kept, _STDOUT)
        finally:
            os.close(kept)
            for line in _lines(file):
                told(line)


def _flush() -> None:
    if sys.stdout is not None:
        sys.stdout.flush()
    ctypes.CDLL(None).fflush(None)


def _lines(file: BinaryIO) -> list[str]:
    file.seek(0)
    lines = file.read().decode("utf-8", "replace").splitlines()
    return list(dict.fromkeys(line.strip() for line in lines if line.strip()))
