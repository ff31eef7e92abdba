"""A key of the keyboard drives a motor of the scene, while the hand holds the tool.

In a terminal the keys + and - change the motor's force; elsewhere it follows a script.
"""

import select
import sys

import mujoco

import hapticbridge as hb

SCENE = """
<mujoco model="slider">
  <option timestep="0.001" gravity="0 0 0"/>
  <worldbody>
    <body name="slider">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.02 0.02 0.02" mass="0.2"/>
      <site name="grip"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""
is_terminal = sys.stdin.isatty()
motor = {"force": 0.0}


def key() -> str:
    """Returns the line that was typed since the last call; empty without one."""
    if is_terminal and select.select([sys.stdin], [], [], 0)[0]:
        return sys.stdin.readline().strip()
    return ""


def on_tick(tick: int) -> None:
    """Sets the motor's force in N before each fiftieth tick."""
    if tick % 50:
        return
    pressed = key() if is_terminal else ("+" if tick < 500 else "-")
    motor["force"] += {"+": 0.05, "-": -0.05}.get(pressed, 0.0)
    bridge.set_input(ctrl={"push": min(max(motor["force"], -1.0), 1.0)})


clock = hb.RealClock() if is_terminal else hb.SimulatedClock()
scene = hb.load_scene(mujoco.MjSpec.from_string(SCENE))
with hb.Bridge(scene, clock=clock, method="implicit") as bridge:
    summary = bridge.run(duration=1.0, on_tick=on_tick)
print(summary.environment, f"{summary.energies['actuator_work']:.2e} J by the motor")
