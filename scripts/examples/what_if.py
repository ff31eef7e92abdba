"""The recorded hand on a stiffer coupling: would it still be passive, and what would it feel?"""

import hapticbridge as hb
from hapticbridge.whatif import what_if

with hb.Bridge("virtual_wall", clock=hb.SimulatedClock(), recording="run.mcap") as bridge:
    bridge.run(duration=2.0)

found = what_if("run.mcap", {"stiffness": 3000.0})
for run in found.runs:
    print(f"{run.name:<12} {run.report.words}")
