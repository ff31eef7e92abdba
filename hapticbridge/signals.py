"""SIGINT and SIGTERM as a wish to stop, for as long as a loop runs."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stopping_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Calls ``stop`` instead of raising; only the main thread may do so, others run as they are.

    A ``KeyboardInterrupt`` in the middle of a tick could fall between a computed wrench and its
    being sent; a wish that is looked at once a tick cannot.
    """

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, handle) for number in STOP_SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
