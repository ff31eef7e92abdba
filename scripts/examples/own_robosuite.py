"""A robosuite environment with a hand on its arm: OSC steps, and the end effector that is felt."""

import robosuite
from robosuite.controllers import load_composite_controller_config

import hapticbridge as hb
from hapticbridge.program.robosuite import HapticDevice

env = robosuite.make(
    "Lift",
    robots="Panda",
    controller_configs=load_composite_controller_config(controller="BASIC"),
    has_renderer=False,
    has_offscreen_renderer=False,
    use_camera_obs=False,
    control_freq=50,
)
env.reset()
loop = hb.DeviceLoop(
    "simulated", recording="own.mcap", is_simulated=True, scale=4.0, scene_rate=50.0
)
with loop:
    device = HapticDevice(env, loop)
    device.start_control()
    for _ in range(150):
        action = device.input2action()
        vector = env.robots[0].create_action_vector(action | {"right": action["right_delta"]})
        env.step(vector)
        loop.advance(1 / env.control_freq)  # not in real time
print("150 steps,", f"{loop.summary['peak_force']:.2f} N,", loop.summary["verdict"])
