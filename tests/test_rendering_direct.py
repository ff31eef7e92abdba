"""A tool without mass: its contact force, and the geometry that decides what it does."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import recorded
from kernel_runs import T, load, samples_of, sines
from rendering_runs import (
    COUPLING,
    FREE,
    SERVO,
    SLOT,
    TURNED_TOOL,
    WALL,
    Rotor,
    rendered,
)
from scipy.spatial.transform import Rotation

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.certificate import run_conditions
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.errors import SceneError
from hapticbridge.guard import Limits
from hapticbridge.lab.closed_loop import ClosedLoop, Timing
from hapticbridge.lab.methods import METHODS
from hapticbridge.rendering import (
    method_named,
    prepare,
)
from hapticbridge.scene import load_scene


def test_a_tool_without_coupling_has_no_condition_on_the_device() -> None:
    for method, count in (("direct", 0), ("implicit", 2)):
        with Bridge("peg_in_hole", clock=SimulatedClock(), method=method) as bridge:
            found = run_conditions(
                bridge.device.info, bridge.session.parameters, bridge.setup.method
            )
            assert len(found) == count


def test_geometry_touching_within_a_margin_pushes_on_nothing() -> None:
    """A contact that MuJoCo reports before touch has a negative depth."""
    text = SLOT.format(half=0.02).replace("<geom solref", '<geom margin="0.01" solref')
    samples = samples_of(np.array([[0.0, 0, 0], [1e-3, 0, 0]]))
    run = rendered("direct", COUPLING, samples, text, contact_stiffness=500.0)
    assert run.ticks["contacts"][1] == 4
    assert run.ticks["wrench_on_tool"][:, 0] == pytest.approx([0, 2 * 500 * 1e-3], abs=1e-9)


@pytest.mark.parametrize("xml", [SLOT.format(half=0.02), TURNED_TOOL])
def test_massless_tool_is_where_the_handle_is(xml: str) -> None:
    turning = Rotation.from_rotvec(sines(200, 0.1, 2.0) * [0, 1, 0])
    motion = sines(200, 0.02) * [1, 0, 1]
    run = rendered("direct", COUPLING, samples_of(motion, turning), xml)
    assert run.ticks["tool_position"] == pytest.approx(run.ticks["handle_position"], abs=1e-15)
    assert run.ticks["tool_quaternion"] == pytest.approx(run.ticks["handle_quaternion"], abs=1e-14)


def test_contact_force_of_a_massless_tool_is_its_stiffness_times_penetration() -> None:
    samples = samples_of(np.array([[1e-3, 0, 0], [-2e-3, 0, 0.1], [0, 0, 0.2]]))
    run = rendered("direct", COUPLING, samples, SLOT.format(half=0.02), contact_stiffness=500.0)
    # both ends press on one wall; the hand must push the tool in
    force = run.ticks["wrench_on_tool"][:, 0]
    assert force == pytest.approx([2 * 500 * 1e-3, -2 * 500 * 2e-3, 0.0], abs=1e-9)
    assert run.ticks["potential"] == pytest.approx([500 * 1e-6, 500 * 4e-6, 0.0], abs=1e-12)
    assert (run.ticks["kinetic"] == 0).all()
    assert run.ledger.slack == 0
    turned = samples_of(np.zeros((1, 3)), Rotation.from_rotvec([[0, 1e-4, 0]]))
    run = rendered("direct", COUPLING, turned, SLOT.format(half=0.02), contact_stiffness=500.0)
    # K = diag(..., K_c L²/2): each end presses on one wall
    assert run.ticks["wrench_on_tool"][0, 4] == pytest.approx(0.5 * 500 * 0.04**2 * 1e-4, rel=1e-3)


@pytest.mark.parametrize(
    ("method", "share", "verdict"),
    [
        ("direct", 0.98, "passive"),
        ("direct", 1.2, "active"),
        ("implicit", 0.98, "passive"),
        ("implicit", 1.2, "passive"),
        ("implicit", 2.0, "passive"),
    ],
)
def test_geometry_decides_for_a_massless_tool_and_not_behind_a_coupling(
    method: str, share: float, verdict: str, tmp_path: Path
) -> None:
    damping, stiffness = 2e-3, 2000.0
    limit = 2 * math.sqrt(damping / (T * stiffness))
    scene, path = tmp_path / "slot.xml", tmp_path / "run.mcap"
    scene.write_text(SLOT.format(half=0.5 * share * limit))
    options: dict[str, Any] = {"contact_stiffness": stiffness} if method == "direct" else {}
    options["is_guarded"] = False
    coupling = Coupling(stiffness, 0.5, 2.0, 5e-4)
    summary = recorded(
        path, scene, Rotor(damping), coupling, duration=0.3, method=method, limits=FREE, **options
    )
    report = audit(path)
    assert (summary.verdict, report.verdict) == (verdict, verdict)
    assert (report.tick, report.port) == (summary.fault or (None, ""))
    assert report.resimulation == "bit for bit"
    if method == "direct":
        assert report.certified is None
        assert f"{limit:.3g} m" in report.conditions[0]
    if verdict == "active":
        assert report.port == "device"


@pytest.mark.parametrize("is_moved", [False, True])
def test_a_jump_in_a_pause_does_not_hide_what_the_device_is_given(
    is_moved: bool, tmp_path: Path
) -> None:
    """1 cm in one period would burn b δp²/T = 0.2 J, which no damping in a pause has burnt."""
    scene, path, motion = (tmp_path / name for name in ("wall.xml", "run.mcap", "push.csv"))
    scene.write_text(WALL)
    motion.write_text("t,x,y,z\n0,0,0,0\n1,0.06,0,0\n4,0.06,0,0\n")
    device = SimulatedDevice(path=str(motion), force_limit=1e3)
    with Bridge(
        scene,
        device,
        COUPLING,
        method="direct",
        contact_stiffness=2e5,
        clock=SimulatedClock(),
        recording=path,
        limits=Limits(force=1e3, torque=0.5, ramp=0.0),
    ) as bridge:
        bridge.run(0.2)
        if is_moved:
            device.stepper[0]["position"][0, 1] += 0.01
        summary = bridge.run(2.0)
    report = audit(path)
    assert report.resimulation == "bit for bit"
    assert (summary.verdict, report.verdict) == ("active", "active")
    assert summary.fault == (report.tick, report.port)
    assert report.port == "device"


@pytest.mark.parametrize("timing", [None, Timing(drops=0.5, seed=0)])
def test_a_knock_or_missed_ticks_burn_nothing_that_was_not_burnt(timing: Timing | None) -> None:
    """A knock of 1 cm would count as 0.2 J burnt, far more than the device is given."""
    motion = np.zeros((3, 3))
    motion[1:, 0] = 0.06
    outcome = ClosedLoop(load(WALL)).run(
        SimulatedDevice(path=Motion([0.0, 1.0, 4.0], motion)),
        Coupling(2e5, 0.0, 0.0, 0.0),
        METHODS["direct"],
        ticks=2000,
        knock=np.array([0, 1e-2, 0, 0, 0, 0]),
        timing=timing,
    )
    assert outcome.fault is not None
    assert outcome.fault[1] == "device"


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ("virtual_wall", "free joint"),
        (SERVO.format(gravcomp=0, mocap="false", actuator=""), "other joints"),
        (
            SERVO.format(gravcomp=0, mocap="true", actuator='<motor joint="arm"/>'),
            "other joints and actuators and mocap bodies",
        ),
    ],
)
def test_massless_tool_refuses_a_scene_in_which_more_moves(scene: str, message: str) -> None:
    loaded = load(scene) if scene.lstrip().startswith("<") else load_scene(scene)
    with pytest.raises(SceneError, match=message):
        prepare(loaded, COUPLING, T, 1, method_named("direct"))


@pytest.mark.parametrize("stiffness", [0.0, -1.0, math.nan, math.inf, 1e-31, 1e308])
def test_bad_contact_stiffness_is_refused(stiffness: float) -> None:
    with pytest.raises(SceneError, match="contact stiffness"):
        Bridge("peg_in_hole", "simulated", method="direct", contact_stiffness=stiffness)


def test_contact_stiffness_belongs_to_direct_alone() -> None:
    with pytest.raises(SceneError, match="only 'direct'"):
        Bridge("peg_in_hole", "simulated", contact_stiffness=500.0)
