"""Contact points of round and flat shapes against the shapes' exact heights over a plate."""

from __future__ import annotations

import subprocess
import sys
from itertools import product

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.kernel.colliders import use_exact_points

Floats = NDArray[np.float64]

MARGIN = 1.5e-4
CUBE = 0.02 * np.array(list(product((-1.0, 1.0), repeat=3)))
ANGLES = np.arange(6) * np.pi / 3
PRISM = 0.02 * np.array([(np.cos(a), np.sin(a), z) for a in ANGLES for z in (-1.0, 1.0)])
SLAB = np.array([0.06, 0.06, 0.01]) * np.array(list(product((-1.0, 1.0), repeat=3)))

PLATES = {"box": 'type="box" size=".06 .06 .01"', "mesh": 'type="mesh" mesh="slab"'}
TOOLS = {
    "cylinder": 'type="cylinder" size=".02 .02"',
    "capsule": 'type="capsule" size=".01 .03"',
    "cube": 'type="mesh" mesh="cube"',
    "prism": 'type="mesh" mesh="prism"',
}
TOOL_ANGLES = {"cylinder": 0.0, "capsule": np.pi / 2, "cube": 0.0, "prism": 0.0}
"""Angle in rad by which each tool is turned to lie flat."""

PAIRS = [
    ("box", "cylinder"),
    ("mesh", "cylinder"),
    ("mesh", "capsule"),
    ("box", "cube"),
    ("mesh", "cube"),
    ("mesh", "prism"),
]


def depth_below_centre(tool: str, turn: Rotation) -> float:
    """Returns the distance in m of a tool's lowest point below its centre."""
    axis = turn.as_matrix()[:, 2]
    if tool == "cylinder":
        return float(0.02 * abs(axis[2]) + 0.02 * np.hypot(axis[0], axis[1]))
    if tool == "capsule":
        return float(0.03 * abs(axis[2]) + 0.01)
    return float(-turn.apply(CUBE if tool == "cube" else PRISM)[:, 2].min())


def errors(plate: str, tool: str, *, tilt: float, ours: bool) -> tuple[float, float]:
    """Returns the largest error of the smallest gap in m, and of a normal in rad."""

    def mesh(name: str, vertices: Floats) -> str:
        return f'<mesh name="{name}" vertex="{" ".join(map(str, vertices.ravel()))}"/>'

    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <default><geom margin="{MARGIN / 2}"/></default>
      <asset>{mesh("slab", SLAB)}{mesh("cube", CUBE)}{mesh("prism", PRISM)}</asset>
      <worldbody><geom {PLATES[plate]}/><body><freejoint/><geom {TOOLS[tool]}/></body></worldbody>
    </mujoco>""")
    use_exact_points(model, is_used=ours)
    data, random = mujoco.MjData(model), np.random.default_rng(7)
    gap_errors, normal_errors = [], []
    for k in range(240):
        lean = Rotation.from_rotvec([0.0, TOOL_ANGLES[tool], 0.0])
        roll = Rotation.from_rotvec([0.0, 0.0, random.uniform(-3.0, 3.0)])
        turn = Rotation.from_rotvec([*random.uniform(-tilt, tilt, 2), 0.0]) * roll * lean
        gap = (-2e-5, -1e-6, 1e-5)[k % 3]
        height = 0.01 + depth_below_centre(tool, turn) + gap
        data.qpos[:] = *random.uniform(-0.01, 0.01, 2), height, *turn.as_quat(scalar_first=True)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        contact = data.contact
        gap_errors.append(abs(min(contact.dist) - gap))
        normal_errors.append(np.arccos(np.abs(contact.frame[:, 2]).clip(0.0, 1.0)).max())
    return max(gap_errors), max(normal_errors)


@pytest.mark.parametrize("tilt", [0.01, 0.3])
@pytest.mark.parametrize(("plate", "tool"), PAIRS)
def test_the_smallest_gap_and_its_normal_are_those_of_the_plate(
    plate: str, tool: str, tilt: float
) -> None:
    gap, normal = errors(plate, tool, tilt=tilt, ours=True)
    # 1 µm is MuJoCo's ccd_tolerance, within which it finds the normal of round shapes
    assert gap < 1e-6
    assert normal < 5e-4


@pytest.mark.parametrize(("plate", "tool"), PAIRS)
def test_the_stock_functions_miss_the_lowest_point_or_tilt_the_normal(
    plate: str, tool: str
) -> None:
    found = [errors(plate, tool, tilt=tilt, ours=False) for tilt in (0.01, 0.3)]
    assert max(gap for gap, _ in found) > 1e-5 or max(normal for _, normal in found) > 5e-3


@pytest.mark.parametrize("tool", ["cylinder", "capsule"])
def test_no_point_is_moved_beside_the_face(tool: str) -> None:
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <default><geom margin="{MARGIN / 2}"/></default>
      <asset><mesh name="slab" vertex="{" ".join(map(str, (SLAB / 3).ravel()))}"/></asset>
      <worldbody>
        <geom type="mesh" mesh="slab"/><body><freejoint/><geom type="{tool}" size=".01 .06"/></body>
      </worldbody></mujoco>""")
    data, random = mujoco.MjData(model), np.random.default_rng(8)
    for _ in range(300):
        tilt = Rotation.from_rotvec([0.0, np.pi / 2 + random.uniform(-0.05, 0.05), 0.0])
        turn = Rotation.from_rotvec([0.0, 0.0, random.uniform(-3.0, 3.0)]) * tilt
        data.qpos[:] = 0.01, 0.0, random.uniform(0.0132, 0.0138), *turn.as_quat(scalar_first=True)
        mujoco.mj_kinematics(model, data)
        for ours in (False, True):
            use_exact_points(model, is_used=ours)
            mujoco.mj_collision(model, data)
            if data.ncon:
                outside = np.abs(data.contact.pos[:, :2]).max(axis=1) - 0.02
                assert outside.max() < (2e-6 if ours else 1e-3)


def test_only_functions_that_a_models_shapes_need_are_installed() -> None:
    code = """
import ctypes, mujoco
from hapticbridge.kernel.colliders import install
from hapticbridge.kernel.mujoco_c import library_path
table = (ctypes.c_void_p * 81).in_dll(ctypes.CDLL(str(library_path())), "mjCOLLISIONFUNC")
box, cylinder = int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_CYLINDER)
shapes = {"box": "<geom type='box' size='1 1 1'/>", "rod": "<geom type='cylinder' size='1 1'/>"}
def changed(*names):
    before = list(table)
    inside = "".join(shapes[name] for name in names)
    install(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{inside}</worldbody></mujoco>"))
    return [divmod(i, 9) for i in range(81) if table[i] != before[i]]
print(changed("box", "rod", "rod") == [(cylinder, box)], changed("box", "box") == [(box, box)])
"""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300
    )
    assert result.stdout.split() == ["True", "True"]


def test_a_table_that_another_program_changed_is_refused() -> None:
    code = """
import ctypes, mujoco
from hapticbridge.errors import SceneError
from hapticbridge.kernel.colliders import install
from hapticbridge.kernel.mujoco_c import library_path
library = ctypes.CDLL(str(library_path()))
table = (ctypes.c_void_p * 81).in_dll(library, "mjCOLLISIONFUNC")
box = int(mujoco.mjtGeom.mjGEOM_BOX)
shape = "<geom type='box' size='1 1 1'/>"
xml = f"<mujoco><worldbody>{shape}{shape}</worldbody></mujoco>"
table[9 * box + box] = ctypes.cast(library.mjc_Convex, ctypes.c_void_p).value
try:
    install(mujoco.MjModel.from_xml_string(xml))
except SceneError as error:
    print(error)
"""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert "another program has replaced" in result.stdout
