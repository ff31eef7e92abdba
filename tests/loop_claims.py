"""What holds of a loop on any emulated device, in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.record import CLOCK_FIELDS, TickFlag


def peg_went_in_a_tick_late(summary: hb.Summary, recording: Path) -> NDArray[np.void]:
    """Requires that 4 s of ``peg_in_hole`` end in the hole, felt a tick late; returns the rows."""
    report = hb.audit(recording)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    # where a force acts a tick late, a bound is known for walls only
    assert report.certified is None
    assert "behind a delay of 1 ticks" in report.conditions[0]
    ticks = hb.read_recording(recording).ticks
    assert summary.ticks == len(ticks) == 4000
    assert (ticks["flags"] & int(TickFlag.CONTACT)).any()
    assert summary.peak_force > 0.05
    assert ticks["tool_position"][-1, 2] < 0.0  # its tip is below the hole's edge
    return ticks


def runs_are_the_same(record: Callable[[Path], object], folder: Path) -> None:
    """Requires that two runs give the same rows to the bit, but for the times of the clock."""
    rows = []
    for name in ("a", "b"):
        record(folder / f"{name}.mcap")
        rows.append(hb.read_recording(folder / f"{name}.mcap").ticks)
    for field in set(rows[0].dtype.names or ()) - set(CLOCK_FIELDS):
        assert rows[0][field].tobytes() == rows[1][field].tobytes(), field
