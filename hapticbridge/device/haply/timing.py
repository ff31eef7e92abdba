"""Measured timing of the service."""

from __future__ import annotations

import math

from hapticbridge.device.transport.websocket import Link
from hapticbridge.errors import DeviceLost

TIME = 0.1
"""Length of each of the two measurements in s."""

UNDER_WAY = 2
"""Number of messages kept on their way while the rate is measured, as in the loop."""

SHARE = 0.95
"""Share of answers within the delay, without unit. The slowest answers are stalls of the host,
which the loop counts as missed deadlines."""

PACE = 1e-3
"""Time in s between messages while the delay is measured: a period of the loop, so that threads
sleep in between as in the loop."""

_ANSWER_TIME = 0.05
"""Longest wait for an answer in s; a longer pause counts as silence."""


def measured_timing(link: Link, message: str, name: str) -> tuple[float, float]:
    """Measures the rate of states in Hz and the delay of answers in s.

    A message without force is sent each time. It both carries a force and requests the state, so
    both have this delay.

    Raises:
        DeviceLost: The service stopped answering.
    """
    return _rate(link, message, name), _delay(link, message, name)


def _rate(link: Link, message: str, name: str) -> float:
    for _ in range(UNDER_WAY):
        link.send(message)
    _answer(link, name)
    begin = link.now()
    count = 0
    while (now := link.now()) - begin < TIME:
        link.send(message)
        _answer(link, name)
        count += 1
    for _ in range(UNDER_WAY - 1):
        _answer(link, name)
    return count / (now - begin)


def _delay(link: Link, message: str, name: str) -> float:
    times = []
    end = link.now() + TIME
    while (begin := link.now()) < end:
        link.send(message)
        _answer(link, name)
        times.append(link.now() - begin)
        link.wait(max(begin + PACE - link.now(), 0.0))  # no answer is due, so this only sleeps
    times.sort()
    return times[math.ceil(SHARE * len(times)) - 1]


def _answer(link: Link, name: str) -> None:
    if link.wait(_ANSWER_TIME) is None:
        raise DeviceLost(
            f"{name}: fell silent while its timing was measured; restart the Inverse Service"
        )
