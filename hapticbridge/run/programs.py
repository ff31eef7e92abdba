"""Large programs of a run with one hand and of its audit, compiled together ahead of the first run.

Programs that are missing here are compiled when they are first needed. ``python -m`` with this
module makes all that the first run and its audit need, as ``scripts/setup`` and a wheel do.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hapticbridge.device.simulated.dynamics import STATE_DTYPE as HAND_DTYPE
from hapticbridge.device.simulated.dynamics import next_sample
from hapticbridge.kernel.colliders import C_TYPES, box_box, flat_flat, round_flat
from hapticbridge.kernel.handle import stretch_at
from hapticbridge.kernel.jit import Program, examples, prepare
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.kernel.shown_tool import shown_to_device
from hapticbridge.kernel.state import STATE_DTYPE
from hapticbridge.kernel.tick import (
    after_step,
    answer_step,
    before_step,
    between_halves,
    finish_tick,
    simulate_recorded,
)


def programs() -> list[Program]:
    """Returns the programs, first those with the most work for LLVM."""
    state, sample, row = (np.zeros(1, each) for each in (STATE_DTYPE, SAMPLE_DTYPE, TICK_DTYPE))
    counts = np.zeros(1, np.int64)
    recorded = counts[None], np.zeros(1), np.zeros((1, 1, 6))
    return [
        Program(after_step, (state, row, 0)),
        Program(answer_step, (state, row, 0)),
        Program(finish_tick, (state, row, row, counts, 0, 0, 0, 0, 0, True)),
        Program(before_step, (state, sample, row, 0, 0.0)),
        Program(shown_to_device, (state, 0.0, np.zeros(7))),
        Program(simulate_recorded, (state, sample[None], recorded, row, row[None])),
        Program(between_halves, (state,)),
        Program(stretch_at, (state[0], sample)),
        Program(next_sample, (np.zeros(1, HAND_DTYPE), np.empty((0, 8)), sample)),
        *(Program(each, examples(C_TYPES), C_TYPES) for each in (box_box, round_flat, flat_flat)),
    ]


def prepare_run(note: Callable[[int], None]) -> None:
    """Compiles what a run and its audit need and is not on disk (``jit.prepare``)."""
    prepare(programs(), note)


def words(left: int) -> str:
    """Returns a line of progress; ``left`` is the number of programs that are left."""
    return f"compiling for this machine, once, for about a minute; programs left: {left} …"


def main() -> None:
    """Compiles with lines of progress, and runs and audits a scene once."""
    from hapticbridge import Bridge, SimulatedClock, audit  # noqa: PLC0415 - they import much

    prepare_run(lambda left: print(words(left), file=sys.stderr, flush=True))
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder, "run.mcap")
        with Bridge("peg_in_hole", clock=SimulatedClock(), recording=path) as bridge:
            bridge.run(0.02)
        audit(path, in_process=True)


if __name__ == "__main__":
    main()
