"""The whole bridge, and identification, on a stand-in for DHD in virtual time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from emulated.dhd_stub import OMEGA3, SIGMA7, Stub
from emulated.hid_seam import DrivingClock
from loop_claims import peg_went_in_a_tick_late, runs_are_the_same

import hapticbridge as hb
from hapticbridge.device import Motion
from hapticbridge.errors import SafetyTrip
from hapticbridge.identify import identify

PERIOD = 1e-3
NUMBERS = {"damping": 1.5, "rotational_damping": 4e-3}


def guided(kind: int = OMEGA3) -> Stub:
    """Returns a device in a hand that lowers the peg into the hole and leans on its wall."""
    places = np.array([[0, 0, 0], [0, 0, 0], [0, 0, -43], [4, 0, -43], [4, 0, -43]])
    down = Motion([0.0, 0.3, 2.5, 3.0, 4.0], 1e-3 * places)
    stub = Stub(kind, down)
    stub.call("mechanics", 0.25, 1.5, 0.05, 1e-5)
    stub.call("hand", 300.0, 6.0, 0.3)
    return stub


def run(stub: Stub, seconds: float, recording: Path) -> hb.Summary:
    device = stub.opened(numbers=NUMBERS)
    clock = DrivingClock(stub)
    stub.begin = stub.now
    with hb.Bridge("peg_in_hole", device, clock=clock, recording=recording) as bridge:
        return bridge.run(seconds)


@pytest.mark.parametrize("kind", [OMEGA3, SIGMA7])
def test_the_peg_goes_in_behind_the_library_and_the_audit_finds_it_passive(
    tmp_path: Path, kind: int
) -> None:
    recording = tmp_path / "run.mcap"
    stub = guided(kind)
    # a delay of calls that is no whole tick counts as one
    peg_went_in_a_tick_late(run(stub, 4.0, recording), recording)
    assert not stub.force().any()


def test_the_loop_is_the_same_in_every_run(tmp_path: Path) -> None:
    runs_are_the_same(lambda path: run(guided(), 0.2, path), tmp_path)


@pytest.mark.parametrize(
    ("hook", "value", "words"),
    [("fail", 1, "gone or failed"), ("spoil", float("nan"), "reports an impossible position")],
)
def test_whatever_breaks_trips_with_every_row_kept(
    tmp_path: Path, hook: str, value: float, words: str
) -> None:
    stub = guided()
    device = stub.opened(numbers=NUMBERS)

    def breaks(tick: int) -> None:
        if tick == 150:
            stub.call(hook, value)

    recording = tmp_path / "run.mcap"
    with (
        pytest.raises(SafetyTrip, match=words),
        hb.Bridge("peg_in_hole", device, clock=DrivingClock(stub), recording=recording) as bridge,
    ):
        bridge.run(1.0, on_tick=breaks)
    np.testing.assert_array_equal(hb.read_recording(recording).ticks["tick"], np.arange(150))
    stub.advance(stub.now + 0.05)  # where the library failed, its watchdog does it
    assert not stub.force().any()


@pytest.mark.parametrize("seed", range(6))
def test_identify_finds_the_numbers_behind_the_library(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mass, damping, friction = (
        float(rng.uniform(least, most)) for least, most in ((0.1, 0.8), (0.4, 4.0), (0.05, 0.4))
    )
    stub = Stub()
    stub.call("mechanics", mass, damping, friction, 1e-5)
    result = identify(stub.opened(), DrivingClock(stub), period=PERIOD, axes=("z",), duration=4.0)
    fit = result.fits["z"]
    assert fit.mass.value == pytest.approx(mass, rel=0.05)
    assert fit.damping.value == pytest.approx(damping, rel=0.05)
    assert fit.friction.value == pytest.approx(friction, rel=0.1)
    assert result.resolution == pytest.approx(1e-5, rel=1e-6)


def test_identify_finds_inertia_and_damping_of_a_wrist() -> None:
    stub = Stub(SIGMA7)
    result = identify(stub.opened(), DrivingClock(stub), period=PERIOD, axes=("rz",), duration=4.0)
    fit = result.fits["rz"]
    assert fit.mass.value == pytest.approx(2e-4, rel=0.05)
    assert fit.damping.value == pytest.approx(4e-3, rel=0.05)
