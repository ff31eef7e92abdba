"""The coupling becomes stiffer during a run, and no energy comes of it."""

import hapticbridge as hb
from hapticbridge.run.commands import Couple


def on_tick(tick: int) -> None:
    """Doubles the stiffness after a second."""
    if tick == 1000:
        bridge.command(Couple(stiffness=2000.0, damping=1.5), by="example")


with hb.Bridge(
    "virtual_wall", coupling={"stiffness": 1000.0}, clock=hb.SimulatedClock(), recording="run.mcap"
) as bridge:
    bridge.run(duration=2.0, on_tick=on_tick)
print(hb.audit("run.mcap").words)
