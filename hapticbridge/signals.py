"""Signals as a wish to stop while a loop runs, or held back for a moment."""

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
"""What ends a run. Ctrl-Z (SIGTSTP) among them: a process that is suspended leaves the force on; so
does one that Ctrl-\\ (SIGQUIT) or a limit on its processor time (SIGXCPU) ends at once."""


@contextmanager
def stopping_on_signals(stop: Callable[[str], None]) -> Iterator[None]:
    """Calls ``stop`` with the signal's name; only the main thread may, others run as they are.

    A signal that is ignored stays so: ``nohup`` sees to that for SIGHUP. One that a library handles
    in C stays with it: Python could not give it back.

    A ``KeyboardInterrupt`` in the middle of a tick could fall between a computed wrench and its
    being sent; a wish that is looked at once a tick cannot.
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
    """Lets every signal that ends a run end a program as Ctrl-C does, with all that is then closed.

    Yields a list, at first empty: once somebody stands in it who takes a signal's name, the last
    one is told instead, and nothing is interrupted any more.
    """
    told: list[Callable[[str], None]] = []

    def heed(name: str) -> None:
        if not told:
            raise KeyboardInterrupt
        told[-1](name)

    with stopping_on_signals(heed):
        yield told


@contextmanager
def holding_interrupts() -> Iterator[None]:
    """Holds Ctrl-C back from the main thread, and from processes that this thread starts meanwhile.

    It arrives at the end. A process begins with what its parent's thread holds back, so an
    interrupt cannot end it in the middle of its imports, with a traceback; it has to unblock SIGINT
    itself. In the parent that is not enough, because any other thread may take the signal and hand
    it to the main one: there, a handler notes it.
    """
    noted: list[int] = []
    before = signal.getsignal(signal.SIGINT)  # None if it is not Python's
    is_ours = before is not None and threading.current_thread() is threading.main_thread()
    if is_ours:
        signal.signal(signal.SIGINT, lambda number, _frame: noted.append(number))
    has_masks = hasattr(signal, "pthread_sigmask")  # all but Windows
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
    """Ends the process at once on Ctrl-C, without a message, where there is nothing to lose.

    For imports: there a ``KeyboardInterrupt`` is lost in callbacks of the importer, which print it,
    or becomes another error in a library's C code. A handler other than Python's own is kept.

    Args:
        code: The exit code.
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
