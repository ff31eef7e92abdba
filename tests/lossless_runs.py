"""Runs of the lossless coupling in small scenes, led by a handle whose path is given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from kernel_runs import Array, unlimited
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.lab.methods import METHODS
from hapticbridge.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.rendering import prepare
from hapticbridge.scene import Scene, load_scene
from hapticbridge.summary import Ledger

LOSSLESS = METHODS["lossless"]
T = 1e-3

SPUN = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body><freejoint/>
      <inertial pos="0.01 0 0.02" mass="0.2" diaginertia="1e-4 2e-4 3e-4"/>
      <site name="grip" pos="0.03 0 0"/>
    </body>
  </worldbody>
  <keyframe><key name="home" qvel="0 0 0 30 0 40"/></keyframe>
</mujoco>"""
"""A free tool held off its centre of mass, turning at 50 rad/s about no principal axis."""

ARM = """
<mujoco>
  <option gravity="0 0 {gravity}"/>
  <default><geom type="capsule" size="0.01" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body><joint axis="0 0 1" stiffness="{spring}"/><geom fromto="0 0 0 0.2 0 0" mass="0.2"/>
      <body pos="0.2 0 0"><joint axis="0 1 0"/><geom fromto="0 0 0 0.2 0 0" mass="0.2"/>
        <body pos="0.2 0 0"><joint axis="0 1 0"/><geom fromto="0 0 0 0.1 0 0" mass="0.1"/>
          <site name="grip" pos="0.1 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <keyframe><key name="home" qpos="0.1 -0.5 1"/></keyframe>
</mujoco>"""


def scene_of(xml: str, folder: Path) -> Scene:
    path = folder / "scene.xml"
    path.write_text(xml, encoding="utf-8")
    return load_scene(path)


def bound(scene: Scene, method: str, asked: Coupling, period: float) -> BoundKernel:
    """Returns a kernel bound to a scene at its start, rendering what is asked for."""
    used = METHODS[method].used(asked, period)
    prepare(scene, asked, period, 1, METHODS[method], warns=False)
    parameters = unlimited(scene, used, period, scheme=METHODS[method].scheme)
    return BoundKernel(scene.model, scene.data, parameters)


def led(
    scene: Scene,
    method: str,
    asked: Coupling,
    path: Array,
    period: float,
    turn: Array | None = None,
) -> tuple[np.ndarray, Ledger]:
    """Leads a scene through handle positions (n, 3) and quaternions, one per period."""
    samples = np.zeros(len(path), SAMPLE_DTYPE)
    samples["position"] = path
    samples["quaternion"] = (1.0, 0.0, 0.0, 0.0) if turn is None else turn
    binding = bound(scene, method, asked, period)
    rows = np.zeros(len(path), TICK_DTYPE)
    assert simulate(binding.state, samples, binding.row, rows) == len(path)
    return rows, Ledger.of(binding.state)


def circling(period: float, frequency: float, duration: float = 1.0) -> Array:
    t = period * np.arange(1, round(duration / period) + 1)
    w = 2 * np.pi * frequency * t
    return np.column_stack([0.02 * np.sin(w), 0.02 * (1 - np.cos(w)), 0.01 * np.sin(w)])


def distance(rows: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Returns RMS distances in m and rad from a reference of more ticks."""
    every = len(reference) // len(rows)
    same = reference[every - 1 :: every]
    away = np.linalg.norm(rows["tool_position"] - same["tool_position"], axis=1)
    turned = Rotation.from_quat(rows["tool_quaternion"], scalar_first=True)
    turned *= Rotation.from_quat(same["tool_quaternion"], scalar_first=True).inv()
    return float(np.sqrt(np.mean(away**2))), float(np.sqrt(np.mean(turned.magnitude() ** 2)))


def tapping(period: float, frequency: float = 2.0) -> Array:
    t = period * np.arange(1, round(2.0 / period) + 1)
    path = np.zeros((t.size, 3))
    path[:, 0] = 0.008 * (1 - np.cos(2 * np.pi * frequency * t))
    return path
