"""No changed number, parameter or scene is missed, and none crashes the audit."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from audit_cases import COMPONENTS, other_request, other_sheet, rewritten, verdict_of, without_model
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticbridge.audit import audit
from hapticbridge.recording import Recording, read_recording, repair
from hapticbridge.run.description import (
    SOURCE_PREFIX,
    STATE_ATTACHMENT,
    processor,
    versions,
)

DEVICE_POSE = ("device_position", "device_quaternion")

NUMBERS = [
    "stiffness",
    "damping",
    "rotational_stiffness",
    "rotational_damping",
    "period_s",
    "scale",
    "force_scale",
    "force_limit",
    "torque_limit",
    "substeps",
    "ramp_ticks",
    "start_kinetic",
    "start_potential",
]
"""Metadata that are a number."""

LISTS = ("axes", "device_origin", "handle_origin", "device_start", "handle_start", "tool_start")
"""Metadata that are a list of numbers."""


# A device pose matters only as far as it moves the handle. The handle's coordinates reach 0.05 m,
# where doubles are 7e-18 m apart: below that a changed device pose is another honest run's.
MIN_DEVICE_CHANGE = 2e-17


SIZES = st.sampled_from([10.0**-exponent for exponent in range(-1, 13)])


def changed(
    recording: Recording, name: str, index: int, tick: int, factor: float
) -> NDArray[np.void] | None:
    """Returns the records with one number changed; None where that is no change at all."""
    ticks = recording.ticks.copy()
    values = ticks[name].reshape(len(ticks), -1)
    old = values[tick, index]
    values[tick, index] = old * factor if old != 0 else factor - 1
    difference = abs(values[tick, index] - old)
    least = MIN_DEVICE_CHANGE if name in DEVICE_POSE else 0.0
    return ticks if difference > least else None


def test_rewriting_alone_changes_no_verdict(tap: Recording, held: Recording, folder: Path) -> None:
    for recording in (tap, held):
        report = verdict_of(recording, folder)
        assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


@settings(
    max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
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
@pytest.mark.parametrize("bit", [0, 2, 7, 9, 11])
def test_no_changed_count_or_flag_is_missed(
    tap: Recording, folder: Path, name: str, bit: int
) -> None:
    ticks = tap.ticks.copy()
    ticks[name][120] ^= 1 << bit
    assert verdict_of(tap, folder, ticks=ticks).verdict == "invalid"


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("factor", [1 + 1e-12, -1.0, 1e300])
def test_no_changed_parameter_is_missed(
    held: Recording, folder: Path, name: str, factor: float
) -> None:
    value = float(held.meta[name])
    meta = {name: repr(value * factor if value else factor - 1)}
    assert verdict_of(held, folder, meta=meta).verdict == "invalid"


@pytest.mark.parametrize("name", LISTS)
def test_no_changed_pose_of_the_start_is_missed(held: Recording, folder: Path, name: str) -> None:
    numbers = json.loads(held.meta[name])
    for index in range(len(numbers)):
        if index == 3:
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
        assert report.verdict == ("passive" if name == "host" else "unverified")
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


SCENE = f"{SOURCE_PREFIX}peg_in_hole.xml"


def test_the_scene_is_compiled_from_what_is_attached(tap: Recording, folder: Path) -> None:
    """The audit trusts no compiled model: its sources must be the scene that ran."""
    text = tap.attachments[SCENE]
    for other, words in (
        (b"hello", "does not fit the metadata"),
        (b"<mujoco/>", "does not fit the metadata"),
        (text.replace(b'name="grip"', b'name="grap"'), "grip"),
        (text.replace(b"</worldbody>", b'<light pos="0 0 1"/></worldbody>'), "scene_sha256"),
        (text.replace(b"impratio", b"impratio", 1) + b"<!-- no change of the model -->", ""),
    ):
        report = verdict_of(tap, folder, attachments={SCENE: other})
        assert words in report.reason
        assert report.verdict == ("invalid" if words else "passive")
    sheet = {SCENE.replace(".xml", ".toml"): b""}
    assert verdict_of(tap, folder, attachments=sheet).verdict == "invalid"
    values = json.loads(tap.meta["scene_parameters"]) | {"mass": 0.12}
    heavier = other_request(tap, lambda request: request.update(parameters=values))
    heavier |= {"scene_parameters": json.dumps(values)}
    assert "scene_sha256" in verdict_of(tap, folder, meta=heavier).reason


def test_another_processor_may_compile_another_model_which_is_then_not_judged(
    tap: Recording, folder: Path
) -> None:
    other = {"scene_sha256": "0" * 64}
    assert verdict_of(tap, folder, meta=other).verdict == "invalid"
    other["host"] = json.dumps(json.loads(tap.meta["host"]) | {"processor": processor() + "!"})
    report = verdict_of(tap, folder, meta=other)
    assert "another processor compiled it" in report.reason
    assert (report.verdict, report.exit_code) == ("unverified", 1)


def test_gain_that_would_overflow_is_out_of_range(tap: Recording, folder: Path) -> None:
    other = {"versions": json.dumps(versions() | {"mujoco": "3.0"}), "damping": "1e308"}
    report = verdict_of(tap, folder, meta=other)
    assert report.verdict == "invalid"
    assert "damping is 1e+308 N s/m" in report.reason
    assert json.loads(report.to_json())["verdict"] == "invalid"


def test_device_that_no_force_moves_is_not_certified_whatever_damping_it_claims(
    tap: Recording, folder: Path
) -> None:
    claimed = {"damping": 100.0, "rotational_damping": 1.0}
    report = verdict_of(tap, folder, meta=other_sheet(tap, **claimed))
    assert (report.verdict, report.certified, report.conditions) == ("passive", None, ())
    free = other_sheet(tap, **claimed, is_prescribed=False)
    assert verdict_of(tap, folder, meta=free).verdict == "invalid"  # its guard is another


@settings(
    max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
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
    assert (report.verdict, report.exit_code) == ("unverified", 1)
    assert json.loads(report.to_json())["verdict"] == "unverified"
    assert audit(report.path, accepts_unverified=True).exit_code == 0
    assert report.resimulation == (
        f"not re-simulated: recorded with mujoco 3.0, here is {mujoco.__version__}"
    )
    assert "wrench_on_device and share" in report.unchecked
    assert report.unchecked in report.reason
    assert not verdict_of(tap, folder).unchecked
    # below NumPy's tolerance, so only the re-simulation can tell; with it the same is invalid
    ticks = tap.ticks.copy()
    ticks["kinetic"][60] *= 1 + 1e-12
    assert verdict_of(tap, folder, ticks=ticks, meta=other).verdict == "unverified"
    assert verdict_of(tap, folder, ticks=ticks).verdict == "invalid"
    bare = verdict_of(without_model(tap), folder)
    assert (bare.verdict, bare.exit_code) == ("unverified", 1)
    assert SOURCE_PREFIX in bare.resimulation


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


def test_a_cut_file_may_lack_rows_before_its_stop_and_no_other_may(
    tap: Recording, tmp_path: Path
) -> None:
    short = rewritten(tap, tmp_path / "short.mcap", ticks=tap.ticks[:150])
    assert audit(short).reason.startswith("the run stopped before tick 201")
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    cut.write_bytes(short.read_bytes()[:-100])
    assert [e["tick"] for e in read_recording(cut).events if e["event"] == "stop"] == [201]
    repair(cut, mended)
    for path in (cut, mended):
        assert audit(path).verdict == "passive", audit(path).reason
    longer = [e | {"tick": 149} if e["event"] == "stop" else e for e in tap.events]
    file = rewritten(tap, tmp_path / "longer.mcap", ticks=tap.ticks[:150], events=longer)
    file.write_bytes(file.read_bytes()[:-100])
    assert audit(file).verdict == "invalid"
