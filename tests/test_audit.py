from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import (
    COMPONENTS,
    ScriptedDevice,
    recorded,
    rewritten,
    tapped,
    without_model,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.audit import AuditReport, audit
from hapticbridge.audit.balance import Balance, turn_between
from hapticbridge.bridge import Bridge
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.errors import RecordingError, SafetyTrip
from hapticbridge.provenance import (
    MODEL_ATTACHMENT,
    STARTS,
    STATE_ATTACHMENT,
    meta_start,
    parameters_of,
    processor,
    versions,
)
from hapticbridge.recording import Recording, read_recording, repair
from hapticbridge.recording.format import Digest
from hapticbridge.scene import scene_names
from hapticbridge.scene.library import scene_path
from hapticbridge.tick import CLOCK_FIELDS, TICK_DTYPE, TickFlag

AUDIT = Path(__file__).resolve().parent.parent / "hapticbridge" / "audit"

DEVICE_POSE = ("device_position", "device_quaternion")

# A device pose matters only as far as it moves the handle. The handle's coordinates reach 0.05 m,
# where doubles are 7e-18 m apart: below that a changed device pose is another honest run's.
LEAST_DEVICE_CHANGE = 2e-17

SIZES = st.sampled_from([10.0**-exponent for exponent in range(-1, 13)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("audit")


@pytest.fixture(scope="module")
def tap(folder: Path) -> Recording:
    """A peg in contact, tilted and off centre."""
    return read_recording(tapped(folder))


@pytest.fixture(scope="module")
def held(folder: Path) -> Recording:
    """The same with a device in a hand, whose motion answers to the force."""
    path = folder / "held.mcap"
    motion = folder / "tap.csv"
    tapped(folder)
    recorded(path, device=f"simulated:path={motion}", duration=0.2)
    return read_recording(path)


def swing(tick: int) -> tuple[float, ...]:
    angle = 2 * np.pi * 3e-3 * tick
    return (0.02 * np.sin(angle), 0.01 * (1 - np.cos(angle)), 0, 1, 0, 0, 0)


LOOSE = Coupling(stiffness=2000, damping=0.2, rotational_stiffness=2, rotational_damping=5e-4)


def energy_by_hand(recording: Recording) -> tuple[NDArray[Any], NDArray[Any]]:
    """Created energy and slack from the records alone, rotations by SciPy."""
    ticks, meta = recording.ticks, recording.meta
    start = json.loads(meta["tool_start"])
    path = np.vstack([start[:3], ticks["tool_position"]])
    turned = Rotation.from_quat(np.vstack([start[3:], ticks["tool_quaternion"]]), scalar_first=True)
    moved, turn = np.diff(path, axis=0), (turned[1:] * turned[:-1].inv()).as_rotvec()
    f = ticks["wrench_on_tool"]
    work = np.cumsum((f[:, :3] * moved).sum(1) + (f[:, 3:] * turn).sum(1))
    stored = ticks["kinetic"] + ticks["potential"]
    stored = stored - float(meta["start_kinetic"]) - float(meta["start_potential"])
    period = float(meta["period_s"])
    linear = float(meta["stiffness"]) + float(meta["damping"]) / period
    angular = float(meta["rotational_stiffness"]) + float(meta["rotational_damping"]) / period
    slack = np.cumsum(linear * (moved**2).sum(1) / 2 + angular * (turn**2).sum(1) / 2)
    return stored - work - ticks["actuator_work"] - ticks["external_work"], slack


# --- honest runs


@pytest.mark.parametrize("scene", scene_names())
def test_shipped_scenes_are_passive_on_the_simulated_device(scene: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    motion = scene_path(scene).with_suffix(".csv")
    summary = recorded(path, scene, f"simulated:path={motion}", duration=3.0)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    assert report.environment in ("strict", "within slack")
    if scene == "point_mass":
        assert report.environment == "strict"
    assert report.certified is True
    assert report.exit_code == 0
    assert report.ticks == 3000
    assert report.duration == pytest.approx(3.0)
    assert (report.verdict, report.environment) == (summary.verdict, summary.environment)
    assert report.certified == summary.is_certified
    assert report.slack_share == pytest.approx(summary.slack_share, rel=1e-6)


def test_balance_agrees_with_the_kernel_and_with_a_sum_by_hand(held: Recording) -> None:
    ticks = held.ticks
    starts = {name: meta_start(held.meta, name) for name in STARTS}
    balance = Balance.of(
        ticks,
        parameters_of(held.meta),
        np.array(starts["handle_start"]),
        np.array(starts["tool_start"]),
        starts["start_kinetic"][0] + starts["start_potential"][0],
        np.zeros(0),
    )
    # rounding of 200 summed works of 1e-3 J
    for name in ("coupling_work", "device_energy", "environment_energy"):
        np.testing.assert_allclose(getattr(balance, name), ticks[name], rtol=0, atol=1e-14)
    np.testing.assert_allclose(balance.wrench_on_tool, ticks["wrench_on_tool"], rtol=0, atol=1e-11)
    np.testing.assert_allclose(
        balance.wrench_on_device, ticks["wrench_on_device"], rtol=0, atol=1e-13
    )
    np.testing.assert_allclose(balance.handle_position, ticks["handle_position"], atol=1e-16)
    created, slack = energy_by_hand(held)
    np.testing.assert_allclose(balance.environment_energy, created, rtol=0, atol=1e-13)
    np.testing.assert_allclose(balance.slack, slack, rtol=1e-9, atol=1e-15)
    assert np.ptp(ticks["environment_energy"]) > 1e-4  # there was something to agree on


def test_rotation_vectors_are_those_of_scipy() -> None:
    rng = np.random.default_rng(3)
    a, b = Rotation.random(200, rng=rng), Rotation.random(200, rng=rng)
    ours = turn_between(
        a.as_quat(canonical=True, scalar_first=True), b.as_quat(canonical=True, scalar_first=True)
    )
    np.testing.assert_allclose(ours, (b * a.inv()).as_rotvec(), rtol=0, atol=1e-12)


def test_trip_leaves_a_recording_that_audits_and_tells(tmp_path: Path) -> None:
    path = tmp_path / "trip.mcap"
    device = ScriptedDevice(lambda k: (np.nan if k == 50 else 1e-5 * k, 0, 0, 1, 0, 0, 0))
    with pytest.raises(SafetyTrip):
        recorded(path, "point_mass", device, duration=1.0)
    report = audit(path)
    assert (report.verdict, report.ticks) == ("passive", 50)
    assert report.events == {"start": 1, "trip": 1, "stop": 1}
    assert "tick 50" in next(
        e["reason"] for e in read_recording(path).events if e["event"] == "trip"
    )


# --- active runs, and what strictness and the device's damping make of passive ones


def test_energy_that_an_integrator_creates_is_active(tmp_path: Path) -> None:
    path = tmp_path / "fast.mcap"
    device = ScriptedDevice(swing)
    summary = recorded(path, "point_mass", device, LOOSE, duration=0.3, method="implicitfast")
    report = audit(path)
    assert report.resimulation == "bit for bit"  # an honest file of a bad run
    created, slack = energy_by_hand(read_recording(path))
    first = int(np.argmax(created > slack + 1e-9))
    assert (report.verdict, report.environment, report.exit_code) == ("active", "active", 1)
    assert (report.tick, report.port) == (first, "environment")
    assert report.joules == pytest.approx(created[first] - slack[first], rel=1e-6)
    assert f"tick {first}" in report.reason
    assert (summary.verdict, summary.environment) == ("active", "active")
    assert report.slack_share == pytest.approx(summary.slack_share, rel=1e-9)


def test_same_motion_under_the_default_integrator_is_strict(tmp_path: Path) -> None:
    path = tmp_path / "discrete.mcap"
    recorded(path, "point_mass", ScriptedDevice(swing), LOOSE, duration=0.3)
    report = audit(path, strict=True)
    assert (report.verdict, report.environment) == ("passive", "strict")


@pytest.mark.filterwarnings("ignore:.*more energy than the coupling's slack:UserWarning")
def test_stiff_contact_on_a_light_tool_is_active(tmp_path: Path) -> None:
    scene = tmp_path / "wall.xml"
    text = scene_path("virtual_wall").read_text()
    text = text.replace(
        'solref="0.002 1" solimp="0.9 0.95', 'solref="-1000000 -500" solimp="0.99 0.99'
    )
    scene.write_text(text.replace('mass="0.05"', 'mass="0.01"'))
    coupling = Coupling(
        stiffness=2e4, damping=0.5, rotational_stiffness=2.4, rotational_damping=5e-4
    )

    def press(tick: int) -> tuple[float, ...]:
        x = 0.0115 * min(tick / 100, 1) + 1e-3 * np.sin(2 * np.pi * 0.02 * tick)
        return (x, 0, 0, 1, 0, 0, 0)

    path = tmp_path / "wall.mcap"
    recorded(path, scene, ScriptedDevice(press), coupling, duration=0.3)
    report = audit(path)
    assert (report.verdict, report.exit_code) == ("active", 1)
    assert report.tick is not None and 100 < report.tick < 140
    assert read_recording(path).ticks["contacts"][report.tick - 10 : report.tick].any()


def test_strict_refuses_what_the_slack_allows(tmp_path: Path) -> None:
    path = tmp_path / "slack.mcap"
    # more damping in the coupling: the same creation stays below the slack
    coupling = Coupling(stiffness=2000, damping=2, rotational_stiffness=2, rotational_damping=5e-4)
    device = ScriptedDevice(swing, damping=4.0)  # it needs 3 N s/m; with less there is no slack
    recorded(path, "point_mass", device, coupling, duration=0.3, method="implicitfast")
    loose, strict = audit(path), audit(path, strict=True)
    created, slack = energy_by_hand(read_recording(path))
    assert (loose.verdict, loose.environment) == ("passive", "within slack")
    share = float(np.max(np.where(created > 1e-9, created / (slack + 1e-9), 0)))
    assert 0.5 < share < 1
    assert loose.slack_share == pytest.approx(share, rel=1e-3)
    assert f"{loose.slack_share:.0%}" in loose.reason
    assert (strict.verdict, strict.environment, strict.exit_code) == ("active", "within slack", 1)
    first = int(np.argmax(created > 1e-9))
    assert strict.tick == first
    assert strict.joules == pytest.approx(created[first], rel=1e-6)


@pytest.mark.parametrize(
    ("stiffness", "rotational_stiffness", "certified"),
    [(2999.0, 2.99, True), (3001.0, 2.99, False), (2999.0, 3.01, False)],
)
def test_certificate_is_the_device_condition(
    tmp_path: Path, stiffness: float, rotational_stiffness: float, certified: bool
) -> None:
    path = tmp_path / "run.mcap"
    # b = 2 N s/m and 2e-3 N m s/rad at 1 ms: K < 2 (2 − 0.5) / 1e-3 and the thousandth of it
    coupling = Coupling(
        stiffness=stiffness,
        damping=0.5,
        rotational_stiffness=rotational_stiffness,
        rotational_damping=5e-4,
    )
    recorded(path, "point_mass", "simulated", coupling, duration=0.05)
    report = audit(path)
    assert report.verdict == "passive"
    assert report.certified is certified
    assert report.exit_code == (0 if certified else 1)
    assert any("<" in sentence for sentence in report.conditions) is not certified


def test_scales_enter_the_device_condition(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    coupling = Coupling(
        stiffness=2000, damping=0.5, rotational_stiffness=2, rotational_damping=5e-4
    )
    recorded(path, "point_mass", "simulated", coupling, duration=0.05, scale=1.2)
    assert audit(path).certified is False  # 1.44 · 1.5 N s/m > 2
    recorded(path, "point_mass", "simulated", coupling, duration=0.05, scale=1.2, force_scale=1.0)
    assert audit(path).certified is True  # 1.2 · 1.5 N s/m < 2


# --- tampering


def changed(
    recording: Recording, name: str, index: int, tick: int, factor: float
) -> NDArray[np.void] | None:
    """Returns the records with one number changed; None where that is no change at all."""
    ticks = recording.ticks.copy()
    values = ticks[name].reshape(len(ticks), -1)
    old = values[tick, index]
    values[tick, index] = old * factor if old != 0 else factor - 1
    difference = abs(values[tick, index] - old)
    least = LEAST_DEVICE_CHANGE if name in DEVICE_POSE else 0.0
    return ticks if difference > least else None


def verdict_of(recording: Recording, folder: Path, **parts: Any) -> AuditReport:
    return audit(rewritten(recording, folder / "tampered.mcap", **parts))


def test_rewriting_alone_changes_no_verdict(tap: Recording, held: Recording, folder: Path) -> None:
    for recording in (tap, held):
        report = verdict_of(recording, folder)
        assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


@settings(
    max_examples=120,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    is_held=st.booleans(),
    component=st.sampled_from(COMPONENTS),
    tick=st.integers(0, 199),
    size=SIZES,
    sign=st.sampled_from([-1, 1]),
    flips=st.booleans(),
)
def test_no_changed_number_is_missed(
    tap: Recording,
    held: Recording,
    folder: Path,
    is_held: bool,
    component: tuple[str, int],
    tick: int,
    size: float,
    sign: int,
    flips: bool,
) -> None:
    recording = held if is_held else tap
    ticks = changed(recording, *component, tick, -1.0 if flips else 1 + sign * size)
    if ticks is None:
        return
    report = verdict_of(recording, folder, ticks=ticks)
    assert report.verdict == "invalid", (component, tick, size)
    assert report.tick is not None
    assert report.exit_code == 1
    # the work of a changed device pose may round away; else the fault is found where it is
    if component[0] not in DEVICE_POSE:
        assert report.tick == tick


@pytest.mark.parametrize("name", ["flags", "contacts", "solver_iterations"])
@pytest.mark.parametrize("bit", [0, 1, 2, 4, 6, 9])
def test_no_changed_count_or_flag_is_missed(
    tap: Recording, folder: Path, name: str, bit: int
) -> None:
    ticks = tap.ticks.copy()
    ticks[name][120] ^= 1 << bit
    assert verdict_of(tap, folder, ticks=ticks).verdict == "invalid"


META_NUMBERS = (
    "stiffness",
    "damping",
    "rotational_stiffness",
    "rotational_damping",
    "period_s",
    "scale",
    "force_scale",
    "substeps",
    "ramp_ticks",
    "start_kinetic",
    "start_potential",
)


@pytest.mark.parametrize("name", META_NUMBERS)
@pytest.mark.parametrize("factor", [1 + 1e-12, 11.0, -1.0, 1e300])
def test_no_changed_parameter_is_missed(
    held: Recording, folder: Path, name: str, factor: float
) -> None:
    value = float(held.meta[name])
    meta = {name: repr(value * factor if value else factor - 1)}
    assert verdict_of(held, folder, meta=meta).verdict == "invalid"


@pytest.mark.parametrize(
    "name",
    ["axes", "device_origin", "handle_origin", "device_start", "handle_start", "tool_start"],
)
def test_no_changed_pose_of_the_start_is_missed(held: Recording, folder: Path, name: str) -> None:
    numbers = json.loads(held.meta[name])
    for index in range(len(numbers)):
        if (name, index) == ("device_start", 3):
            continue  # the scalar part of no rotation: any length of it is no rotation
        other = [*numbers]
        other[index] += 1e-12
        report = verdict_of(held, folder, meta={name: json.dumps(other)})
        assert report.verdict == "invalid", (name, index)


@pytest.mark.parametrize("text", ["", "[]", "nan", "[/b]", "1" * 5000, "[" * 5000])
@pytest.mark.parametrize("name", ["stiffness", "axes", "device", "substeps", "versions", "host"])
def test_damaged_metadata_never_crash_the_audit(
    held: Recording, folder: Path, name: str, text: str
) -> None:
    report = verdict_of(held, folder, meta={name: text})
    if name in ("versions", "host"):
        assert report.verdict == "passive"
        assert name == "host" or report.resimulation.startswith("not re-simulated: ")
    else:
        assert report.verdict == "invalid"
        assert name in report.reason or "digits" in report.reason
    json.loads(report.to_json())


def test_numbers_beyond_all_bounds_are_invalid_without_a_warning(
    held: Recording, folder: Path
) -> None:
    for name, index in COMPONENTS:
        ticks = held.ticks.copy()
        ticks[name].reshape(len(ticks), -1)[50, index] = 1e300 if index % 2 == 0 else np.nan
        report = verdict_of(held, folder, ticks=ticks)
        assert (report.verdict, report.tick) == ("invalid", 50)
        json.loads(report.to_json())


def test_changed_scene_is_found_whatever_else_was_made_to_fit(tap: Recording, folder: Path) -> None:
    other = dict(tap.attachments)
    state = bytearray(other[STATE_ATTACHMENT])
    state[8 : 8 + 8] = np.float64(1e-9).tobytes()
    other[STATE_ATTACHMENT] = bytes(state)
    assert verdict_of(tap, folder, attachments=other).verdict == "invalid"
    short = {STATE_ATTACHMENT: tap.attachments[STATE_ATTACHMENT][:-8]}
    assert "bytes" in verdict_of(tap, folder, attachments=short).reason
    cut = {MODEL_ATTACHMENT: tap.attachments[MODEL_ATTACHMENT][:-8]}
    assert "scene_sha256" in verdict_of(tap, folder, attachments=cut).reason


def test_change_without_a_new_digest_is_found_by_the_digest(
    tap: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    meta = {"started": "2001-01-01T00:00:00+00:00"}
    with monkeypatch.context() as patch:
        # all checksums of the container are right, only the old digest is kept
        patch.setattr(Digest, "hexdigest", lambda _: tap.digest)
        path = rewritten(tap, tmp_path / "changed.mcap", meta=meta)
    assert read_recording(path).problems == ()
    report = audit(path)
    assert (report.verdict, report.exit_code) == ("invalid", 1)
    assert "does not match its digest" in report.reason
    assert audit(rewritten(tap, path, meta=meta)).verdict == "passive"


def test_sum_that_overflows_is_a_fault_and_no_agreement(tap: Recording, folder: Path) -> None:
    other = {"versions": json.dumps(versions() | {"mujoco": "3.0"}), "damping": "1e308"}
    report = verdict_of(tap, folder, meta=other)
    assert (report.verdict, report.port) == ("invalid", "wrench_on_tool")
    assert json.loads(report.to_json())["verdict"] == "invalid"


def test_device_that_no_force_moves_is_not_certified_whatever_damping_it_claims(
    tap: Recording, folder: Path
) -> None:
    claimed = json.loads(tap.meta["device"]) | {"damping": 100.0}
    report = verdict_of(tap, folder, meta={"device": json.dumps(claimed)})
    assert (report.verdict, report.certified, report.conditions) == ("passive", None, ())
    free = claimed | {"is_prescribed": False}
    assert verdict_of(tap, folder, meta={"device": json.dumps(free)}).certified is True


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    component=st.sampled_from(COMPONENTS),
    tick=st.integers(0, 199),
    exponent=st.floats(-7, 1),
    sign=st.sampled_from([-1, 1]),
)
def test_numpy_alone_finds_what_exceeds_its_tolerance(
    held: Recording, folder: Path, component: tuple[str, int], tick: int, exponent: float, sign: int
) -> None:
    name, index = component
    ticks = held.ticks.copy()
    values = ticks[name].reshape(len(ticks), -1)
    # a quaternion's part seen from a length of 1, a position's from 0.1 m
    values[tick, index] += sign * 10.0**exponent
    meta = {"versions": json.dumps(versions() | {"mujoco": "3.0"})}
    report = verdict_of(held, folder, ticks=ticks, meta=meta)
    assert report.verdict == "invalid", (component, tick, exponent)
    assert report.resimulation == ""


def test_without_resimulation_the_report_says_so_and_why(tap: Recording, folder: Path) -> None:
    other = {"versions": json.dumps(versions() | {"mujoco": "3.0"})}
    report = verdict_of(tap, folder, meta=other)
    assert report.verdict == "passive"
    assert report.resimulation == (
        f"not re-simulated: recorded with mujoco 3.0, here is {mujoco.__version__}"
    )
    # below NumPy's tolerance, so only the re-simulation can tell; with it the same is invalid
    ticks = tap.ticks.copy()
    ticks["kinetic"][60] *= 1 + 1e-12
    assert verdict_of(tap, folder, ticks=ticks, meta=other).verdict == "passive"
    assert verdict_of(tap, folder, ticks=ticks).verdict == "invalid"
    assert MODEL_ATTACHMENT in verdict_of(without_model(tap), folder).resimulation


def test_other_processor_may_round_differently_but_not_more(tap: Recording, folder: Path) -> None:
    host = {"host": json.dumps(json.loads(tap.meta["host"]) | {"processor": processor() + "!"})}
    assert verdict_of(tap, folder, meta=host).resimulation == "bit for bit"
    ticks = tap.ticks.copy()
    ticks["kinetic"][60] += 1e-11
    report = verdict_of(tap, folder, ticks=ticks, meta=host)
    assert (report.verdict, report.resimulation) == ("passive", "within 1e-9 (other processor)")
    assert verdict_of(tap, folder, ticks=ticks).verdict == "invalid"
    ticks["solver_iterations"][60] += 1
    assert verdict_of(tap, folder, ticks=ticks, meta=host).verdict == "invalid"


# --- structure


@pytest.mark.parametrize("lost", [slice(70, 71), slice(0, 3), slice(50, 150)])
def test_gap_is_named_and_invalid(tap: Recording, folder: Path, lost: slice) -> None:
    kept = np.delete(tap.ticks, lost)
    report = verdict_of(tap, folder, ticks=kept)
    assert report.verdict == "invalid"
    assert f"{lost.start - 1} is followed by {lost.stop}" in report.reason
    assert (report.tick, report.port) == (lost.start, "tick")


def test_swapped_and_repeated_records_are_invalid(tap: Recording, folder: Path) -> None:
    order = np.arange(len(tap.ticks))
    order[[80, 81]] = [81, 80]
    assert verdict_of(tap, folder, ticks=tap.ticks[order]).verdict == "invalid"
    twice = np.insert(np.arange(len(tap.ticks)), 80, 79)
    assert verdict_of(tap, folder, ticks=tap.ticks[twice]).verdict == "invalid"


def test_deadlines_must_follow_the_period_and_the_overrun_flag(
    tap: Recording, folder: Path
) -> None:
    late = tap.ticks.copy()
    for name in CLOCK_FIELDS:
        late[name][90:] += 3_000_000
    report = verdict_of(tap, folder, ticks=late)
    assert (report.verdict, report.tick, report.port) == ("invalid", 90, "deadline_ns")
    late["flags"][90] |= int(TickFlag.OVERRUN)
    assert verdict_of(tap, folder, ticks=late).verdict == "passive"
    for name in CLOCK_FIELDS:
        late[name][90:] += 500_000
    assert verdict_of(tap, folder, ticks=late).verdict == "invalid"


def test_cut_file_is_judged_on_what_it_holds_and_says_so(tmp_path: Path) -> None:
    whole, cut, mended = (tmp_path / name for name in ("whole.mcap", "cut.mcap", "mended.mcap"))
    recorded(whole, "virtual_wall", duration=2.0)
    content = whole.read_bytes()
    cut.write_bytes(content[: int(len(content) * 0.9)])
    report = audit(cut)
    assert report.is_cut
    assert report.verdict == "passive"
    assert 0 < report.ticks < 2000
    assert report.resimulation == "bit for bit"
    repair(cut, mended)
    after = audit(mended)
    assert (after.verdict, after.is_cut, after.ticks) == ("passive", False, report.ticks)
    assert after.events["repaired"] == 1


def test_recording_without_a_tick_is_invalid(tap: Recording, folder: Path) -> None:
    report = verdict_of(tap, folder, ticks=tap.ticks[:0])
    assert (report.verdict, report.reason) == ("invalid", "the recording holds no tick")


def test_file_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_text("hello")
    with pytest.raises(RecordingError, match=r"x\.mcap is not an MCAP file"):
        audit(path)


def test_changed_input_event_is_found(tmp_path: Path) -> None:
    scene = tmp_path / "scene.xml"
    text = scene_path("point_mass").read_text()
    scene.write_text(text)
    path = tmp_path / "run.mcap"

    def push(bridge: Bridge, tick: int) -> None:
        if tick == 20:
            bridge.set_input(body_wrench={"tool": [0.5, 0, 0, 0, 0, 1e-3]})

    recorded(path, scene, duration=0.1, on_tick=push)
    recording = read_recording(path)
    assert audit(path).resimulation == "bit for bit"
    assert recording.ticks["external_work"][-1] != 0
    damages: tuple[dict[str, object], ...] = (
        {"tick": 21},
        {"tick": "20"},
        {"tick": -1},
        {"writes": []},
        {"writes": [["xfrc_applied", 6, [0.5, 0, 0, 0, 0, 1.1e-3]]]},
        {"writes": [["qpos", 0, [1.0]]]},
        {"writes": [["ctrl", 0, 1.0]]},
        {"writes": [["ctrl", 10**6, [1.0]]]},
        {"writes": {"a": 1}},
        {"writes": None},
    )
    for damage in damages:
        events = [
            event | damage if event["event"] == "input" else event for event in recording.events
        ]
        report = audit(rewritten(recording, tmp_path / "other.mcap", events=events))
        assert report.verdict == "invalid", damage


# --- independence


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{name.name}" for name in node.names}
    return found


def test_audit_shares_no_arithmetic_with_the_loop() -> None:
    for path in AUDIT.glob("*.py"):
        assert not [name for name in imports_of(path) if "bridge.bridge" in name], path
        assert not [name for name in imports_of(path) if name.startswith("hapticbridge.ledger")]
    for own in ("balance.py", "device_port.py"):
        names = {name for name in imports_of(AUDIT / own) if name.startswith("hapticbridge")}
        others = {name for name in names if not name.startswith("hapticbridge.audit.")}
        assert others == {"hapticbridge.kernel.state.RunParameters"}  # data, no function
    for path in (AUDIT / "balance.py", AUDIT / "verdict.py"):
        assert not [n for n in imports_of(path) if n.startswith("hapticbridge.kernel.step")]


def test_all_fields_but_the_clock_are_compared() -> None:
    assert set(CLOCK_FIELDS) == {n for n in TICK_DTYPE.names or () if n.endswith("_ns")}


def test_clock_times_are_free_as_long_as_they_run_forwards(tap: Recording, folder: Path) -> None:
    ticks = tap.ticks.copy()
    for name in ("wake_ns", "read_ns", "write_ns"):
        ticks[name][7] += 12345
    ticks["buttons"][7] = 3
    assert verdict_of(tap, folder, ticks=ticks).verdict == "passive"
    ticks["wake_ns"][7] += 1
    report = verdict_of(tap, folder, ticks=ticks)
    assert (report.verdict, report.tick, report.port) == ("invalid", 7, "wake_ns")


def test_bridge_and_audit_agree_on_the_verdict_of_a_run_that_is_continued(tmp_path: Path) -> None:
    path = tmp_path / "twice.mcap"
    with Bridge("planar_peg", "simulated", recording=path, clock=SimulatedClock()) as bridge:
        bridge.run(0.1)
        summary = bridge.run(0.1)
    report = audit(path)
    assert (report.verdict, report.ticks) == (summary.verdict, 200)


def test_records_that_are_missing_before_the_stop_are_noticed(tap: Recording, folder: Path) -> None:
    report = verdict_of(tap, folder, ticks=tap.ticks[:-10])
    assert report.verdict == "invalid"
    assert "the last record is of" in report.reason
