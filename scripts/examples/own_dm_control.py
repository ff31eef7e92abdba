"""A dm_control task with a hand on its mass: Shimmy makes it an environment, motors follow it."""

from dm_control import suite
from shimmy.dm_control_compatibility import DmControlCompatibilityV0

import hapticbridge as hb
from hapticbridge.program.gymnasium import HapticWrapper

task = DmControlCompatibilityV0(suite.load("point_mass", "easy"))
loop = hb.DeviceLoop(
    "simulated", recording="own.mcap", is_simulated=True, scale=4.0, scene_rate=50.0
)
with loop:
    env = HapticWrapper(task, loop, "pointmass", lambda offset, handle: 400.0 * offset[:2])
    env.reset()
    for _ in range(100):
        env.step(env.hand_action())
        loop.advance(task.dt)  # not in real time
print("100 steps,", f"{loop.summary['peak_force']:.2f} N,", loop.summary["verdict"])
