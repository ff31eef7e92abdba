"""Signals as requests to stop a run, or deferred for a moment."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOP_SIGNALS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGTSTP", "SIGQUIT", "SIGXCPU")
    if hasattr(signal, name)
)
"""Signals that end a run. Ctrl-Z (SIGTSTP) is among them, because a suspended process leaves the
force on. So does a process killed by Ctrl-\\ (SIGQUIT) or by a limit on its processor time
(SIGXCPU)."""


@contextmanager
def stopping_on_signals(
    stop: Callable[[str], None], numbers: Sequence[int] = STOP_SIGNALS
) -> Iterator[None]:
    """Calls ``stop`` with the name of each of these signals, in the main thread only.

    Ignored signals stay ignored, such as SIGHUP under ``nohup``. A signal handled by a library in C
    stays with it, because Python could not restore its handler. A ``KeyboardInterrupt`` during a
    tick could fall between the computation of a wrench and its sending; a request that is checked
    once per tick cannot.
    """

    def handle(number: int, _frame: FrameType | None) -> None:
        stop(signal.Signals(number).name)

    others = (signal.SIG_IGN, None)
    with _handling([n for n in numbers if signal.getsignal(n) not in others], handle):
        yield


@contextmanager
def _handling(
    numbers: Iterable[int], handle: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Handles signals in the context, in the main thread only; their handlers come back after."""
    is_main = threading.current_thread() is threading.main_thread()
    previous = {number: signal.signal(number, handle) for number in numbers if is_main}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def deferring_stops() -> Iterator[None]:
    """Defers stop signals for the main thread while it takes hold of something, such as a process.

    They are raised again at the end. Keep the block short.
    """
    noted: list[str] = []
    try:
        with stopping_on_signals(noted.append):
            yield
    finally:
        for name in noted:
            signal.raise_signal(signal.Signals[name])


class StopSignal(KeyboardInterrupt):
    """A signal that ends the program in order, where no run takes it.

    Args:
        number: Number of the signal.

    Attributes:
        number: Number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def stop_words(number: int) -> tuple[str, int]:
    """Returns the sentence on a signal that ended the program, and its exit code 128 + number."""
    name = signal.Signals(number).name
    return "interrupted" if number == signal.SIGINT else f"stopped by {name}", 128 + number


RELEASE_TIME = 5.0
"""Time in s for which a second signal does not interrupt the release of resources that the first
one began. All waits of a release together are shorter."""


class Interrupts:
    """Stop signals as exceptions, until a run takes them over.

    Code in C may swallow the exception of a signal, such as a callback of the importer or of the
    compiler. ``check`` raises it again, and so does a timer after ``RELEASE_TIME`` unless resources
    are being released then: a busy machine may stretch that.
    """

    def __init__(self) -> None:
        self.number = 0
        self._raised_at = -math.inf
        self._again: threading.Timer | None = None
        self._taker: Callable[[str], None] | None = None

    def heed(self, name: str) -> None:
        """Handles a signal by its name."""
        if self._taker is not None:
            self._taker(name)
            return
        self.number = self.number or signal.Signals[name]
        now = time.monotonic()
        if now - self._raised_at > RELEASE_TIME:
            self._raised_at = now
            self.end()
            thread = threading.get_ident()
            self._again = threading.Timer(1.01 * RELEASE_TIME, self._repeat, (thread,))
            self._again.daemon = True
            self._again.start()
            raise StopSignal(self.number)

    def _repeat(self, thread: int) -> None:
        if _is_handling_stop(thread):
            return
        if hasattr(signal, "pthread_kill"):  # it also ends a wait of that thread
            signal.pthread_kill(thread, self.number)
        else:
            signal.raise_signal(self.number)

    def end(self) -> None:
        """Notes that the exception has arrived."""
        if self._again is not None:
            self._again.cancel()

    def check(self) -> None:
        """Raises ``StopSignal`` if a signal came, whatever became of its exception."""
        if self.number:
            raise StopSignal(self.number)

    def hand_over(self, taker: Callable[[str], None]) -> None:
        """Passes the names of later signals to a function; raises ``StopSignal`` if one came."""
        self._taker = taker
        self.check()


def _is_handling_stop(thread: int) -> bool:
    """Returns whether a ``StopSignal`` has arrived in a thread, whose ``finally`` blocks run."""
    handled: Any = sys._current_exceptions().get(thread)
    error = handled[1] if isinstance(handled, tuple) else handled  # until 3.11 as exc_info
    while error is not None and not isinstance(error, StopSignal):
        error = error.__context__
    return error is not None


ENDING_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a command in order. One that holds no force may be suspended (SIGTSTP)."""


@contextmanager
def interrupting_on_signals(numbers: Sequence[int] = STOP_SIGNALS) -> Iterator[Interrupts]:
    """Makes stop signals act like Ctrl-C, so that all resources are closed.

    Raises:
        StopSignal: A signal came; also in place of an error that its exception became in C code.
    """
    interrupts, usual = Interrupts(), sys.unraisablehook

    def report(unraisable: Any) -> None:
        if not isinstance(unraisable.exc_value, StopSignal):  # ``check`` raises it again
            usual(unraisable)

    with stopping_on_signals(interrupts.heed, numbers):
        sys.unraisablehook = report
        try:
            yield interrupts
        except Exception:
            interrupts.check()
            raise
        finally:
            interrupts.end()
            sys.unraisablehook = usual


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
def leaving_on_signals() -> Iterator[None]:
    """Ends the process at once on a signal of ``ENDING_SIGNALS``, while there is nothing to lose.

    It is for imports. There a ``KeyboardInterrupt`` is lost in callbacks of the importer, which
    print it, or becomes another error in a library's C code. A handler other than Python's own is
    kept.
    """

    def leave(number: int, _frame: FrameType | None) -> None:
        words, code = stop_words(number)
        os.write(2, f"{words}\n".encode())
        os._exit(code)

    usual = (signal.default_int_handler, signal.SIG_DFL)
    with _handling([n for n in ENDING_SIGNALS if signal.getsignal(n) in usual], leave):
        yield
