"""Measured timing of a Falcon."""

from __future__ import annotations

import math

from hapticbridge.device.falcon.boot import Link, answers, ask, send_question
from hapticbridge.device.falcon.packets import ReplyStream
from hapticbridge.errors import DeviceLost

TIME = 0.1
"""Length of each of the two measurements in s."""

UNDER_WAY = 2
"""Number of requests kept on their way while the rate is measured, so that one waits when a reply
leaves."""

PACE = 1.07e-3
"""Time in s between requests while the delay is measured. It is slightly longer than the bridge's
timer of 1 ms, so that the requests sweep over all its phases."""

SHARE = 0.95
"""Share of replies within the delay, without unit. The slowest replies are stalls of the host,
which the loop counts as missed deadlines."""

TRIES = 3
"""Number of measurements before a Falcon counts as silent. A reply can be lost on the serial line,
and a busy host can stall for longer than the timeout."""

_ANSWER_TIME = 0.05
"""Longest wait for a reply in s; a longer pause counts as silence."""


def measured_timing(link: Link, stream: ReplyStream, name: str) -> tuple[float, float]:
    """Measures the rate of deliveries in Hz and the delay of replies in s.

    The rate is measured with ``UNDER_WAY`` requests always on their way; replies that arrive
    together are one delivery. The delay is the time from a single request to its reply that the
    share ``SHARE`` of the replies meets. A packet both requests the encoders and carries the force,
    so both have this delay. With one packet per tick the force acts after the delay, rounded up to
    whole ticks, beyond the one tick for which it is held.

    Raises:
        DeviceLost: The device stopped replying.
    """
    for _ in range(TRIES):
        rate = _rate(link, stream)
        if rate is not None and (delay := _delay(link, stream)) is not None:
            return rate, delay
    raise DeviceLost(
        f"{name}: fell silent while its timing was measured; check its cable and its power"
    )


def _rate(link: Link, stream: ReplyStream) -> float | None:
    """Measures the rate in Hz; None if a reply is missing."""
    for _ in range(UNDER_WAY):
        send_question(link)
    begin = last = link.now()
    deliveries = 0
    while last - begin < TIME:
        found = answers(link, stream, _ANSWER_TIME)
        if not found:
            return None
        last = link.now()
        if deliveries == 0:
            begin = last  # time counts from the first delivery
        deliveries += 1
        for _ in range(found):
            send_question(link)
    for _ in range(UNDER_WAY):
        answers(link, stream, 2 * PACE)  # drain the last replies
    return (deliveries - 1) / (last - begin)


def _delay(link: Link, stream: ReplyStream) -> float | None:
    """Measures the delay in s; None if a reply is missing."""
    times = []
    end = link.now() + TIME
    while (begin := link.now()) < end:
        if not ask(link, stream, 0, _ANSWER_TIME):
            return None
        times.append(link.now() - begin)
        while (left := begin + PACE - link.now()) > 0:
            link.wait(left)
            link.take()  # the bridge reports its status every millisecond
    times.sort()
    return times[math.ceil(SHARE * len(times)) - 1]
