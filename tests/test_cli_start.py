"""The first seconds of a command, in which everything is imported."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from hapticbridge.signals import leaving_on_interrupt

COMMAND = [sys.executable, "-m", "hapticbridge", "scenes"]

INTERRUPTED = """
import builtins, os, signal, sys

from hapticbridge.cli import main

usual = builtins.__import__


def interrupting(name, *rest):
    if name == "mujoco":
        os.kill(os.getpid(), signal.SIGINT)
    return usual(name, *rest)


builtins.__import__ = interrupting
sys.exit(main(["scenes"]))
"""
"""Ctrl-C in the middle of the imports."""


@pytest.mark.parametrize("value", ["nonsense", "[red]\n"])
def test_a_renderer_that_mujoco_does_not_know_is_one_sentence(value: str) -> None:
    environment = os.environ | {"MUJOCO_GL": value}
    done = subprocess.run(COMMAND, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: the environment variable MUJOCO_GL is {value!r}")
    assert "'disable'" in line


def test_ctrl_c_while_it_imports_is_silence_and_exit_code_130() -> None:
    command = [sys.executable, "-c", INTERRUPTED]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_whoever_has_set_sigint_to_something_else_keeps_it() -> None:
    def kept(_number: int, _frame: object) -> None: ...

    before = signal.signal(signal.SIGINT, kept)
    try:
        with leaving_on_interrupt(130):
            assert signal.getsignal(signal.SIGINT) is kept
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with leaving_on_interrupt(130):
            assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
