"""How fast a Falcon answers, measured on the unit before the loop begins."""

from __future__ import annotations

import math

from hapticbridge.device.falcon.boot import Link, answers, ask, send_question
from hapticbridge.device.falcon.packets import ReplyStream
from hapticbridge.errors import DeviceLost

TIME = 0.1
"""In s: how long each of the two measurements takes."""

UNDER_WAY = 2
"""Questions kept under way while the rate is measured: one is there when a reply leaves."""

PACE = 1.07e-3
"""In s: from question to question while the delay is measured. A little more than the bridge's
timer of 1 ms, so that the questions sweep over all its phases."""

SHARE = 0.95
"""Share of replies that came back within the delay, no unit. The longest are the host's own stalls,
which the loop counts as missed deadlines."""

TRIES = 3
"""How often the timing is measured before a Falcon counts as silent: a reply can be lost on the
serial line, and a busy host can stall for as long as one is waited for."""

_ANSWER_TIME = 0.05  # s, longer is silence


def measured_timing(link: Link, stream: ReplyStream, name: str) -> tuple[float, float]:
    """Returns at what rate replies are delivered, and within what time they come.

    The rate is deliveries per second with ``UNDER_WAY`` questions always asked; several replies
    that came together are one delivery. The delay is the time from a question to its reply that
    ``SHARE`` of the replies kept, one question at a time.

    A question asks for the encoders and carries the force, so both are as old as each other: where
    the loop sends one per tick, the force that answers a sample acts the delay later, rounded up to
    whole ticks, beyond the one tick for which it is held.

    Args:
        link: To a Falcon that speaks.
        stream: Takes its replies.
        name: What errors call it.

    Returns:
        The rate in Hz and the delay in s.

    Raises:
        DeviceLost: It fell silent.
    """
    for _ in range(TRIES):
        rate = _rate(link, stream)
        if rate is not None and (delay := _delay(link, stream)) is not None:
            return rate, delay
    raise DeviceLost(f"{name}: fell silent while its timing was measured")


def _rate(link: Link, stream: ReplyStream) -> float | None:
    """Measures the rate in Hz; None where a reply did not come."""
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
        answers(link, stream, 2 * PACE)  # the last ones, which nobody waited for
    return (deliveries - 1) / (last - begin)


def _delay(link: Link, stream: ReplyStream) -> float | None:
    """Measures the delay in s; None likewise."""
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
