"""A MuJoCo loop of your own with a hand in it, once with the coupling's wrench on the tool."""

import mujoco

import hapticbridge as hb

SCENE = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
  <body pos="0 0 .03" gravcomp="1"><freejoint/><geom size=".02" mass=".2"/><site name="tip"/></body>
</worldbody></mujoco>"""
model = mujoco.MjModel.from_xml_string(SCENE)
own = {"scene_rate": 1.0 / model.opt.timestep}  # of the poses that are shown
for uses_wrench in (True, False):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    tip, velocity = data.site("tip").xpos, data.qvel[:3]
    with hb.DeviceLoop("simulated", recording="own_loop.mcap", is_simulated=True, **own) as device:
        device.show(tip)
        for _ in range(1000):
            mujoco.mj_kinematics(model, data)  # or the pose is that of the last step's start
            if uses_wrench:
                data.xfrc_applied[1] = device.wrench(tip, velocity)
            else:
                data.xfrc_applied[1, :3] = 300 * (device.pose().position - tip) - 8 * velocity
                device.show(tip, velocity)
            mujoco.mj_step(model, data)
            device.advance(model.opt.timestep)  # not in real time
    is_certified = device.summary["is_certified"]
    print(device.summary["verdict"], is_certified, f"{device.summary['peak_force']:.2f} N at most")
