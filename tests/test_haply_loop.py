"""The whole bridge, and identification, on an emulated Inverse3 in virtual time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from emulated.hid_seam import DrivingClock
from haply_cases import PERIOD, Bench
from loop_claims import peg_went_in_a_tick_late, runs_are_the_same

import hapticbridge as hb
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import SafetyTrip
from hapticbridge.identify import identify
from hapticbridge.scene import scene_path


def guided() -> Bench:
    """Returns a device in a hand that puts the peg into the hole."""
    path = scene_path("peg_in_hole").with_suffix(".csv")
    mechanics = SimulatedDevice(path=path, mass=0.2, damping=2.0, friction=0.05)
    return Bench(mechanics, resolution=1e-5)


def run(bench: Bench, seconds: float, recording: Path) -> hb.Summary:
    device = bench.opened(damping=2.0)
    clock = DrivingClock(bench.time)
    with hb.Bridge("peg_in_hole", device, clock=clock, recording=recording) as bridge:
        return bridge.run(seconds)


def test_the_peg_goes_in_behind_the_service_and_the_audit_finds_it_passive(tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    bench = guided()
    ticks = peg_went_in_a_tick_late(run(bench, 4.0, recording), recording)
    sent = np.array(bench.service.forces)
    commanded = ticks["wrench_on_device"][:, :3]
    after = range(1, 6)  # zero forces of the end, after the last tick's
    assert any(np.array_equal(sent[-len(ticks) - k : -k], commanded) for k in after)
    (inverse,) = bench.service.devices.values()
    assert not inverse.force.any()


def test_the_loop_is_the_same_in_every_run(tmp_path: Path) -> None:
    runs_are_the_same(lambda path: run(guided(), 0.2, path), tmp_path)


@pytest.mark.parametrize(
    ("answer", "words"),
    [(None, "closed|dropped"), ("{", "not a JSON object"), ('{"inverse3":[]}', "does not list it")],
)
def test_whatever_breaks_trips_with_every_row_kept(
    tmp_path: Path, answer: str | None, words: str
) -> None:
    bench = guided()
    device = bench.opened(damping=2.0)

    def breaks(tick: int) -> None:
        if tick == 150 and answer is None:
            bench.link.is_dropped = True
        elif tick == 150:
            bench.service.spoil[bench.service.messages + 1] = answer or ""

    recording = tmp_path / "run.mcap"
    with (
        pytest.raises(SafetyTrip, match=words),
        hb.Bridge(
            "peg_in_hole", device, clock=DrivingClock(bench.time), recording=recording
        ) as bridge,
    ):
        bridge.run(1.0, on_tick=breaks)
    ticks = hb.read_recording(recording).ticks
    assert 149 <= len(ticks) <= 152
    bench.time.advance(bench.time.now + 0.2)  # who sends no force any more has none
    (inverse,) = bench.service.devices.values()
    assert not inverse.force.any()


@pytest.mark.parametrize("seed", range(6))
def test_identify_finds_the_numbers_behind_the_service(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = {
        "mass": float(rng.uniform(0.1, 0.6)),
        "damping": float(rng.uniform(0.4, 4.0)),
        "friction": float(rng.uniform(0.05, 0.3)),
    }
    bench = Bench(SimulatedDevice(hand=None, **true), resolution=1e-5)  # type: ignore[arg-type]
    device = bench.opened(force_limit=5.0)
    result = identify(device, DrivingClock(bench.time), period=PERIOD, axes=("y",), duration=4.0)
    fit = result.fits["y"]
    assert fit.mass.value == pytest.approx(true["mass"], rel=0.05)
    assert fit.damping.value == pytest.approx(true["damping"], rel=0.05)
    assert fit.friction.value == pytest.approx(true["friction"], rel=0.1)
    assert result.resolution == pytest.approx(1e-5, rel=1e-6)
    # as the driver says: the measured 0.25 ms, up to whole ticks
    assert fit.delay.value == pytest.approx(PERIOD, abs=0.3 * PERIOD)
