"""The device's motion in the scene: origin, scales and axes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from bridge_runs import fast, sway
from scipy.spatial.transform import Rotation

from hapticbridge.audit import audit
from hapticbridge.demand.guard import Limits
from hapticbridge.errors import DeviceError, HapticBridgeError
from hapticbridge.recording import read_recording
from hapticbridge.run.options import Workspace


def test_relative_poses_start_at_the_grip_and_absolute_ones_are_the_handle() -> None:
    shift = np.array([0.1, -0.2, 0.3])
    device = ScriptedDevice(lambda k: (*(shift + sway(k)[:3]), *sway(k)[3:]))
    with fast("peg_in_hole", device) as bridge:
        bridge.run(0.1)
        relative = bridge.latest_records(100)
    np.testing.assert_allclose(
        relative["handle_position"], relative["device_position"] - shift + [0, 0, 0.04], atol=1e-16
    )
    device = ScriptedDevice(lambda k: (*(np.array([0, 0, 0.04]) + sway(k)[:3]), *sway(k)[3:]))
    with fast("peg_in_hole", device, workspace=Workspace(absolute=True)) as bridge:
        bridge.run(0.1)
        absolute = bridge.latest_records(100)
    assert (absolute["handle_position"] == absolute["device_position"]).all()
    np.testing.assert_allclose(
        absolute["handle_quaternion"], absolute["device_quaternion"], atol=1e-15
    )


def test_scales_and_axes_map_motion_in_and_wrench_out() -> None:
    turn = Rotation.from_rotvec([0.3, -0.5, 1.1])
    limits = Limits(force=1e3, torque=50, ramp=0.0)
    scale, force_scale = 2.5, 0.4
    with fast(
        "point_mass",
        ScriptedDevice(sway, strength=1e3),
        workspace=Workspace(scale=scale, force_scale=force_scale, axes=turn.as_matrix()),
        limits=limits,
    ) as bridge:
        bridge.run(0.2)
        rows = bridge.latest_records(200)
    np.testing.assert_allclose(
        rows["handle_position"], scale * turn.apply(rows["device_position"]), atol=1e-15
    )
    device = Rotation.from_quat(rows["device_quaternion"], scalar_first=True)
    handle = Rotation.from_quat(rows["handle_quaternion"], scalar_first=True)
    assert ((turn * device * turn.inv()).inv() * handle).magnitude().max() < 1e-14
    on_tool, on_device = rows["wrench_on_tool"], rows["wrench_on_device"]
    np.testing.assert_allclose(
        on_device[:, :3], -force_scale * turn.inv().apply(on_tool[:, :3]), atol=1e-13
    )
    np.testing.assert_allclose(
        on_device[:, 3:], -force_scale / scale * turn.inv().apply(on_tool[:, 3:]), atol=1e-13
    )
    assert np.linalg.norm(on_tool[:, :3], axis=1).max() > 0.1


def test_axes_written_with_six_digits_are_a_rotation_to_the_last_one(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    c = 0.707107
    summary = recorded(
        path, "point_mass", workspace=Workspace(axes=[c, -c, 0, c, c, 0, 0, 0, 1]), duration=2.0
    )
    assert summary.environment == "strict"
    assert audit(path).verdict == "passive"
    axes = np.array(json.loads(read_recording(path).meta["axes"])).reshape(3, 3)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    "axes",
    [[1, 0, 0, 0, 1, 0, 0, 0, -1], [1, 0.1, 0, 0, 1, 0, 0, 0, 1], [1, 0, 0], "xyz", [np.nan] * 9],
    ids=["mirror", "shear", "too few", "text", "nan"],
)
def test_axes_that_are_no_rotation_are_refused(axes: Any) -> None:
    with pytest.raises(HapticBridgeError, match="right-handed rotation"):
        Workspace(axes=axes)


@pytest.mark.parametrize(("distance", "is_refused"), [(0.0041, False), (0.0042, True)])
def test_absolute_start_that_would_pull_beyond_the_limit_is_refused(
    distance: float, is_refused: bool
) -> None:
    """At 2400 N/m the device's 10 N are reached 4.17 mm from the grip."""
    device = ScriptedDevice(lambda _tick: (distance, 0, 0, 1, 0, 0, 0))
    bridge = fast("point_mass", device, workspace=Workspace(absolute=True))
    if not is_refused:
        with bridge:
            bridge.run(0.01)
        return
    with pytest.raises(DeviceError, match="puts the handle"), bridge:
        pass
    assert device.is_closed
