"""A scene built in Python with MuJoCo's MjSpec: a drawer on a rail, no file."""

import mujoco

import hapticbridge as hb

spec = mujoco.MjSpec()
spec.modelname = "drawer"
spec.option.timestep = 1e-3
spec.option.gravity = [0, 0, 0]
drawer = spec.worldbody.add_body(name="drawer")
drawer.add_joint(
    name="rail", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0], range=[0, 0.1], frictionloss=1.5
)
drawer.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.1, 0.04], mass=0.8)
drawer.add_site(name="knob", pos=[0.06, 0, 0])

scene = hb.load_scene(spec, grip="knob")
with hb.Bridge(scene, "simulated:hand_mass=0.5", clock=hb.SimulatedClock()) as bridge:
    summary = bridge.run(duration=1.0)
print(summary.environment, summary.energies["coupling_work"], "J")
