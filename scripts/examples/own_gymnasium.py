"""An environment of gymnasium-robotics with a hand at its gripper, over two episodes."""

import gymnasium
import gymnasium_robotics

import hapticbridge as hb
from hapticbridge.program.gymnasium import HapticWrapper

gymnasium.register_envs(gymnasium_robotics)
fetch = gymnasium.make("FetchPickAndPlace-v4", max_episode_steps=100)
loop = hb.DeviceLoop(
    "simulated", recording="own.mcap", is_simulated=True, scale=4.0, scene_rate=25.0
)
with loop:
    env = HapticWrapper(fetch, loop, "robot0:grip")
    for episode in range(2):
        env.reset(seed=episode)
        for _ in range(50):
            env.step(env.hand_action())
            loop.advance(env.unwrapped.dt)  # not in real time
print("100 steps,", f"{loop.summary['peak_force']:.2f} N,", loop.summary["verdict"])
