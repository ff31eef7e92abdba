"""Force over time of a recorded run, as a data frame and a picture."""

import matplotlib as mpl

mpl.use("Agg")  # a picture in a file; leave it out for a window

import hapticbridge as hb

with hb.Bridge("virtual_wall", clock=hb.SimulatedClock(), recording="run.mcap") as bridge:
    bridge.run(duration=2.0)

frame = hb.read_recording("run.mcap").to_pandas()
touching = (frame["flags"] & int(hb.TickFlag.CONTACT)) != 0
print(f"{touching.mean():.0%} of the time in contact")
axes = frame[["wrench_on_device_fx", "wrench_on_device_fz"]].plot(ylabel="force on the hand in N")
axes.figure.savefig("force.png")
