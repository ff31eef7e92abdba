"""A Falcon in the loop: what it reports, what it does with a force, and how it is lost."""

from __future__ import annotations

import array
from pathlib import Path

import numpy as np
import pytest
from falcon_cases import PERIOD, Bench
from numpy.typing import NDArray

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.device import SimulatedDevice, device_for
from hapticbridge.device.falcon.device import FalconDevice
from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import DeviceError, DeviceLost, SafetyTrip
from hapticbridge.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.scene import load_scene

STALE = int(TickFlag.STALE_SAMPLE)


def looped(
    bench: Bench,
    device: FalconDevice,
    ticks: int,
    force: tuple[float, ...] = (0.0, 0.0, 0.0),
    drift: float = 0.0,
) -> tuple[NDArray[np.void], NDArray[np.int64], NDArray[np.float64]]:
    """Runs a bare loop; returns samples, flags, and where the grip really was at each read."""
    samples, flags = np.zeros(ticks, SAMPLE_DTYPE), np.zeros(ticks, np.int64)
    truth = np.zeros((ticks, 3))
    clock, wrench = bench.clock(drift), np.array([*force, 0.3, 0.2, 0.1])
    for k in range(ticks):
        clock.wait()
        truth[k] = bench.model.handle.pose()[0]
        flags[k] = device.read(samples[k : k + 1])
        device.write(wrench)
    return samples, flags, truth


def test_every_tick_has_a_new_sample_that_is_two_ticks_old_at_most() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    samples, flags, truth = looped(bench, device, 2000, drift=3e-4)
    # clocks that differ by 3e-4 pass each other once in 3.3 s: a tick finds nothing, or two replies
    assert np.count_nonzero(flags == STALE) <= 2
    # asked in the tick before, or the one before that: between those two places, to encoder steps
    for age in (1, 2):
        late = truth[:-age]
        assert np.abs(samples["position"][age:] - late).max() < 0.2e-3
    assert np.ptp(samples["position"], axis=0).max() > 5e-3


def test_a_force_arrives_with_its_size_and_direction() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    force = (0.8, -0.5, 0.6)
    looped(bench, device, 100, force)
    np.testing.assert_allclose(bench.model.handle.force[:3], force, atol=5e-3)


def test_a_force_beyond_the_motors_keeps_its_direction() -> None:
    bench = Bench(SimulatedDevice(hand=None, mass=1e3))
    device = bench.opened()
    device.start(PERIOD)
    looped(bench, device, 5, (40.0, 10.0, -20.0))
    assert max(abs(units) for units in bench.model.motors) == 4096
    got = bench.model.handle.force[:3]
    np.testing.assert_allclose(
        got / np.linalg.norm(got), np.array([4, 1, -2]) / np.sqrt(21), atol=2e-3
    )
    assert 3.0 < np.linalg.norm(got) < 20.0


def test_a_force_that_is_not_finite_is_no_force() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    looped(bench, device, 3, (np.nan, 1.0, 0.0))
    assert bench.model.motors == (0, 0, 0)


@pytest.mark.parametrize("refused", [1, 20, 21])
def test_no_force_is_sent_until_it_is_taken_and_a_force_once(refused: int) -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    device.write(np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    write, left, sent = bench.link.write, refused, 0

    def full(packet: array.array[int], timeout_ms: int = 1) -> bool:
        nonlocal left, sent
        left, sent = left - 1, sent + 1
        return left < 0 and write(packet, timeout_ms)

    bench.link.write = full  # type: ignore[method-assign]
    device.write(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
    assert sent == 1
    left = refused
    if refused <= 20:
        device.write(np.zeros(6))
        bench.time.until(bench.time.now + PERIOD)
        assert bench.model.motors == (0, 0, 0)
    else:
        with pytest.raises(DeviceLost, match="did not accept zero force"):
            device.write(np.zeros(6))


def test_buttons_are_reported_with_the_pose() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    for buttons in range(16):
        bench.model.buttons = buttons
        assert looped(bench, device, 4)[0]["buttons"][-1] == buttons


def test_closing_takes_the_force_and_the_light_away() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    looped(bench, device, 10, (1.0, 0.0, 0.0))
    assert any(bench.model.motors)
    assert bench.model.lights == 2
    device.close()
    assert bench.model.motors == (0, 0, 0)
    assert bench.model.lights == 0
    assert bench.link.is_closed


def test_noise_before_every_reply_costs_no_sample() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    bench.model.faults.noise = b"\x00<AAAA\xff>"
    samples, flags, truth = looped(bench, device, 200)
    assert np.count_nonzero(flags == STALE) <= 2
    assert np.abs(samples["position"][2:] - truth[:-2]).max() < 0.2e-3


def test_replies_that_lack_a_byte_are_left_out_and_the_last_pose_stays() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    bench.model.faults.is_cut_short = True
    samples, flags, _ = looped(bench, device, 200)
    is_stale = flags == STALE
    assert 90 <= np.count_nonzero(is_stale) <= 110
    again = np.flatnonzero(is_stale[1:]) + 1
    assert (samples["position"][again] == samples["position"][again - 1]).all()


@pytest.mark.parametrize("counts", [9000, 300], ids=["out of reach", "a jump of millimetres"])
def test_a_reply_that_cannot_be_is_not_believed(counts: int) -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    looped(bench, device, 20)
    right = bench.model.encoders

    def wrong() -> tuple[int, ...]:
        first, *others = right()
        return (first + counts, *others)

    bench.model.encoders = wrong  # type: ignore[method-assign]
    samples, flags, _ = looped(bench, device, 20)
    assert (flags[3:] == STALE).all()
    assert (samples["position"][3:] == samples["position"][3]).all()
    bench.model.encoders = right  # type: ignore[method-assign]
    samples, flags, truth = looped(bench, device, 20)
    assert (flags[3:] == 0).all()
    assert np.abs(samples["position"][5:] - truth[3:-2]).max() < 0.2e-3


@pytest.mark.parametrize("fault", ["mute", "wrong"])
def test_a_falcon_without_a_believable_reply_for_50_ms_is_lost(fault: str) -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    looped(bench, device, 20)
    begin = bench.time.now
    if fault == "mute":
        bench.model.faults.is_mute = True
    else:
        bench.model.encoders = lambda: (9000, 9000, 9000)  # type: ignore[method-assign]
    with pytest.raises(DeviceLost, match="gave no usable reply for 50 ms"):
        looped(bench, device, 200)
    assert 0.049 < bench.time.now - begin < 0.055


def test_a_pause_of_the_loop_is_not_the_devices_silence() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    looped(bench, device, 20)
    bench.time.until(bench.time.now + 5e-3)
    sample = np.zeros(1, SAMPLE_DTYPE)
    device.read(sample)  # the last reply: nothing waits for the loop when it comes back
    bench.time.until(bench.time.now + 1.0)
    _, flags, _ = looped(bench, device, 20)
    assert (flags[3:] == 0).all()


@pytest.mark.parametrize(("stall", "is_asked_anew"), [(0.04, False), (0.2, True)])
def test_after_a_stall_the_force_is_gone_and_the_pose_is_the_present_one_before_the_tick_goes_on(
    stall: float, is_asked_anew: bool
) -> None:
    path = Motion([0.0, 5.0], [(-0.02, 0.0, 0.0), (0.18, 0.0, 0.0)])  # 40 mm/s
    bench = Bench(SimulatedDevice(mass=0.4, damping=2.0, path=path))
    device = bench.opened()
    device.start(PERIOD)
    looped(bench, device, 300, (-0.5, 0.0, 0.0))
    before = bench.time.now
    bench.time.until(before + stall)
    assert any(bench.model.motors)  # nothing takes it away while the host stands still
    sample = np.zeros(1, SAMPLE_DTYPE)
    assert device.read(sample) == 0
    error = np.linalg.norm(sample["position"][0] - bench.model.handle.pose()[0])
    assert (error < 0.2e-3) == is_asked_anew
    assert (bench.model.motors == (0, 0, 0)) == is_asked_anew
    waited = bench.time.now - before - stall
    assert 0.0 < waited < 5e-3 if is_asked_anew else waited == pytest.approx(0.0, abs=1e-9)


def test_a_falcon_that_answers_nothing_after_a_stall_is_lost() -> None:
    bench = Bench()
    device = bench.opened()
    device.start(PERIOD)
    looped(bench, device, 20)
    bench.model.halted = {0x02}
    bench.time.until(bench.time.now + 0.2)
    with pytest.raises(DeviceLost):
        device.read(np.zeros(1, SAMPLE_DTYPE))


def test_an_unplugged_or_halted_falcon_is_lost_in_the_same_tick() -> None:
    for fault in ("unplugged", "halted"):
        bench = Bench()
        device = bench.opened()
        device.start(PERIOD)
        looped(bench, device, 20)
        if fault == "unplugged":
            bench.time.is_plugged = False
        else:
            bench.model.halted |= {0x81, 0x02}
        begin = bench.time.now
        with pytest.raises(DeviceLost):
            looped(bench, device, 200)
        assert bench.time.now - begin < 2.1e-3
        device.close()


def test_a_rate_below_50_hz_and_a_read_before_the_start_are_refused() -> None:
    device = Bench().opened()
    with pytest.raises(DeviceError, match="the rate must be at least 50 Hz, not 40 Hz"):
        device.start(0.025)
    with pytest.raises(DeviceError, match="before it was started"):
        device.read(np.zeros(1, SAMPLE_DTYPE))
    device.start(0.02)


def test_encoders_that_no_grip_has_are_refused_at_the_start() -> None:
    bench = Bench()
    device = bench.opened()
    bench.model.encoders = lambda: (9000, 0, 0)  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"encoder counts \[9000, 0, 0\] match no position"):
        device.start(PERIOD)


def bridged(folder: Path, name: str, damping: float | None, duration: float) -> Path:
    """The peg behind the model in the hand that the scene asks for."""
    scene = load_scene("peg_in_hole")
    hand = device_for(scene, "simulated:mass=0.4,damping=2")
    assert isinstance(hand, SimulatedDevice)
    bench = Bench(hand)
    path = folder / name
    device = bench.opened(damping=damping)
    with Bridge(scene, device, recording=path, clock=bench.clock(2e-4)) as bridge:
        bridge.run(duration=duration)
    assert bench.model.motors == (0, 0, 0)
    return path


def test_the_peg_behind_a_falcon_is_passive_and_repeats_to_the_bit(tmp_path: Path) -> None:
    first, second = (bridged(tmp_path, f"{k}.mcap", 2.0, 2.5) for k in range(2))
    report = audit(first)
    assert (report.verdict, report.certified) == ("passive", None)
    assert report.resimulation == "bit for bit"
    assert "for a wall behind a delay of 2 ticks" in report.conditions[0]
    ticks = read_recording(first).ticks
    assert np.count_nonzero(ticks["flags"] & int(TickFlag.CONTACT)) > 100
    assert np.linalg.norm(ticks["wrench_on_device"][:, :3], axis=1).max() > 0.1
    assert ticks.tobytes() == read_recording(second).ticks.tobytes()


def test_a_falcon_pulled_out_in_mid_run_trips_and_no_row_is_lost(tmp_path: Path) -> None:
    bench = Bench()
    device = bench.opened()
    path = tmp_path / "run.mcap"

    def pulled(tick: int) -> None:
        if tick == 200:
            bench.time.is_plugged = False

    with pytest.raises(SafetyTrip, match=r"tick 20[0-2]: .*unplugged"):  # noqa: SIM117
        with Bridge("point_mass", device, recording=path, clock=bench.clock()) as bridge:
            bridge.run(duration=1.0, on_tick=pulled)
    recording = read_recording(path)
    assert not recording.is_cut
    assert len(recording.ticks) >= 200
    assert (np.diff(recording.ticks["tick"]) == 1).all()
    assert [e["event"] for e in recording.events].count("trip") == 1
