"""A weld: how stiff it truly is, what it does to a device, and what it carries over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import recorded, rewritten
from kernel_runs import T, load
from rendering_runs import (
    COUPLING,
    FREE,
    FREE_MASS,
    TURNED_TOOL,
    Rotor,
    rendered,
    waved,
)

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.errors import SceneError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.lab.methods import METHODS
from hapticbridge.options import Workspace
from hapticbridge.recording import read_recording
from hapticbridge.rendering import (
    check_prepared,
    method_named,
    prepare,
)
from hapticbridge.scene import load_scene


def test_wrench_of_the_weld_is_what_moves_the_tool() -> None:
    method, samples = method_named("weld"), waved()
    scene = load(TURNED_TOOL)
    felt = prepare(scene, COUPLING, T, 1, method)
    run = rendered("weld", COUPLING, samples, TURNED_TOOL)
    assert felt == run.parameters.felt
    model, data = scene.model, scene.data
    binding = BoundKernel(model, data, run.parameters)
    jacobian = np.zeros((6, model.nv))
    for k in range(len(samples)):
        assert before_step(binding.state, samples[k : k + 1], binding.row, 0, T) == OK
        mujoco.mj_step(model, data)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("grip").id)
        on_joints = data.qfrc_constraint.copy()
        assert after_step(binding.state, binding.row, 0) == OK
        given = jacobian.T @ binding.row["wrench_on_tool"][0]
        assert given == pytest.approx(on_joints, abs=1e-12)
    assert np.abs(on_joints).max() > 1e-3


@pytest.mark.parametrize("mass", [0.05, 1.0])
@pytest.mark.parametrize("stiffness", [500.0, 2000.0])
def test_true_stiffness_of_a_weld_is_mass_times_k_over_one_minus_d(
    mass: float, stiffness: float
) -> None:
    """So a 1 N pull displaces 1 kg behind a 'stiffness' of 1000 by 0.05 mm, not by 1 mm."""
    coupling = Coupling(stiffness, 40.0, 1.0, 1e-3)
    scene = load(FREE_MASS.format(mass=mass))
    felt = prepare(scene, coupling, T, 1, method_named("weld"))
    assert felt is not None
    assert felt.stiffness == pytest.approx(mass * stiffness / 0.05, rel=1e-6)
    assert felt.damping == pytest.approx(mass * 40.0 / 0.05, rel=1e-6)
    inertia = 0.4 * mass * 0.01**2
    assert felt.rotational_stiffness == pytest.approx(inertia * stiffness / 0.05, rel=1e-6)
    body = scene.model.body("tool").id
    for axis, expected in ((0, felt.stiffness), (5, felt.rotational_stiffness)):
        scene.reset()
        scene.data.xfrc_applied[body, axis] = 1e-2 * expected  # less is below the solver's grain
        for _ in range(4000):
            mujoco.mj_step(scene.model, scene.data)
        moved = scene.data.qpos[0] if axis == 0 else 2 * scene.data.qpos[6]
        assert moved == pytest.approx(1e-2, rel=2e-4)


def test_weld_carries_changes_over_and_comes_off_again() -> None:
    scene = load(FREE_MASS.format(mass=0.05))
    scene.model.body_mass[scene.model.body("tool").id] = 0.2
    mujoco.mj_setConst(scene.model, scene.data)
    scene.model.opt.gravity[:] = 0, 0, -1
    plain = scene.model
    felt = prepare(scene, COUPLING, T, 1, method_named("weld"))
    assert felt is not None
    assert felt.stiffness == pytest.approx(0.2 * 2000 / 0.05, rel=1e-6)
    assert scene.model.opt.gravity.tolist() == [0, 0, -1]
    assert scene.model.neq == 1
    assert prepare(scene, COUPLING, T, 1) is None
    assert scene.model.neq == 0
    assert (scene.model.body_mass == plain.body_mass).all()


def test_weld_carries_over_what_was_changed_in_the_scenes_own_constraints() -> None:
    own = '<equality><weld name="own" body1="tool" body2="world" active="false"/></equality>'
    text = FREE_MASS.format(mass=0.05).replace("</mujoco>", own + "</mujoco>")
    scene = load(text)
    scene.model.eq_solref[0] = 0.05, 0.7
    scene.model.eq_data[0, 0] = 0.25
    scene.model.body_mass[scene.model.body("tool").id] = 0.2
    mujoco.mj_setConst(scene.model, scene.data)
    inertia = scene.model.stat.meaninertia
    for method, count in (("weld", 2), ("implicit", 1)):
        prepare(scene, COUPLING, T, 1, method_named(method))
        assert scene.model.neq == count
        assert scene.model.equality("own").solref.tolist() == [0.05, 0.7]
        assert scene.model.equality("own").data[0] == 0.25
        assert scene.model.stat.meaninertia == inertia
        if method == "weld":
            assert scene.model.equality("handle_weld").solref.tolist() == [-2000, -2]


@pytest.mark.parametrize("flag", ["constraint", "equality"])
def test_a_weld_is_refused_where_the_scene_disables_what_it_is_made_of(flag: str) -> None:
    option = f'<option><flag {flag}="disable"/></option>'
    scene = load(FREE_MASS.format(mass=0.05).replace("</mujoco>", option + "</mujoco>"))
    with pytest.raises(SceneError, match=f"disables flag {flag}, and a weld is an equality"):
        prepare(scene, COUPLING, T, 1, method_named("weld"))
    prepare(scene, COUPLING, T, 1, method_named("implicit"))


def test_a_device_that_bears_a_weld_is_still_not_called_certified() -> None:
    """Nothing proves b >= KT/2 + B enough for it; where that fails, it is refuted."""
    text = FREE_MASS.format(mass=0.01)
    for stiffness, expected in ((10.0, None), (1e6, False)):
        with Bridge(
            load(text),
            Rotor(damping=1.0),
            Coupling(stiffness, 0.0, 0.0, 0.0),
            clock=SimulatedClock(),
            method="weld",
        ) as bridge:
            assert bridge.run(0.01).is_certified is expected
            assert len(bridge.conditions()) == 2


def test_model_with_another_weld_than_its_method_wants_is_refused() -> None:
    scene = load(FREE_MASS.format(mass=0.05))
    run = rendered("implicitfast", COUPLING, waved(2), scene)
    welded = rendered("weld", COUPLING, waved(2), FREE_MASS.format(mass=0.05))
    check_prepared(scene.model, run.parameters, METHODS["implicitfast"])
    check_prepared(welded.scene.model, welded.parameters, METHODS["weld"])
    with pytest.raises(SceneError, match="weld to the handle"):
        check_prepared(scene.model, welded.parameters, METHODS["weld"])
    with pytest.raises(SceneError, match="weld to the handle"):
        check_prepared(welded.scene.model, run.parameters, METHODS["implicitfast"])


@pytest.mark.parametrize("method", ["weld", "direct"])
def test_meter_and_audit_scale_alike_what_the_scene_gives_up(method: str, tmp_path: Path) -> None:
    """Force returns half as large for a handle that moves thrice as far: gained times 1/6."""
    path = tmp_path / "run.mcap"
    options: dict[str, Any] = {"contact_stiffness": 2e4} if method == "direct" else {}
    options |= {"method": method, "workspace": Workspace(scale=3.0, force_scale=0.5)}
    summary = recorded(path, "peg_in_hole", "simulated", duration=1.6, **options)
    report = audit(path)
    assert report.resimulation == "bit for bit"
    assert (report.tick, report.port) == (summary.fault or (None, ""))


def test_weld_refuses_a_tool_whose_joints_block_an_axis() -> None:
    with pytest.raises(SceneError, match="1 of 6"):
        prepare(load_scene("virtual_wall"), COUPLING, T, 1, method_named("weld"))


@pytest.mark.parametrize(("method", "verdict"), [("weld", "active"), ("implicit", "passive")])
def test_weld_kicks_a_device_that_bears_the_coupling_asked_for(
    method: str, verdict: str, tmp_path: Path
) -> None:
    """The tool's inertia makes it I K d = 6.8 N m/rad to a free tool; 1 was asked, 4 is borne."""
    scene, path = tmp_path / "ball.xml", tmp_path / "run.mcap"
    scene.write_text(FREE_MASS.format(mass=1.0).replace("0.01", "0.03"))
    coupling = Coupling(2e4, 0.5, 1.0, 5e-4)
    options: dict[str, Any] = {"limits": FREE, "is_guarded": False}
    summary = recorded(path, scene, Rotor(), coupling, duration=0.3, method=method, **options)
    report = audit(path)
    assert (summary.verdict, report.verdict) == (verdict, verdict)
    assert report.resimulation == "bit for bit"
    assert report.certified is (method == "implicit")
    assert report.environment == "strict"  # (14) alone would not have seen it
    if method == "weld":
        assert summary.effective is not None
        assert summary.effective.rotational_stiffness == pytest.approx(
            3.6e-4 * 2e4 / 0.05, rel=1e-6
        )
        assert (report.tick, report.port) == summary.fault
        assert report.port == "device"
        assert "constraint force" in report.unchecked
    else:
        assert (report.port, report.unchecked) == ("", "")


def test_meter_and_audit_agree_on_the_tick_of_a_kick_in_all_directions(tmp_path: Path) -> None:
    """The shipped peg behind a weld of 4800 N/m, on a device of 2 N s/m: it bears 4000."""
    path = tmp_path / "run.mcap"
    summary = recorded(path, "peg_in_hole", "simulated", duration=1.6, method="weld")
    report = audit(path)
    assert report.verdict == "active"
    assert summary.fault == (report.tick, report.port)
    assert report.port == "device"


FREE_MASS_AND_MOCAP = FREE_MASS.replace(
    '<body name="tool"', '<body name="far" mocap="true" pos="0 1 0"/><body name="tool"'
)


def test_moved_mocap_body_that_touches_nothing_does_no_work_under_a_weld(tmp_path: Path) -> None:
    """The handle's own weld is the coupling's port, not the external one."""
    scene = tmp_path / "far.xml"
    scene.write_text(FREE_MASS_AND_MOCAP.format(mass=0.1))
    summaries = [
        recorded(
            tmp_path / f"{is_moved}.mcap",
            scene,
            duration=0.3,
            method="weld",
            on_tick=(lambda bridge, k: bridge.set_input(mocap={"far": [0, 1 + 1e-4 * k, 0]}))
            if is_moved
            else None,
        )
        for is_moved in (False, True)
    ]
    still, moved = summaries
    assert moved.energies["coupling_work"] != 0
    assert moved.energies["external_work"] == 0
    assert moved.energies == still.energies


def test_weld_affords_no_slack_and_is_told_by_its_stiffest_axis() -> None:
    """No coupling law, so no proof that would afford one; the device must bear the largest."""
    flat = FREE_MASS.format(mass=0.1).replace(
        'type="sphere" size="0.01"', 'type="box" size="0.05 0.005 0.005"'
    )
    run = rendered("weld", COUPLING, waved(50), flat)
    assert run.ledger.slack == 0
    felt = run.parameters.felt
    assert felt is not None
    largest = 0.1 / 3 * (0.05**2 + 0.005**2)
    assert felt.rotational_stiffness == pytest.approx(largest * 2000 / 0.05, rel=1e-6)
    assert felt.rotational_damping == pytest.approx(largest * 2 / 0.05, rel=1e-6)


def test_recording_that_claims_a_softer_weld_is_invalid(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, "point_mass", "simulated", duration=0.1, method="weld")
    recording = read_recording(path)
    changed = rewritten(recording, tmp_path / "b.mcap", meta={"felt": "[1.0, 0.0, 0.0, 0.0]"})
    assert "weld" in audit(changed).reason
    assert audit(changed).verdict == "invalid"
