"""The whole bridge on emulated raw HID devices, in virtual time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from emulated.hid_seam import DrivingClock
from emulated.rawhid_model import Claims, RawHid
from loop_claims import runs_are_the_same
from rawhid_cases import opened, paddle

import hapticbridge as hb
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import DeviceError, SafetyTrip
from hapticbridge.record import TickFlag
from hapticbridge.scene import scene_path


def guided() -> RawHid:
    """Returns a device in a hand that puts the peg into the hole, with the encoder's steps."""
    path = scene_path("peg_in_hole").with_suffix(".csv")
    return RawHid(SimulatedDevice(path=path, friction=0.05))


def run(recording: Path, model: RawHid, seconds: float) -> tuple[hb.Summary, RawHid]:
    device, model, seam = opened(model)
    clock = DrivingClock(seam)
    with hb.Bridge("peg_in_hole", device, clock=clock, recording=recording) as bridge:
        return bridge.run(seconds), model


@pytest.fixture(scope="module", name="inserted")
def _inserted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, hb.Summary, RawHid]:
    recording = tmp_path_factory.mktemp("rawhid") / "run.mcap"
    return recording, *run(recording, guided(), 4.0)


def test_the_peg_goes_in_behind_a_raw_hid_device_and_the_audit_finds_it_passive(
    inserted: tuple[Path, hb.Summary, RawHid],
) -> None:
    recording, summary, model = inserted
    report = hb.audit(recording)
    assert (report.verdict, report.certified, report.resimulation) == (
        "passive",
        None,
        "bit for bit",
    )
    # b is enough for a wall, but nobody certifies a device whose force is late: 1 ms for its own
    # period and 1 ms each way on the bus
    assert all("behind a delay of 3 ticks" in condition for condition in report.conditions)
    ticks = hb.read_recording(recording).ticks
    assert (summary.ticks, len(ticks)) == (4000, 4000)
    assert (ticks["flags"] & int(TickFlag.CONTACT)).any()
    assert summary.peak_force > 0.05
    # every tick sent a frame, and so did the two of the trip home: zero, then motors off
    assert model.commands >= 4000
    assert not model.is_enabled
    assert not model.wrench.any()


def test_what_the_hand_felt_is_what_the_recording_says_was_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    felt = []
    original = RawHid.output

    def output(self: RawHid, report: bytes, now: float) -> None:
        original(self, report, now)
        felt.append(self.wrench.copy())

    monkeypatch.setattr(RawHid, "output", output)
    run(tmp_path / "run.mcap", guided(), 0.1)
    ticks = hb.read_recording(tmp_path / "run.mcap").ticks
    first = len(felt) - len(ticks) - 3  # after: zero twice, motors off
    np.testing.assert_allclose(
        felt[first : first + len(ticks)], ticks["wrench_on_device"], rtol=1e-6, atol=1e-30
    )


def test_the_loop_is_the_same_in_every_run(tmp_path: Path) -> None:
    runs_are_the_same(lambda path: run(path, guided(), 0.2), tmp_path)


def test_lost_and_damaged_frames_are_flagged_and_the_run_stays_passive(tmp_path: Path) -> None:
    model = guided()
    device, _, seam = opened(model)
    model.lose = set(range(50, 400, 7))
    model.damage = set(range(52, 400, 11))
    with hb.Bridge(
        "peg_in_hole", device, clock=DrivingClock(seam), recording=tmp_path / "run.mcap"
    ) as bridge:
        bridge.run(0.5)
    ticks = hb.read_recording(tmp_path / "run.mcap").ticks
    stale = int(np.count_nonzero(ticks["flags"] & int(TickFlag.STALE_SAMPLE)))
    assert device.states.lost == len(model.lose | model.damage)
    assert device.states.damaged == len(model.damage - model.lose)
    assert stale >= device.states.lost
    assert hb.audit(tmp_path / "run.mcap").verdict == "passive"


def test_a_slower_device_repeats_its_samples_and_every_repetition_is_flagged(
    tmp_path: Path,
) -> None:
    model = RawHid(SimulatedDevice(), Claims(rate=250.0))
    device, _, seam = opened(model)
    with hb.Bridge(
        "peg_in_hole", device, clock=DrivingClock(seam), recording=tmp_path / "run.mcap"
    ) as bridge:
        bridge.run(0.4)
    flags = hb.read_recording(tmp_path / "run.mcap").ticks["flags"]
    assert np.count_nonzero(flags & int(TickFlag.STALE_SAMPLE)) == pytest.approx(300, abs=1)


def test_unplugging_in_mid_run_trips_and_no_row_up_to_it_is_lost(tmp_path: Path) -> None:
    device, model, seam = opened(guided())

    def pull(tick: int) -> None:
        if tick == 150:
            seam.unplug(model)

    recording = tmp_path / "run.mcap"
    with (
        pytest.raises(SafetyTrip, match=r"tick 150: .* is gone: unplugged"),
        hb.Bridge("peg_in_hole", device, clock=DrivingClock(seam), recording=recording) as bridge,
    ):
        bridge.run(1.0, on_tick=pull)
    ticks = hb.read_recording(recording).ticks
    np.testing.assert_array_equal(ticks["tick"], np.arange(150))
    # nobody could tell it to let go: its own watchdog did
    model.advance(seam.now + 0.021)
    assert not model.wrench.any()


def test_a_pose_that_is_not_finite_trips_with_zero_force_first(tmp_path: Path) -> None:
    device, model, seam = opened(guided())

    def spoil(tick: int) -> None:
        if tick == 120:
            model.motion = (float("nan"),) * 12

    with (
        pytest.raises(SafetyTrip, match=r"tick 12[01]: .* a number that is not finite") as trip,
        hb.Bridge("peg_in_hole", device, clock=DrivingClock(seam)) as bridge,
    ):
        bridge.run(1.0, on_tick=spoil)
    assert not model.wrench.any()
    assert np.isfinite(trip.value.records["device_position"]).all()


def test_a_paddle_of_one_axis_runs_a_scene_and_its_other_axes_stay(tmp_path: Path) -> None:
    device, model, seam = opened(paddle())
    recording = tmp_path / "run.mcap"
    with hb.Bridge("peg_in_hole", device, clock=DrivingClock(seam), recording=recording) as bridge:
        summary = bridge.run(0.5)
    ticks = hb.read_recording(recording).ticks
    assert np.ptp(ticks["device_position"][:, 0]) > 1e-4
    assert not ticks["device_position"][:, 1:].any()
    assert (ticks["device_quaternion"] == (1.0, 0.0, 0.0, 0.0)).all()
    steps = ticks["device_position"][:, 0] / model.claims.resolution
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    # b = 0.8 N s/m is enough, and it does not turn; how late it is it does not say
    (condition,) = summary.conditions
    assert "if it answers without delay, which is unknown" in condition
    assert summary.is_certified is None


def test_a_device_in_a_hand_refuses_a_clock_that_runs_ahead_of_it() -> None:
    device, _, _ = opened()
    with pytest.raises(DeviceError, match=r"moves in real time, .* leave out --fast"):
        hb.Bridge("peg_in_hole", device, clock=hb.SimulatedClock())
    assert device.info.is_real
