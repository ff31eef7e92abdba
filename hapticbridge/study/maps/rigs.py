"""What maps have in common: hands that stand still or swing, and a scene in every thread."""

from __future__ import annotations

import re
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.device import Motion
from hapticbridge.scene import Scene, load_scene
from hapticbridge.scene.load import scene_path
from hapticbridge.study.closed_loop import ClosedLoop

STILL = Motion([0.0, 1.0], np.zeros((2, 3)))
"""The path of a hand that wants to stay where it is."""


def swinging(amplitude: float, frequency: float, duration: float, count: int) -> Motion:
    """Returns the path of a hand that swings along x and turns nothing: A (1 − cos 2πft).

    Args:
        amplitude: A in m; it goes 2A far and back.
        frequency: f in Hz.
        duration: In s.
        count: Rows, evenly over the duration; between them the path is straight.
    """
    time = np.linspace(0.0, duration, count)
    path = np.zeros((count, 3))
    path[:, 0] = amplitude * (1 - np.cos(2 * np.pi * frequency * time))
    return Motion(time, path)


_of_this_thread = threading.local()


def scene_of(mjcf: str) -> Scene:
    """Loads a scene from the text of an MJCF file that refers to no other."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rig.xml"
        path.write_text(mjcf, encoding="utf-8")
        return load_scene(path)


def free_body(mass: float, inertia: ArrayLike) -> str:
    """Returns the MJCF of a free tool in nothing: no gravity, no contact, held by its centre.

    Args:
        mass: In kg.
        inertia: Principal moments about its centre in kg m², shape (3,).
    """
    moments = " ".join(map(repr, np.asarray(inertia, float).tolist()))
    return f"""
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass!r}" diaginertia="{moments}"/>
      <geom type="sphere" size="0.01" mass="0" contype="0" conaffinity="0"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def free_tool_and_wall() -> Scene:
    """Loads ``virtual_wall`` with its rail taken away: a tool of six degrees of freedom."""
    text = scene_path("virtual_wall").read_text(encoding="utf-8")
    freed, count = re.subn(r"<joint [^>]*type=\"slide\"[^>]*/>", "<freejoint/>", text)
    assert count == 1, "virtual_wall has one slide joint"
    return scene_of(freed.replace('<key name="home" qpos="0"/>', '<key name="home"/>'))


def loop_in(
    scene: str | Callable[[], Scene],
    key: object = None,
    change: Callable[[mujoco.MjModel], None] | None = None,
) -> ClosedLoop:
    """Returns a closed loop on a scene, made once per thread.

    Args:
        scene: The name of a shipped one, or what loads it.
        key: What tells this change from others; loops are kept by scene and key.
        change: Applied to the model before the first run; derived constants are set again.
    """
    loops: dict[object, ClosedLoop] = _of_this_thread.__dict__.setdefault("loops", {})
    if (scene, key) not in loops:
        loop = ClosedLoop(load_scene(scene) if isinstance(scene, str) else scene())
        if change is not None:
            change(loop.scene.model)
            mujoco.mj_setConst(loop.scene.model, loop.scene.data)
        loops[scene, key] = loop
    return loops[scene, key]


def wall_loop(mass: float, scene: str | Callable[[], Scene] = "virtual_wall") -> ClosedLoop:
    """Returns a closed loop whose tool is a wall: so heavy that no hand moves it.

    Args:
        mass: Of the tool in kg.
        scene: As for ``loop_in``, its tool called ``tool``.
    """
    return loop_in(scene, ("wall", mass), lambda model: set_tool_mass(model, "tool", mass))


def set_tool_mass(model: mujoco.MjModel, body: str, mass: float) -> None:
    """Gives a body another mass and scales its inertia alike.

    The inertia per kg is rounded to single precision, so that a mass set before leaves no trace:
    what a point gives must not depend, even in its last bit, on the points before it.

    Args:
        model: Changed in place; ``mj_setConst`` must follow.
        body: The tool's name.
        mass: In kg.
    """
    body_id = model.body(body).id
    per_kg = model.body_inertia[body_id] / model.body_mass[body_id]
    model.body_inertia[body_id] = mass * per_kg.astype(np.float32).astype(np.float64)
    model.body_mass[body_id] = mass
