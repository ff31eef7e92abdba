"""Blocks of ticks of the imported checkout, timed on request: for ``scripts/bench tick --against``.

A line on stdin is a JSON object. ``{"scene": NAME, "method": NAME, "in_contact": BOOL}`` opens a
bridge as it runs by default, pipelined and with a whole guard; ``{}`` runs its next block. A line
on stdout answers each: for a block the medians of its ticks in ns, null where no tick counts. Only
what ``hapticbridge`` exports is used, so that checkouts with other modules inside can be compared.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import ExitStack

import numpy as np

import hapticbridge as hb

BLOCK = 250
"""Ticks per block: some 5 ms, short beside disturbances of a machine, long beside a cold cache."""


class UnpacedClock:
    """Real time that never waits, so that the records' times tell how long each tick took."""

    name = "unpaced"
    may_wait = True

    def start(self, period_ns: int) -> None:
        """Does nothing: there is no deadline."""

    def wait(self) -> tuple[int, int, int]:
        """Returns at once, with the present time as deadline and wake-up."""
        now = time.perf_counter_ns()
        return now, now, 0

    def now(self) -> int:
        """Returns the time in ns."""
        return time.perf_counter_ns()


def open_bridge(requested: dict[str, str], stack: ExitStack) -> hb.Bridge:
    """Closes the last bridge and opens the requested one."""
    stack.close()
    bridge = hb.Bridge(
        requested["scene"],
        "simulated",
        method=requested["method"],
        clock=UnpacedClock(),
        pipelined=True,
        controller="damper",
    )
    return stack.enter_context(bridge)


def run_block(bridge: hb.Bridge, *, in_contact: bool) -> dict[str, float | None]:
    """Runs a block of ticks; returns their median times in ns."""
    bridge.run(BLOCK * bridge.period)
    rows = bridge.latest_records(BLOCK)
    counted = (rows["contacts"][:-1] > 0) | (not in_contact)
    times = {
        "tick": np.diff(rows["wake_ns"])[counted],
        "sample to wrench": (rows["write_ns"] - rows["read_ns"])[:-1][counted],
    }
    return {part: float(np.median(t)) if t.size else None for part, t in times.items()}


def main() -> None:
    """Answers line by line until the input ends."""
    with ExitStack() as stack:
        bridge, in_contact = None, False
        for line in sys.stdin:
            requested = json.loads(line)
            answer: dict[str, float | None] = {}
            if requested:
                bridge, in_contact = open_bridge(requested, stack), requested["in_contact"]
            elif bridge is not None:
                answer = run_block(bridge, in_contact=in_contact)
            print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
