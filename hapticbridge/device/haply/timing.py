"""How fast a service answers, measured before the loop begins."""

from __future__ import annotations

import math

from hapticbridge.device.transport.websocket import Link
from hapticbridge.errors import DeviceLost

TIME = 0.1
"""In s: how long each of the two measurements takes."""

UNDER_WAY = 2
"""Messages kept under way while the rate is measured, as in the loop."""

SHARE = 0.95
"""Share of answers that came within the delay, no unit. The longest are the host's own stalls,
which the loop counts as missed deadlines."""

PACE = 1e-3
"""In s, from message to message while the delay is measured: a loop's period, so that threads sleep
in between as they will in the loop."""

_ANSWER_TIME = 0.05  # s, longer is silence


def measured_timing(link: Link, message: str, name: str) -> tuple[float, float]:
    """Returns at what rate states are delivered, and within what time they come.

    A message carries a force and asks for the state, so both are as old as each other; see
    ``timing``, where the same holds.

    Args:
        link: To a service; no message is under way.
        message: One without force.
        name: What errors call the device.

    Returns:
        The rate in Hz and the delay in s.

    Raises:
        DeviceLost: It fell silent.
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
        link.wait(max(begin + PACE - link.now(), 0.0))  # nothing comes: it only sleeps
    times.sort()
    return times[math.ceil(SHARE * len(times)) - 1]


def _answer(link: Link, name: str) -> None:
    if link.wait(_ANSWER_TIME) is None:
        raise DeviceLost(f"{name}: fell silent while its timing was measured")
