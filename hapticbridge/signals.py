"""Signals as requests to stop a run, or deferred for a moment."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

STOP_SIGNALS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGTSTP", "SIGQUIT", "SIGXCPU")
    if hasattr(signal, name)
)
"""Signals that end a run. Ctrl-Z (SIGTSTP) is among them, because a suspended process leaves the
force on. So does a process killed by Ctrl-\\ (SIGQUIT) or by a limit on its processor time
(SIGXCPU)."""


@contextmanager
def stopping_on_signals(stop: Callable[[str], None]) -> Iterator[None]:
    """Calls ``stop`` with the name of each stop signal, in the main thread only.

    Ignored signals stay ignored, such as SIGHUP under ``nohup``. A signal handled by a library in C
    stays with it, because Python could not restore its handler. A ``KeyboardInterrupt`` during a
    tick could fall between the computation of a wrench and its sending; a request that is checked
    once per tick cannot.
    """

    def handle(number: int, _frame: FrameType | None) -> None:
        stop(signal.Signals(number).name)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    others = (signal.SIG_IGN, None)
    heeded = [number for number in STOP_SIGNALS if signal.getsignal(number) not in others]
    previous = {number: signal.signal(number, handle) for number in heeded}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def interrupting_on_signals() -> Iterator[list[Callable[[str], None]]]:
    """Makes every stop signal act like Ctrl-C, so that all resources are closed.

    Yields a list of callbacks. While it is empty a signal raises KeyboardInterrupt; otherwise the
    last callback receives the signal's name.
    """
    callbacks: list[Callable[[str], None]] = []

    def heed(name: str) -> None:
        if not callbacks:
            raise KeyboardInterrupt
        callbacks[-1](name)

    with stopping_on_signals(heed):
        yield callbacks


@contextmanager
def holding_interrupts() -> Iterator[None]:
    """Defers Ctrl-C for the main thread, and for processes that this thread starts meanwhile.

    The signal arrives at the end. A child process inherits the signals that its parent's thread
    blocks, so an interrupt cannot end it with a traceback during its imports; it must unblock
    SIGINT itself. In the parent, any other thread may take the signal and pass it to the main one,
    so a handler notes it.
    """
    noted: list[int] = []
    before = signal.getsignal(signal.SIGINT)  # None for a handler that is not Python's
    is_ours = before is not None and threading.current_thread() is threading.main_thread()
    if is_ours:
        signal.signal(signal.SIGINT, lambda number, _frame: noted.append(number))
    has_masks = hasattr(signal, "pthread_sigmask")  # every system but Windows
    if has_masks:
        held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if has_masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, held)
        if is_ours:
            signal.signal(signal.SIGINT, before)
        if noted:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def leaving_on_interrupt(code: int) -> Iterator[None]:
    """Ends the process at once on Ctrl-C, without a message, while there is nothing to lose.

    It is for imports. There a ``KeyboardInterrupt`` is lost in callbacks of the importer, which
    print it, or becomes another error in a library's C code. A handler other than Python's own is
    kept.
    """
    is_usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not is_usual or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, lambda _number, _frame: os._exit(code))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
