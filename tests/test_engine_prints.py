"""What engines print: it is caught below Python, told once, and stdout is itself again."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import pytest

from hapticbridge.lab.engines.base import caught_prints

BUFFER = ctypes.create_string_buffer(4096)
"""C's stdout keeps it as long as the process lives."""


def test_prints_of_c_are_told_once_and_kept_from_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    libc = ctypes.CDLL(None)
    # as where stdout is a pipe: C writes when its memory is full (_IOFBF), or when it is told to
    libc.setvbuf(ctypes.c_void_p.in_dll(libc, "stdout"), BUFFER, 0, len(BUFFER))
    with caught_prints(told.append):
        ctypes.CDLL(None).puts(b"switched solver")
        ctypes.CDLL(None).puts(b"switched solver")
        os.write(1, b"\xff raw\n\n")
    ctypes.CDLL(None).puts(b"after")
    ctypes.CDLL(None).fflush(None)
    assert sorted(told) == ["switched solver", "\ufffd raw"]
    assert capfd.readouterr().out == "after\n"


def test_stdout_is_itself_again_after_an_error_and_what_was_printed_is_told(
    capfd: pytest.CaptureFixture[str],
) -> None:
    told: list[str] = []
    descriptors = len(list(Path("/dev/fd").iterdir()))
    with pytest.raises(ZeroDivisionError), caught_prints(told.append):
        os.write(1, b"last words\n")
        raise ZeroDivisionError
    os.write(1, b"after\n")
    assert told == ["last words"]
    assert capfd.readouterr().out == "after\n"
    assert len(list(Path("/dev/fd").iterdir())) == descriptors
