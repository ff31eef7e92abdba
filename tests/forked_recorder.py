"""A recorder's process that is a fork of the tests' one: it imports nothing again.

All that it does is the same but its start, which takes 10 ms of processor time instead of 250. The
process as users have it is that of tests that run commands in processes of their own, and of
``test_recording_recorder``, ``test_realtime``, ``test_cli_run`` and ``test_bridge_killed``.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import subprocess
import sys
import time
from os import fork  # which a test may take away from the bridge
from typing import NoReturn

from hapticbridge.recording import recorder_process


class ForkedRecorder:
    """The part of ``subprocess.Popen`` that the bridge's end uses."""

    def __init__(self) -> None:
        below, given = os.pipe()
        answered, above = os.pipe()
        self.returncode: int | None = None
        self.pid = fork()
        if self.pid == 0:
            _record(below, above)
        os.close(below)
        os.close(above)
        self.stdin = os.fdopen(given, "wb", buffering=0)
        self.stdout = os.fdopen(answered, "rb", buffering=0)

    def poll(self) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float) -> int:
        until = time.monotonic() + timeout
        while (status := self.poll()) is None:
            if time.monotonic() > until:
                raise subprocess.TimeoutExpired("recorder", timeout)
            time.sleep(1e-4)
        return status

    def kill(self) -> None:
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)


def _record(below: int, above: int) -> NoReturn:
    try:
        gc.disable()
        faulthandler.disable()
        os.setsid()
        os.dup2(below, 0)
        os.dup2(above, 1)
        os.closerange(3, 1 << 20)
        sys.stdin, sys.stdout, sys.stderr = (
            os.fdopen(number, mode, closefd=False) for number, mode in enumerate("rww")
        )
        recorder_process.run()
    finally:
        os._exit(1)
