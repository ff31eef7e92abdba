"""Table of a what-if's runs."""

from __future__ import annotations

from collections.abc import Iterator

from hapticbridge.quantity import quantity
from hapticbridge.whatif.outcome import WhatIf, WhatIfRun

_PEAK_UNITS = {"force": "N", "torque": "N m", "stretch": "m"}

Row = tuple[str, tuple[str, ...]]


def rows(found: WhatIf) -> Iterator[Row]:
    """Yields a name and a text per run, in the order of ``found.runs``."""
    runs = found.runs
    yield "verdict", tuple(f"{r.report.words}, tripped" if r.trip else r.report.words for r in runs)
    for name in runs[0].peaks:
        unit = _PEAK_UNITS[name.split()[0]]
        yield f"peak {name}", tuple(quantity(run.peaks[name], unit) for run in runs)
    for name in runs[0].report.energies:
        joules = [run.report.energies.get(name, 0.0) for run in runs]
        if any(joules):
            yield name.replace("_", " "), tuple(quantity(e, "J") for e in joules)
    yield "slack used", tuple(f"{run.report.slack_share:.0%}" for run in runs)
    yield "device bears it", tuple(map(_certified, runs))
    yield "ran", tuple(f"{run.report.duration:.3f} s" for run in runs)


def changes(found: WhatIf) -> Iterator[tuple[str, str, str]]:
    """Yields each change: name, and the value before and after with its unit."""
    for name, unit, before, after in found.changes:
        yield (
            name,
            f"{_format_value(before)} {unit}".rstrip(),
            f"{_format_value(after)} {unit}".rstrip(),
        )


def sentences(run: WhatIfRun) -> Iterator[str]:
    """Yields the reasons why a run is not passive and why it was stopped."""
    if run.report.verdict != "passive":
        yield run.report.reason
    if run.trip:
        yield f"tripped: {run.trip}"


def _certified(run: WhatIfRun) -> str:
    return {True: "yes", False: "no", None: "not judged"}[run.report.certified]


def _format_value(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "none" if value is None else str(value)
