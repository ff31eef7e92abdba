"""Rendering methods: one interface, what each creates, what each needs, and what each refuses."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded, rewritten, without_model
from kernel_runs import T, load, samples_of, sines, unlimited, wrench_law
from rendering_runs import (
    COUPLING,
    FREE,
    FREE_MASS,
    SERVO,
    SLOT,
    TURNED_TOOL,
    WALL,
    Rotor,
    rendered,
    sway,
    waved,
)
from scipy.spatial.transform import Rotation

from hapticbridge.audit import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import default_coupling, run_conditions
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.loop_setting import required_damping
from hapticbridge.demand.methods import IMPLICIT, check_prepared, method_named, prepare
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.errors import CouplingError, DeviceError, HapticBridgeError, SceneError
from hapticbridge.kernel.codes import OK, WELD_NAME
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.lab.closed_loop import ClosedLoop, LoopOutcome, Timing
from hapticbridge.lab.methods import METHODS
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.options import BridgeOptions, Workspace
from hapticbridge.scene import load_scene
from hapticbridge.theory.rigid_body import exact_mass_response
from hapticbridge.theory.sampled_loop import WorstHand

HAZARDOUS = [name for name in METHODS if METHODS[name].hazard]
MOVED_BY = SERVO.replace("{mocap}", "false").replace("{actuator}", "{}")
PROVEN = [name for name in METHODS if METHODS[name].has_guarantee]


@pytest.mark.parametrize(
    ("name", "substeps"),
    [(n, 1) for n in METHODS]
    + [(n, 3) for n in METHODS if not method_named(n).scheme.properties.one_substep],
)
def test_compiled_advance_equals_the_python_binding(name: str, substeps: int) -> None:
    samples, method = waved(150), method_named(name)
    run = rendered(name, COUPLING, samples, TURNED_TOOL, substeps=substeps)
    scene = load(TURNED_TOOL)
    prepare(scene, COUPLING, T, substeps, method)
    binding = BoundKernel(scene.model, scene.data, run.parameters)
    for k in range(len(samples)):
        for substep in range(substeps):
            assert before_step(binding.state, samples[k : k + 1], binding.row, substep, T) == OK
            method.step(scene.model, scene.data)
            assert after_step(binding.state, binding.row, substep) == OK
        assert binding.row[0].tobytes() == run.ticks[k].tobytes()


@pytest.mark.parametrize(
    "name",
    [n for n in METHODS if METHODS[n].has_law and METHODS[n].scheme == IMPLICIT.scheme]
    + ["explicit", "explicit:implicitfast", "explicit:rk4"],
)
def test_wrench_is_the_coupling_law_at_the_recorded_poses(name: str) -> None:
    run = rendered(name, COUPLING, waved(), TURNED_TOOL)
    scale = np.abs(run.ticks["wrench_on_tool"]).max()
    assert run.ticks["wrench_on_tool"] == pytest.approx(wrench_law(run), abs=1e-11 * scale)


@pytest.mark.parametrize("name", HAZARDOUS)
def test_on_a_real_device_only_what_is_proven_goes_unasked(name: str) -> None:
    with pytest.raises(DeviceError, match="--i-know") as caught:
        Bridge("point_mass", Rotor(is_real=True), COUPLING, method=name)
    assert METHODS[name].hazard in str(caught.value)
    Bridge("point_mass", Rotor(is_real=True), COUPLING, method=name, i_know=True)
    for proven in PROVEN:
        Bridge("point_mass", Rotor(is_real=True), COUPLING, method=proven)


def test_the_help_of_the_option_describes_every_method_with_a_guarantee() -> None:
    about = str(BridgeOptions.__doc__).partition("method: ")[2].partition("contact: ")[0]
    assert [name for name in PROVEN if f"'{name}'" not in about] == []


NO_EQUALITY = '<option><flag equality="disable"/></option></mujoco>'
UNPREPARED = [
    # method, scene, message
    ("implicit", FREE_MASS.format(mass=0.05), "between 1e-30 and 1e\\+30"),
    ("direct", "virtual_wall", "free joint"),
    ("direct", SERVO.format(gravcomp=0, mocap="false", actuator=""), "other joints"),
    (
        "direct",
        SERVO.format(gravcomp=0, mocap="true", actuator='<motor joint="arm"/>'),
        "other joints and actuators and mocap bodies",
    ),
    ("weld", "virtual_wall", "1 of 6"),
    (
        "weld",
        FREE_MASS.format(mass=0.05).replace("</mujoco>", NO_EQUALITY),
        "disables flag equality, and a weld is an equality",
    ),
    # work that an integrator hides
    ("explicit:rk4", MOVED_BY.format('<motor name="m" joint="arm"/>', gravcomp=0), "'m'"),
    ("explicit:rk4", MOVED_BY.format("", gravcomp=1), "gravity compensation"),
    ("implicitfast", MOVED_BY.format('<velocity name="v" joint="arm" kv="1"/>', gravcomp=0), "'v'"),
    ("weld", MOVED_BY.format('<position name="p" joint="arm" kv="1"/>', gravcomp=0), "'p'"),
]


def test_gains_of_a_lossless_method_that_the_kernel_would_not_take_are_refused() -> None:
    with pytest.raises(HapticBridgeError, match="'lossless' has gains of its own"):
        dataclasses.replace(METHODS["lossless"], gains=METHODS["explicit"].gains)


@pytest.mark.parametrize(("method", "scene", "message"), UNPREPARED)
def test_a_scene_that_a_method_cannot_render_is_refused(
    method: str, scene: str, message: str
) -> None:
    loaded = load(scene) if scene.lstrip().startswith("<") else load_scene(scene)
    coupling = Coupling(1e300, 0, 0, 0) if method == "implicit" else COUPLING
    with pytest.raises(SceneError, match=message):
        prepare(loaded, coupling, T, 1, method_named(method))
    prepare(loaded, COUPLING, T, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "impedance"}, r"'direct', 'explicit', 'explicit:implicitfast'"),
        ({"contact_stiffness": 500.0}, "only 'direct'"),
        ({"method": "lossless", "substeps": 2}, "substeps is 2; a lossless coupling"),
        *(
            ({"method": "direct", "contact_stiffness": value}, "contact stiffness")
            for value in (0.0, -1.0, math.nan, math.inf, 1e-31, 1e308)
        ),
        *(({"substeps": n}, "substeps is .* whole number") for n in (0, 101, 1.5, math.nan)),
    ],
)
def test_an_option_that_cannot_be_is_refused_wherever_it_enters(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(HapticBridgeError, match=message):
        Bridge("peg_in_hole", "simulated", **options)
    if "substeps" in options and "method" not in options:
        with pytest.raises(CouplingError, match=message):
            required_damping(LIGHT, T, options["substeps"])
        with pytest.raises(CouplingError, match=message):
            default_coupling(SimulatedDevice().info, T, law_evaluations=options["substeps"])
        with pytest.raises(HapticBridgeError, match=message):
            ClosedLoop(load_scene("point_mass")).run(
                SimulatedDevice(), LIGHT, METHODS["implicit"], **options
            )


@pytest.mark.parametrize("method", ["explicit:rk4", "direct"])
def test_inputs_that_cannot_be_metered_are_refused(method: str) -> None:
    with Bridge("peg_in_hole", Rotor(), clock=SimulatedClock(), method=method) as bridge:
        with pytest.raises(SceneError, match="cannot meter the work of inputs"):
            bridge.set_input(body_wrench={"peg": np.zeros(6)})
        # a tool without coupling puts no condition on the device
        found = run_conditions(bridge.device.info, bridge.session.parameters, bridge.setup.method)
        assert len(found) == (0 if method == "direct" else 2)


@pytest.mark.parametrize(
    ("method", "claim"),
    [
        ("explicit", {"method": "implicit"}),
        ("implicitfast", {"method": "implicit"}),
        ("explicit", {"method": "explicit:rk4"}),
        ("weld", {"effective": "[1.0, 0.0, 0.0, 0.0]"}),
    ],
)
def test_recording_that_claims_another_method_or_a_softer_weld_is_invalid(
    method: str, claim: dict[str, str], tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, "point_mass", "simulated", duration=0.1, method=method)
    report = audit(rewritten(read_recording(path), tmp_path / "b.mcap", meta=claim))
    assert report.verdict == "invalid"
    assert method != "weld" or "weld" in report.reason


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


def test_created_energies_of_one_free_mass_are_those_of_the_theory() -> None:
    """K = 2000, B = 2, 50 g, 3 Hz for 2 s: none, 0.29 J for actuators that miss the position."""
    samples = sway()
    for name in ("implicit", "implicitfast:compensated"):
        run = rendered(name, COUPLING, samples)
        assert run.ticks["environment_energy"].max() <= 0
        assert run.ledger.environment == "strict"
    run = rendered("implicitfast", COUPLING, samples)
    assert run.ticks["environment_energy"].max() == pytest.approx(0.29, abs=0.005)
    assert run.ledger.environment != "strict"


@pytest.mark.parametrize("substeps", [1, 4])
def test_compensated_implicitfast_is_implicit_away_from_contact(substeps: int) -> None:
    samples = sway(500)
    implicit = rendered("implicit", COUPLING, samples, substeps=substeps)
    compensated = rendered("implicitfast:compensated", COUPLING, samples, substeps=substeps)
    plain = rendered("implicitfast", COUPLING, samples, substeps=substeps)
    expected = implicit.ticks["tool_position"]
    assert compensated.ticks["tool_position"] == pytest.approx(expected, abs=1e-14)
    assert np.abs(plain.ticks["tool_position"] - expected).max() > 1e-5


@pytest.mark.parametrize("mass", [0.02, 0.05, 1.0])
def test_held_force_creates_half_m_dv_squared_a_step(mass: float) -> None:
    """Σ E_k = Σ_{i<k} T² f_i²/(2 m) − f_k·δx_k: the last wrench has not acted yet."""
    run = rendered("explicit", COUPLING, sway(500), FREE_MASS.format(mass=mass))
    force = run.ticks["wrench_on_tool"][:, 0]
    created = np.concatenate([[0.0], np.cumsum((T * force) ** 2 / (2 * mass))[:-1]])
    expected = created - force * run.tool_steps()[:, 0]
    assert run.ticks["environment_energy"] == pytest.approx(
        expected, abs=1e-12 * np.abs(expected).max() + 1e-13
    )
    velocity = run.tool_steps()[:, 0] / T
    assert mass * np.diff(velocity) == pytest.approx(T * force[:-1], abs=1e-11)


def test_held_force_under_rk4_is_the_exact_hold() -> None:
    run = rendered("explicit:rk4", COUPLING, sway(500))
    force, steps = run.ticks["wrench_on_tool"][:, 0], run.tool_steps()[:, 0]
    # x_{k+1} − 2 x_k + x_{k−1} = T² (f_k + f_{k−1}) / (2 m)
    expected = T**2 * (force[1:-1] + force[:-2]) / (2 * 0.05)
    assert np.diff(steps)[1:] == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("name", ["explicit", "explicit:implicitfast", "explicit:rk4"])
def test_held_force_diverges_on_a_light_tool_where_implicit_is_strict(name: str) -> None:
    """Under Euler below m = (T/2)(KT/2 + B) = 1.5 g."""
    light = FREE_MASS.format(mass=0.001)
    failed = rendered(name, COUPLING, sway(300), light)
    assert len(failed.ticks) < 300  # stopped as no longer finite
    fault = failed.ledger.fault
    assert fault is not None
    assert fault[1] == "environment"
    safe = rendered("implicit", COUPLING, sway(300), light)
    assert safe.ledger.environment == "strict"
    for mass, is_bounded in ((0.00140, False), (0.00165, True)) if name == "explicit" else ():
        run = rendered(name, COUPLING, sway(2000), FREE_MASS.format(mass=mass))
        assert (len(run.ticks) == 2000) == is_bounded


@pytest.mark.parametrize(("name", "mass"), [("implicitfast", 0.002), ("explicit:rk4", 0.004)])
def test_meter_and_audit_name_the_tick_at_which_energy_was_created(
    name: str, mass: float, tmp_path: Path
) -> None:
    loose = Coupling(2000.0, 0.0, 2.0, 0.0)

    def swing(tick: int) -> tuple[float, ...]:
        return (0.02 * math.sin(0.02 * tick), 0, 0, 1, 0, 0, 0)

    scene = tmp_path / "light.xml"
    scene.write_text(FREE_MASS.format(mass=mass))
    reports = {}
    for method in (name, "implicit"):
        path = tmp_path / f"{method.replace(':', '_')}.mcap"
        device = ScriptedDevice(swing, strength=200.0)
        summary = recorded(path, scene, device, loose, duration=0.15, method=method, limits=FREE)
        reports[method] = audit(path)
        found = (reports[method].tick, reports[method].port)
        assert found == (summary.fault or (None, ""))
        assert reports[method].resimulation == "bit for bit"
    assert reports[name].verdict == "active"
    assert reports[name].port == "environment"
    assert f"tick {reports[name].tick}" in reports[name].reason
    assert (reports["implicit"].verdict, reports["implicit"].environment) == ("passive", "strict")


@pytest.mark.parametrize("method", ["explicit", "explicit:implicitfast", "implicitfast"])
def test_ports_of_a_separate_arm_close_to_its_dissipation(method: str) -> None:
    """A motor and an applied force on an arm apart: Σ E is what the step leaves, −½m(Δv)²."""
    scene = load(SERVO.format(gravcomp=0, mocap="false", actuator='<motor name="m" joint="arm"/>'))
    chosen = method_named(method)
    prepare(scene, COUPLING, T, 1, chosen)
    parameters = unlimited(scene, COUPLING, scheme=chosen.scheme)
    binding = BoundKernel(scene.model, scene.data, parameters)
    still, left, speed = samples_of(np.zeros((1, 3))), 0.0, 0.0
    for k in range(200):
        scene.data.ctrl[0 if scene.model.actuator(0).name == "m" else -1] = 0.0
        scene.data.ctrl[scene.model.actuator_ctrladr[scene.model.actuator("m").id]] = math.sin(k)
        scene.data.qfrc_applied[6] = math.cos(0.1 * k)
        assert before_step(binding.state, still, binding.row, 0, T) == OK
        chosen.step(scene.model, scene.data)
        assert after_step(binding.state, binding.row, 0) == OK
        left -= 0.1 * (scene.data.qvel[6] - speed) ** 2
        speed = float(scene.data.qvel[6])
    assert binding.state["energy"]["environment_energy"][0] == pytest.approx(left, rel=1e-9)
    assert abs(binding.state["energy"]["actuator_work"][0]) > 1e-5
    assert abs(binding.state["energy"]["external_work"][0]) > 1e-5


@pytest.mark.parametrize("substeps", [1, 2, 4, 8])
def test_free_mass_follows_implicit_euler_and_the_mean_wrench_does_the_work_of_all(
    substeps: int,
) -> None:
    """So a free mass is strict: Σ E = −Σ ½ m (Δv)², step by step, whatever the substeps."""
    run = rendered("implicit", COUPLING, sway(500), substeps=substeps)
    assert run.ticks["environment_energy"].max() <= 0
    assert run.ledger.environment == "strict"
    handle = run.handle_steps()[:, 0] / substeps
    mass, h = 0.05, T / substeps
    x = v = position = work_on_handle = 0.0
    for k in range(500):
        for _ in range(substeps):
            position += handle[k]
            # m (v⁺ − v)/h = K (p − x − h v⁺) + B (δp/h − v⁺)
            k_, b_ = COUPLING.stiffness, COUPLING.damping
            v = (mass * v / h + k_ * (position - x) + b_ * handle[k] / h) / (mass / h + k_ * h + b_)
            x += h * v
            work_on_handle += (k_ * (position - x) + b_ * (handle[k] / h - v)) * handle[k]
    assert run.ticks["tool_position"][-1, 0] == pytest.approx(x, abs=1e-12)
    sent = np.sum(run.ticks["wrench_on_tool"][:, 0] * run.handle_steps()[:, 0])
    assert sent == pytest.approx(work_on_handle, rel=1e-9)


def test_needed_damping_with_one_law_is_that_of_the_theory_and_grows_with_the_delay() -> None:
    assert required_damping(COUPLING, T) == pytest.approx(3.0, rel=1e-12)
    undamped = Coupling(2000.0, 0.0, 2.0, 0.0)
    needed = [required_damping(undamped, T, n) for n in (1, 2, 4, 8)]
    # s = 1/2 of the slack may be used; strictly it would be K T n / 2
    assert needed == pytest.approx([1.0, 2.5, 6.25, 14.125], rel=1e-4)
    damped = Coupling(2000.0, 2.0, 2.0, 2e-3)
    assert [required_damping(damped, T, n) for n in (2, 4, 8)] == pytest.approx(
        [2.6429, 2.4423, 2.3350], abs=1e-4
    )
    assert required_damping(damped, T, 4, "rotation") == pytest.approx(2.4423e-3, abs=1e-7)


@pytest.mark.parametrize(
    ("method", "substeps"), [("direct", 1), ("weld", 1), ("implicit", 4), ("implicit", 1)]
)
def test_what_only_a_resimulation_confirms_is_not_called_passive_without_one(
    method: str, substeps: int, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, "point_mass", duration=0.1, method=method, substeps=substeps)
    known = audit(path)
    assert known.verdict == "passive"
    if substeps > 1:  # a mean leaves the law unchecked
        assert (known.resimulation, known.unchecked != "") == ("bit for bit", True)
        assert "re-simulation alone" in known.unchecked
    assert method != "implicit" or substeps > 1 or known.unchecked == ""
    bare = rewritten(without_model(read_recording(path)), tmp_path / "bare.mcap")
    report = audit(bare)
    assert (report.verdict, report.exit_code) == ("unverified", 1)
    assert "not re-simulated" in report.resimulation
    assert "not re-simulated" in report.reason


def test_wrench_of_the_weld_is_what_moves_the_tool() -> None:
    method, samples = method_named("weld"), waved()
    scene = load(TURNED_TOOL)
    felt = prepare(scene, COUPLING, T, 1, method)
    run = rendered("weld", COUPLING, samples, TURNED_TOOL)
    assert felt == run.parameters.effective
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


def test_weld_carries_over_what_was_changed_in_the_scenes_own_constraints() -> None:
    own = '<equality><weld name="own" body1="tool" body2="world" active="false"/></equality>'
    text = FREE_MASS.format(mass=0.05).replace("</mujoco>", own + "</mujoco>")
    scene = load(text)
    scene.model.eq_solref[0] = 0.05, 0.7
    scene.model.eq_data[0, 0] = 0.25
    scene.model.body_mass[scene.model.body("tool").id] = 0.2
    mujoco.mj_setConst(scene.model, scene.data)
    inertia = scene.model.stat.meaninertia
    scene.model.opt.gravity[:] = 0, 0, -1
    for method, count in (("weld", 2), ("implicit", 1)):
        felt = prepare(scene, COUPLING, T, 1, method_named(method))
        assert scene.model.opt.gravity.tolist() == [0, 0, -1]
        assert scene.model.body_mass[scene.model.body("tool").id] == 0.2
        assert (felt is None) == (method == "implicit")
        assert scene.model.neq == count
        assert scene.model.equality("own").solref.tolist() == [0.05, 0.7]
        assert scene.model.equality("own").data[0] == 0.25
        assert scene.model.stat.meaninertia == inertia
        if felt is not None:
            assert felt.stiffness == pytest.approx(0.2 * 2000 / 0.05, rel=1e-6)
            assert scene.model.equality(WELD_NAME).solref.tolist() == [-2000, -2]


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


@pytest.mark.parametrize(("method", "verdict"), [("weld", "active"), ("implicit", "passive")])
def test_weld_kicks_a_device_that_bears_the_coupling_asked_for(
    method: str, verdict: str, tmp_path: Path
) -> None:
    """The tool's inertia makes it I K d = 6.8 N m/rad to a free tool; 1 was asked, 4 is borne."""
    scene, path = tmp_path / "ball.xml", tmp_path / "run.mcap"
    scene.write_text(FREE_MASS.format(mass=1.0).replace("0.01", "0.03"))
    coupling = Coupling(2e4, 0.5, 1.0, 5e-4)
    options: dict[str, Any] = {"limits": FREE, "is_guarded": False}
    # later the torque passes the limit, which a weld knows nothing of
    summary = recorded(path, scene, Rotor(), coupling, duration=0.016, method=method, **options)
    report = audit(path)
    assert (summary.verdict, report.verdict) == (verdict, verdict)
    assert report.resimulation == "bit for bit"
    assert report.certified is (method == "implicit")
    assert report.environment == "strict"  # (14) alone would not have seen it
    if method == "weld":
        assert summary.coupling.law is None
        assert summary.coupling.effective is not None
        stiffness = summary.coupling.effective.rotational_stiffness
        assert stiffness == pytest.approx(3.6e-4 * 2e4 / 0.05, rel=1e-6)
        assert (report.tick, report.port) == summary.fault
        assert report.port == "device"
        assert "no coupling law" in report.unchecked
    else:
        assert (report.port, report.unchecked) == ("", "")


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
    felt = run.parameters.effective
    assert felt is not None
    largest = 0.1 / 3 * (0.05**2 + 0.005**2)
    assert felt.rotational_stiffness == pytest.approx(largest * 2000 / 0.05, rel=1e-6)
    assert felt.rotational_damping == pytest.approx(largest * 2 / 0.05, rel=1e-6)


LIGHT = Coupling(2400.0, 0.5, 2.4, 5e-4)
KNOCK = np.array([1e-4, 0, 0, 0, 0, 0])
RIGID = math.inf
ANGLES = np.geomspace(3e-3, np.pi, 800)


def response(angle: float, laws: int, mass: float) -> complex:
    """Force on a device per displacement, from the n steps of a tick written as one matrix."""
    z = np.exp(1j * angle)
    handle = 1 - np.arange(laws - 1, -1, -1) / laws * (1 - 1 / z)
    difference = np.eye(laws) - np.eye(laws, k=-1) + 0j
    difference[0, -1] -= 1 / z
    law = LIGHT.stiffness * np.eye(laws) + LIGHT.damping * laws / T * difference
    tool = np.zeros(laws, dtype=complex)
    if mass < RIGID:
        inertia = mass * (laws / T) ** 2 * difference @ difference
        tool = np.linalg.solve(inertia + law, law @ handle)
    return complex((law @ (handle - tool)).mean())


def worst(laws: int, mass: float) -> tuple[float, float]:
    """Returns the largest b = (T/2) (Re H − Im H cot(θ/2)) and its θ."""
    found = []
    for angle in ANGLES:
        felt = response(angle, laws, mass)
        found.append(T / 2 * (felt.real - felt.imag / math.tan(angle / 2)))
    i = int(np.argmax(found))
    return found[i], float(ANGLES[i])


@pytest.mark.parametrize(("laws", "percent"), [(1, 0.089), (2, 0.044), (4, 0.022)])
def test_error_of_a_free_mass_falls_with_the_number_of_substeps(laws: int, percent: float) -> None:
    """1 kg moved at 2 Hz, against the mass behind an unsampled coupling, when it has settled."""
    frequency, amplitude, ticks, window = 2.0, 0.01, 30_000, 5000
    run = rendered(
        "implicit",
        LIGHT,
        sway(ticks, amplitude, frequency),
        FREE_MASS.format(mass=1.0),
        substeps=laws,
    )
    time = T * np.arange(ticks - window + 1, ticks + 1)
    wave = np.exp(2j * np.pi * frequency * time)
    position = run.ticks["tool_position"][-window:, 0]
    measured = 2j * np.mean(position / wave) / amplitude
    exact = complex(exact_mass_response(LIGHT, 1.0, frequency))
    assert 100 * abs(measured / exact - 1) == pytest.approx(percent, rel=0.1)


def test_strict_environments_need_less_than_the_form_grants() -> None:
    needed = [required_damping(LIGHT, T, n) for n in (1, 2, 4, 8)]
    assert needed == pytest.approx([1.70, 1.63, 1.90, 2.42], abs=6e-3)  # what is printed
    for laws, granted in zip((1, 2, 4, 8), needed, strict=True):
        found = max(worst(laws, mass)[0] for mass in (RIGID, 1.0, 0.2, 0.05, 0.02, 0.01))
        assert 0.75 * granted < found <= granted * (1 + 1e-9)


@pytest.mark.parametrize(("laws", "mass"), [(4, 0.05), (8, 0.05)])
def test_worst_hand_behind_substeps_diverges_below_the_limit_and_not_above(
    laws: int, mass: float
) -> None:
    limit, angle = worst(laws, mass)
    scene = load_scene("point_mass")
    body = scene.model.site_bodyid[scene.model.site("grip").id]
    scene.model.body_mass[body] = mass
    mujoco.mj_setConst(scene.model, scene.data)
    loop = ClosedLoop(scene)

    def run(damping: float) -> LoopOutcome:
        hand = WorstHand(damping, angle / T, T, response(angle, laws, mass))
        return loop.run(
            SimulatedDevice(hand=hand),
            Coupling(LIGHT.stiffness, LIGHT.damping, 0.0, 0.0),
            METHODS["implicit"],
            substeps=laws,
            ticks=4000,
            knock=KNOCK,
        )

    below, above = run(0.9 * limit), run(1.05 * limit)
    assert (below.is_stable, above.is_stable) == (False, True)
    assert below.environment == above.environment == "strict"
    assert run(required_damping(LIGHT, T, laws)).is_stable
