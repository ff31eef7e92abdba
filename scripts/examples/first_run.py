"""A run in simulated time, its verdict, and the audit of its recording."""

import hapticbridge as hb

with hb.Bridge("peg_in_hole", clock=hb.SimulatedClock(), recording="run.mcap") as bridge:
    summary = bridge.run(duration=2.0)
print(f"{summary.ticks} ticks, at most {summary.peak_force:.2f} N: {summary.environment}")

report = hb.audit("run.mcap")
print(report.verdict, report.resimulation)
