"""Why a run became active: recordings of known cause, and what the rules make of their parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_runs
from audit_cases import rewritten
from report_runs import Made

from hapticbridge.audit import AuditReport
from hapticbridge.record import TickFlag
from hapticbridge.recording import Recording, read_recording
from hapticbridge.rendering import method_named
from hapticbridge.report.cause import likely_cause, what_would_do
from hapticbridge.report.evidence import Evidence

pytestmark = pytest.mark.filterwarnings("ignore:scene '.*(floor|fan).xml'")


def evidence_of(recording: Recording) -> Evidence:
    evidence = Evidence.of(recording)
    assert evidence is not None
    return evidence


@pytest.mark.parametrize(
    ("run", "port", "kind", "told"),
    [
        (report_runs.active_by_method, "environment", "method", "implicitfast"),
        (report_runs.active_by_contact, "environment", "contact setting", 'solref "-20000 -50"'),
        (report_runs.active_by_rate, "device", "rate", "the coupling needs 5"),
        (report_runs.active_by_delay, "device", "delay", "2 ticks old"),
        (report_runs.active_by_quantisation, "device", "quantisation", "0.45 N"),
        (report_runs.active_by_mocap, "environment", "inputs", "'pusher' touched geom 'ball'"),
        (report_runs.active_beside_a_fan, "environment", "contact setting", "while geom 0 touched"),
        (report_runs.active_with_a_fine_encoder, "device", "rate", "the coupling needs 5"),
        (report_runs.active_by_rotation, "device", "rate", "rotation: the device's damping"),
        (report_runs.active_by_repeated_samples, "device", "delay", "75% of the samples"),
    ],
)
def test_a_run_is_active_for_the_cause_that_it_was_made_for(
    run: Callable[[Path], Path], port: str, kind: str, told: str, made: Made
) -> None:
    recording, report = made(run)
    assert (report.verdict, report.port) == ("active", port)
    evidence = evidence_of(recording)
    cause = likely_cause(evidence, report)
    assert cause is not None
    assert cause.kind == kind
    assert told in cause.evidence
    energy, allowed = evidence.judged(report)
    assert energy[report.tick] - allowed[report.tick] == pytest.approx(report.joules)


def test_the_same_run_without_its_cause_is_given_another_one(made: Made, tmp_path: Path) -> None:
    # the device of the coarse encoder, with enough friction to hold still between its steps
    recording, report = made(report_runs.active_by_quantisation)
    sheet = recording.meta["device"].replace('"friction": 0.0', '"friction": 0.5')
    assert sheet != recording.meta["device"]
    changed = rewritten(recording, tmp_path / "rubbed.mcap", meta={"device": sheet})
    evidence = evidence_of(read_recording(changed))
    cause = likely_cause(evidence, report)
    assert cause is not None
    assert cause.kind == "rate"


def cause_of(recording: Recording, report: AuditReport, **parts: Any) -> tuple[str, str]:
    cause = likely_cause(evidence_of(Recording(**{**vars(recording), **parts})), report)
    assert cause is not None
    return cause.kind, cause.evidence


def test_missed_deadlines_are_the_cause_where_the_device_bears_the_coupling(made: Made) -> None:
    recording, report = made(report_runs.active_by_rate)
    assert report.tick is not None
    sheet = recording.meta["device"].replace('"damping": 2.0', '"damping": 20.0')
    assert sheet != recording.meta["device"]
    meta, ticks = recording.meta | {"device": sheet}, recording.ticks.copy()
    assert cause_of(recording, report, meta=meta)[0] == "unknown"
    ticks["flags"][[report.tick - 500, report.tick + 1]] |= int(TickFlag.OVERRUN)
    assert cause_of(recording, report, meta=meta, ticks=ticks)[0] == "unknown"  # not before it
    ticks["flags"][report.tick - 100 : report.tick - 97] |= int(TickFlag.OVERRUN)
    kind, told = cause_of(recording, report, meta=meta, ticks=ticks)
    assert (kind, "late by a period or more in the 0.2 s before: 3," in told) == ("rate", True)


def test_swings_over_many_steps_of_the_encoder_are_not_its_quantisation(made: Made) -> None:
    recording, report = made(report_runs.active_by_rate)
    sheet = recording.meta["device"].replace('"resolution": 0.0', '"resolution": 1e-9')
    assert sheet != recording.meta["device"]
    assert cause_of(recording, report, meta=recording.meta | {"device": sheet})[0] == "rate"


def test_a_hard_contact_is_the_cause_also_behind_a_method_with_a_hazard(made: Made) -> None:
    recording, report = made(report_runs.active_by_contact)
    meta = recording.meta | {"method": "implicitfast"}
    assert cause_of(recording, report, meta=meta)[0] == "contact setting"


def test_moved_bodies_that_touch_nothing_are_not_the_cause(made: Made) -> None:
    recording, report = made(report_runs.active_by_mocap)
    still = [event for event in recording.events if event["event"] != "input"]
    assert cause_of(recording, report)[0] == "inputs"
    assert cause_of(recording, report, events=still)[0] == "contact setting"


def test_which_geoms_touched_is_not_told_where_the_run_cannot_be_simulated_again(
    made: Made,
) -> None:
    recording, report = made(report_runs.active_by_contact)
    assert "touched" in cause_of(recording, report)[1]
    foreign = replace(report, resimulation="not re-simulated: recorded with mujoco 3.0.0")
    kind, told = cause_of(recording, foreign)
    assert kind == "contact setting"
    assert "touched" not in told


def test_a_fast_turn_without_contact_is_suspected_and_a_slow_one_is_not(made: Made) -> None:
    recording, report = made(report_runs.active_by_method)
    meta = recording.meta | {"method": "implicit"}
    assert cause_of(recording, report, meta=meta)[0] == "unknown"
    ticks = recording.ticks.copy()
    half = 0.5 * 0.03 * ticks["tick"]
    ticks["tool_quaternion"] = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=1)
    kind, told = cause_of(recording, report, meta=meta, ticks=ticks)
    assert (kind, "0.03 rad a tick (30 rad/s)" in told) == ("rate", True)


@pytest.mark.parametrize(
    ("run", "told"),
    [
        # K <= 2 b/T with b = 2 N s/m and B' = 0; with K = 10000 T <= 2 b/K
        (report_runs.active_by_rate, "lower the stiffness to 4000 N/m, or raise the rate to 2500"),
        # K_r <= 2 b_r/T with 0.002 N m s/rad
        (report_runs.active_by_rotation, "lower the rotational stiffness to 4 N m/rad, or raise"),
        # a wall behind two samples: K <= b/(T/2 + 2 T); a faster loop does not shorten a delay
        (report_runs.active_by_delay, "lower the stiffness to 800 N/m"),
    ],
)
def test_the_remedy_is_what_the_device_condition_asks_for(
    run: Callable[[Path], Path], told: str, made: Made
) -> None:
    recording, report = made(run)
    cause = likely_cause(evidence_of(recording), report)
    assert cause is not None
    assert told in cause.remedy
    assert ("raise the rate" in cause.remedy) == (cause.kind == "rate")


def test_no_rate_of_the_loop_helps_where_the_device_has_its_own(made: Made) -> None:
    recording, _ = made(report_runs.active_by_rate)
    sheet = recording.meta["device"].replace('"rate": null', '"rate": 500.0')
    assert sheet != recording.meta["device"]
    meta = recording.meta | {"device": sheet}
    slow = evidence_of(Recording(**{**vars(recording), "meta": meta}))
    assert what_would_do(slow) == "lower the stiffness to 2000 N/m"


def test_a_damper_beyond_the_device_is_called_so_and_no_rate_is_asked_for(made: Made) -> None:
    recording, report = made(report_runs.active_by_rate)
    evidence = evidence_of(recording)
    for method, damping, kind, remedy in (
        ("implicit", 1.9, "rate", "raise the rate to 2500 Hz"),  # T <= 2 (b - B)/K
        ("implicit", 2.1, "damping", "lower the damping to 1.75 N s/m"),  # b - K T/2
        ("lossless", 1.9, "damping", "lower the damping to 2 N s/m"),  # B = B' + K T/2 <= b
    ):
        coupling = replace(evidence.worst.coupling, stiffness=500.0, damping=damping)
        worst = replace(evidence.worst, coupling=coupling)
        cause = likely_cause(replace(evidence, worst=worst, method=method_named(method)), report)
        assert cause is not None
        assert cause.kind == kind
        assert remedy in cause.remedy
        assert ("raise the rate" in cause.remedy) == (kind == "rate")
