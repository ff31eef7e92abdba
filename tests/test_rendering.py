"""Every method goes through one interface, one record and one audit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import recorded, rewritten
from kernel_runs import T, live, load, wrench_law
from rendering_runs import (
    COUPLING,
    FREE_MASS,
    TURNED_TOOL,
    Rotor,
    rendered,
    waved,
)

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import DeviceError, HapticBridgeError, SceneError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step
from hapticbridge.lab.methods import METHODS
from hapticbridge.recording import read_recording
from hapticbridge.rendering import (
    IMPLICIT,
    method_named,
    prepare,
)

HAZARDOUS = [name for name in METHODS if METHODS[name].hazard]
PROVEN = ("implicit", "compensated", "lossless")


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_recorded_and_simulated_again_bit_for_bit(
    name: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    scene = "peg_in_hole" if name != "weld" else "point_mass"
    summary = recorded(path, scene, "simulated", duration=0.4, method=name)
    report, meta = audit(path), read_recording(path).meta
    assert report.resimulation == "bit for bit"
    assert meta["method"] == summary.method == name
    assert (report.verdict, report.environment) == (summary.verdict, summary.environment)
    assert report.certified == summary.is_certified
    assert report.conditions == summary.conditions


@pytest.mark.parametrize(
    ("name", "substeps"),
    [(n, 1) for n in METHODS] + [(n, 3) for n in METHODS if n not in {"direct", "lossless"}],
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


def test_prepare_without_a_method_is_the_default_one() -> None:
    samples = waved()
    run = rendered("implicit", COUPLING, samples, TURNED_TOOL)
    assert run.ticks.tobytes() == live(TURNED_TOOL, samples, COUPLING).ticks.tobytes()


@pytest.mark.parametrize(
    "name",
    [n for n in METHODS if METHODS[n].has_law and METHODS[n].scheme == IMPLICIT.scheme]
    + ["explicit", "explicit:implicitfast", "explicit:rk4"],
)
def test_wrench_is_the_coupling_law_at_the_recorded_poses(name: str) -> None:
    run = rendered(name, COUPLING, waved(), TURNED_TOOL)
    scale = np.abs(run.ticks["wrench_on_tool"]).max()
    assert run.ticks["wrench_on_tool"] == pytest.approx(wrench_law(run), abs=1e-11 * scale)


def test_unknown_method_lists_those_that_exist() -> None:
    with pytest.raises(SceneError, match=r"'direct', 'explicit', 'explicit:implicitfast'"):
        method_named("impedance")


@pytest.mark.parametrize("name", HAZARDOUS)
def test_on_a_real_device_only_what_is_proven_goes_unasked(name: str) -> None:
    with pytest.raises(DeviceError, match="--i-know") as caught:
        Bridge("point_mass", Rotor(is_real=True), COUPLING, method=name)
    assert METHODS[name].hazard in str(caught.value)
    Bridge("point_mass", Rotor(is_real=True), COUPLING, method=name, i_know=True)
    assert name not in PROVEN
    for proven in PROVEN:
        Bridge("point_mass", Rotor(is_real=True), COUPLING, method=proven)


@pytest.mark.parametrize("name", ["weld", "implicit", "explicit"])
def test_stiffness_beyond_all_magnitudes_is_refused(name: str) -> None:
    with pytest.raises(SceneError, match="between 1e-30 and 1e\\+30"):
        prepare(load(FREE_MASS.format(mass=0.05)), Coupling(1e300, 0, 0, 0), T, 1, METHODS[name])


@pytest.mark.parametrize(
    ("method", "claimed"),
    [("explicit", "implicit"), ("implicitfast", "implicit"), ("explicit", "explicit:rk4")],
)
def test_recording_that_claims_another_method_is_invalid(
    method: str, claimed: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, "point_mass", "simulated", duration=0.1, method=method)
    changed = rewritten(read_recording(path), tmp_path / "b.mcap", meta={"method": claimed})
    assert audit(changed).verdict == "invalid"


def test_parameters_that_contradict_each_other_are_refused() -> None:
    common: dict[str, Any] = {
        "grip": "grip",
        "period": T,
        "substeps": 1,
        "coupling": COUPLING,
        "force_limit": 1.0,
        "torque_limit": 1.0,
        "ramp_ticks": 0,
        "device_origin": (0, 0, 0, 1, 0, 0, 0),
        "handle_origin": (0, 0, 0, 1, 0, 0, 0),
        "device_start": (0, 0, 0, 1, 0, 0, 0),
    }
    direct = METHODS["direct"].scheme
    with pytest.raises(HapticBridgeError, match="scheme is 7"):
        RunParameters(**common, scheme=7)
    with pytest.raises(HapticBridgeError, match=r"contact stiffness is 0\.0"):
        RunParameters(**common, scheme=direct)
    with pytest.raises(HapticBridgeError, match=r"contact stiffness is 5\.0"):
        RunParameters(**common, contact_stiffness=5.0)
    with pytest.raises(HapticBridgeError, match="substeps is 2"):
        RunParameters(**(common | {"substeps": 2}), scheme=direct, contact_stiffness=5.0)


def test_fake_real_device_needs_its_own_flag_in_its_sheet() -> None:
    info: DeviceInfo = Rotor(is_real=True).info
    assert info.is_real
    assert DeviceInfo.from_json(info.to_json()) == info
