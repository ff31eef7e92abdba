"""Runs, audits and printed words are what they were when ``scripts/freeze`` froze them.

Fields, words, verdicts, counts and numbers are held to on every machine; bits where they were
frozen. On every machine the audit and the compiled sweep find the bits of the live loop again.
"""

from __future__ import annotations

import json
import operator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import golden_cases as golden
import numpy as np
import pytest

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.device import SimulatedDevice
from hapticbridge.kernel.record import CLOCK_FIELDS
from hapticbridge.lab.closed_loop import ClosedLoop
from hapticbridge.lab.methods import METHODS

RUNS = golden.runs()
SWEPT = ("point_mass", "virtual_wall", "peg_in_hole")


def hold(frozen: Any, found: Any) -> None:
    """Fails where fields, words, verdicts or numbers differ, on a machine of the kind bits too."""
    then, now = json.loads(golden.MACHINE.read_text(encoding="utf-8")), golden.machine()
    is_same = operator.eq if then == now else golden.is_close
    differing = golden.difference_lines(frozen, json.loads(json.dumps(found)), is_same=is_same)
    if differing:
        other = golden.difference_lines(then, now, "machine")
        pytest.fail(
            "this differs from what 'scripts/freeze' froze; a change that is meant to change it "
            "runs that again and says why:\n" + "\n".join([*differing, *other]),
            pytrace=False,
        )


def frozen(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", RUNS)
def test_a_run_gives_the_records_that_were_frozen_and_the_audit_finds(
    name: str, tmp_path: Path
) -> None:
    record = tmp_path / "run.mcap"
    hold(frozen(golden.RUNS)[name], RUNS[name].digests(tmp_path, recording=record))
    assert audit(record).resimulation == "bit for bit"


@pytest.mark.parametrize("method", [*golden.METHODS, "explicit"])
@pytest.mark.parametrize("scene", SWEPT)
def test_sweep_and_audit_find_the_bits_of_the_live_loop(
    scene: str, method: str, tmp_path: Path
) -> None:
    def device() -> SimulatedDevice:
        return SimulatedDevice(
            damping=3.0,
            resolution=1e-6,
            friction=0.02,
            delay=1,
            path=f"models/{scene}/{scene}.csv",
            force_limit=1e9,
            torque_limit=1e9,
        )

    live = golden.Run(
        scene,
        device,
        {
            "coupling": golden.COUPLING,
            "method": method,
            "limits": {"force": 1e9, "torque": 1e9, "ramp": 0.0},
            "controller": "off",  # a sweep looks at methods without one
        },
        seconds=1.5,
    )
    with live.open(tmp_path, recording=tmp_path / "run.mcap") as bridge:
        expected = live.go(bridge)
        summary = bridge.summary()
    swept = ClosedLoop(hb.load_scene(scene)).run(
        device(), golden.COUPLING, METHODS[method], period=1e-3, ticks=1500, keep_records=True
    )
    assert len(swept.records) == len(expected) == 1500
    assert (swept.environment, swept.fault) == (summary.environment, summary.fault)
    for name in set(expected.dtype.names or ()) - set(CLOCK_FIELDS):
        assert np.array_equal(swept.records[name], expected[name]), name
    assert audit(tmp_path / "run.mcap").resimulation == "bit for bit"


def test_every_frozen_run_is_still_run() -> None:
    assert list(frozen(golden.RUNS)) == list(RUNS)


def test_recordings_and_their_verdicts_are_the_frozen_ones(tmp_path: Path) -> None:
    hold(frozen(golden.AUDITS), golden.audits(tmp_path))


@pytest.mark.parametrize("name", golden.SESSIONS)
def test_commands_print_what_was_frozen(name: str, tmp_path: Path) -> None:
    text = golden.session_file(name).read_text(encoding="utf-8")
    found = golden.session_text(name, tmp_path)
    if name == "refused":
        for told in found.split("$ ")[2:]:  # after the run that is asked of
            assert "Traceback" not in told
            assert (told.count("\nerror: "), told[-5:]) == (1, "\n(2)\n"), told
        assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    hold(text.splitlines(), found.splitlines())


FROZEN = {
    "kinetic": "0123456789ab",
    "tick": "0123456789ab",
    "work": [1.0],
    "verdict": "passive",
    "buttons": "zero",
}
"""Kinds of frozen values: digests of floats and of counts, a number, a word, and no bit at all."""


@pytest.mark.parametrize(
    ("change", "is_of_bits"),
    [
        ({"kinetic": "ba9876543210"}, True),
        ({"work": [1.0 + 1e-9]}, True),
        ({"kinetic": "zero"}, False),
        ({"tick": "ba9876543210"}, False),
        ({"work": [1.0 + 1e-5]}, False),
        ({"work": [1.0, 1.0]}, False),
        ({"verdict": "active"}, False),
        ({"buttons": "0123456789ab"}, False),
        ({"sample_rate": 0.0}, False),
    ],
)
def test_bits_count_on_the_frozen_kind_of_machine_and_all_else_on_every_one(
    monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], is_of_bits: bool
) -> None:
    kind, (name,) = frozen(golden.MACHINE), change
    for machine in (kind, kind | {"processor": "fma"}):
        monkeypatch.setattr(golden, "machine", lambda machine=machine: machine)
        hold(FROZEN, FROZEN)
        passes = is_of_bits and machine != kind
        with nullcontext() if passes else pytest.raises(pytest.fail.Exception, match=name):
            hold(FROZEN, FROZEN | change)
