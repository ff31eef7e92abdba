"""The real drivers on emulated devices, through real libraries and, in Linux, a real kernel."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from board_attack import built_loop
from emulated.falcon_model import Faults
from emulated.spacemouse_model import SpaceMouse
from emulated.usb_device import UsbDevice
from firmware_build import COMPILER
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.cli.main import main
from hapticbridge.device import Device
from hapticbridge.device.discovery import plugged_devices
from hapticbridge.errors import DeviceError, DeviceLost, SafetyTrip
from hapticbridge.kernel.record import SAMPLE_DTYPE
from usb_tiers import benches
from usb_tiers.benches import usable_devices, wait_for
from usb_tiers.conftest import Plug

PERIOD = 1e-3

FORCE, PUSHED = 0.5, 0.2
"""N, and s for which devices are pushed: 11 mm, far beyond their steps and within their travel."""


def _opened(specification: str, count: int = 1) -> Device:
    wait_for(lambda: len(usable_devices()) >= count)
    device = hb.open_device(specification)
    device.start(PERIOD)
    return device


def _held(device: Device, seconds: float, force: tuple[float, float, float]) -> NDArray[np.float64]:
    """Holds a force for a time at the loop's rate; returns the last position."""
    sample, wrench = np.zeros(1, SAMPLE_DTYPE), np.array([*force, 0.0, 0.0, 0.0])
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        device.read(sample)
        device.write(wrench)
        time.sleep(PERIOD)
    device.read(sample)
    return np.array(sample["position"][0])


def _require_pushed(device: Device) -> None:
    """Pushes mass and damping along x by a constant force; asserts that they move, only there."""
    start = _held(device, 0.01, (0.0, 0.0, 0.0))
    rate = benches.DAMPING / benches.MASS
    expected = FORCE / benches.DAMPING * (PUSHED - (1.0 - math.exp(-rate * PUSHED)) / rate)
    moved = _held(device, PUSHED, (FORCE, 0.0, 0.0)) - start
    # steps of encoders and motors, and some ms on the way
    assert moved[0] == pytest.approx(expected, rel=0.1)
    assert np.abs(moved[1:]).max() < 0.3e-3


def _refuses_to_go_on(device: Device) -> str:
    """Runs until the device is lost; returns what it says."""
    with pytest.raises(DeviceLost) as lost:
        _held(device, 5.0, (0.0, 0.0, 0.0))
    device.close()
    return str(lost.value)


def test_a_written_force_moves_a_falcon_as_its_mass_and_damping_say(plug_usb: Plug) -> None:
    plug_usb(benches.free_falcon)
    with closing(_opened("falcon")) as device:
        _require_pushed(device)


def test_a_written_force_moves_a_home_made_device_alike(plug_hid_each_way: Plug) -> None:
    plug_hid_each_way(benches.free_rawhid)
    with closing(_opened("rawhid")) as device:
        _require_pushed(device)


@pytest.mark.parametrize("is_odd", [False, True], ids=["usual", "odd"])
def test_a_written_force_moves_a_force_feedback_stick_alike(
    plug_hid_each_way: Plug, is_odd: bool
) -> None:
    model = plug_hid_each_way(lambda: benches.free_stick(is_odd=is_odd))
    with closing(_opened(benches.STICK)) as device:
        _require_pushed(device)
        assert model.call("force") == pytest.approx((FORCE, 0.0), abs=2e-3 * benches.NEWTONS)
    assert model.call("force") == (0.0, 0.0)


def test_a_stick_lets_go_of_a_host_that_says_nothing_any_more(plug_usb: Plug) -> None:
    model = plug_usb(benches.free_stick)
    device = _opened(benches.STICK)
    _held(device, 0.05, (0.5, 0.0, 0.0))
    assert model.call("force") != (0.0, 0.0)
    life = max(effect.duration for effect in model.get("effects").values())
    assert life <= 0.4
    time.sleep(1.1 * life)
    assert model.call("force") == (0.0, 0.0)
    device.close()


def test_a_falcon_takes_its_program_and_then_speaks(plug_usb: Plug, tmp_path: Path) -> None:
    model = plug_usb(benches.unloaded_falcon)
    file = tmp_path / "program.bin"
    file.write_bytes(benches.PROGRAM)
    with pytest.raises(DeviceError, match="firmware"):
        _opened("falcon")
    device = _opened(f"falcon:firmware={file}")
    device.close()
    assert model.get("uploaded") == benches.PROGRAM


def test_a_falcon_with_the_wrong_program_is_refused(plug_usb: Plug, tmp_path: Path) -> None:
    plug_usb(benches.unloaded_falcon)
    file = tmp_path / "wrong.bin"
    file.write_bytes(benches.PROGRAM[::-1])
    with pytest.raises(DeviceError, match="with its firmware"):
        _opened(f"falcon:firmware={file}")


def test_garbage_between_a_falcons_packets_changes_no_pose(plug_usb: Plug) -> None:
    model = plug_usb(benches.free_falcon)
    device = _opened("falcon")
    clean = _held(device, 0.02, (0.0, 0.0, 0.0))
    model.set("faults", Faults(noise=b"\x00<AAAAAA>\xff<<"))
    noisy = _held(device, 0.1, (0.0, 0.0, 0.0))
    device.close()
    assert noisy.tolist() == clean.tolist()


def test_damaged_frames_of_a_home_made_device_change_no_pose(plug_usb: Plug) -> None:
    model = plug_usb(benches.free_rawhid)
    device = _opened("rawhid")
    frames = model.get("frames")
    model.set("damage", set(range(frames, frames + 10_000, 2)))
    moved = _held(device, 0.1, (0.0, 0.0, 0.0))
    assert moved.tolist() == [0.0, 0.0, 0.0]
    assert int(device.remark.split()[-2]) > 10  # type: ignore[attr-defined]
    device.close()


def test_a_stalled_endpoint_ends_a_run_in_words(plug_usb: Plug) -> None:
    model = plug_usb(benches.falcon)
    device = _opened("falcon")
    model.set("halted", {0x81})
    assert "halted" in _refuses_to_go_on(device)


def test_two_home_made_devices_at_once_are_told_apart(plug_usb: Plug) -> None:
    for serial in ("left", "right"):
        plug_usb(lambda serial=serial: benches.free_rawhid(serial))  # type: ignore[misc]
    wait_for(lambda: len(usable_devices()) == 2)
    with pytest.raises(DeviceError, match=r"left.*right|right.*left"):
        hb.open_device("rawhid")
    left, right = (_opened(f"rawhid:serial={serial}", 2) for serial in ("left", "right"))
    still = _held(right, 0.01, (0.0, 0.0, 0.0))
    _require_pushed(left)
    assert _held(right, 0.01, (0.0, 0.0, 0.0)).tolist() == still.tolist()
    left.close()
    right.close()


@pytest.mark.parametrize("has_long_reports", [False, True], ids=["short", "long"])
def test_a_deflected_spacemouse_moves_the_handle(
    plug_hid_each_way: Plug, has_long_reports: bool
) -> None:
    plug_hid_each_way(lambda: SpaceMouse(_deflected, has_long_reports=has_long_reports))
    device = _opened("spacemouse")
    moved = _held(device, 0.3, (0.0, 0.0, 0.0))
    device.close()
    assert moved[0] > 1e-3
    assert np.abs(moved[1:]).max() < 0.1 * moved[0]


def _deflected(now: float) -> tuple[float, ...]:
    """Half way to the right, and no more."""
    return (0.5, 0.0, 0.0, 0.0, 0.0, 0.0)


def _still(now: float) -> tuple[float, ...]:
    return (0.0,) * 6


@pytest.mark.usefixtures("no_spin")
def test_a_falcon_turns_the_nut_of_a_bolt_that_a_spacemouse_holds(
    plug_usb: Plug, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plug_usb(benches.turning_falcon)
    wait_for(usable_devices)
    plug_usb(lambda: SpaceMouse(_still))
    wait_for(lambda: len(usable_devices()) == 2)
    file = tmp_path / "run.mcap"
    hands = ["--hand", f"wrench={benches.FALCON}", "--hand", "bolt=spacemouse"]
    duration = ["--duration", f"{TURN:g}", "--record", str(file)]
    status = main(["run", "nut_and_wrench", *hands, *duration])
    assert status in (0, 1), capsys.readouterr().err
    spanner, bolt = (hb.read_recording(file, hand=each).ticks for each in (0, 1))
    moved = np.ptp(spanner["device_position"], axis=0)
    assert moved[1] > 5e-3
    # the falcon feels the nut, and the hand at the bolt bears it, without a motor to tell
    assert np.abs(spanner["wrench_on_device"][:, :3]).max() > 0.3
    assert np.abs(bolt["wrench_on_tool"][:, 5]).max() > 0.03
    report = hb.audit(file, in_process=True)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


TURN = 0.8
"""Time in s for which the nut is turned: one rest and one stroke of the hand."""


def _pulled_out_of_a_run(
    plug: Plug, make: Callable[[], UsbDevice], specification: str, folder: Path
) -> None:
    """Pulls a device out half a second after its run's start, and plugs it in again.

    No row may be lost before that.
    """
    model, file = plug(make), folder / "run.mcap"
    wait_for(usable_devices)
    times: list[float] = []

    def on_tick(tick: int) -> None:
        times.append(time.monotonic())
        if tick == 0:
            model.unplug(after=0.5)

    with (
        pytest.raises(SafetyTrip, match=r"gone|takes no reports"),
        hb.Bridge("peg_in_hole", specification, recording=file) as bridge,
    ):
        bridge.run(5.0, on_tick)
    recording = hb.read_recording(file)
    ticks = recording.ticks["tick"]
    assert ticks.tolist() == list(range(len(ticks)))
    # the tick in which the device was found to be gone may have its row or not
    assert len(times) - len(ticks) in (0, 1)
    assert any(event["event"] == "trip" for event in recording.events)
    # times are those of the ticks' beginnings, one period before the next
    assert 0.5 - PERIOD <= times[-1] - times[0] <= 0.502
    wait_for(lambda: not plugged_devices())
    plug(make)
    _opened(specification).close()


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")
@pytest.mark.usefixtures("no_spin")
def test_a_board_renders_a_wall_by_itself(plug_usb: Plug, tmp_path: Path) -> None:
    library, file = built_loop(tmp_path), tmp_path / "run.mcap"
    model = plug_usb(lambda: benches.board(library))
    wait_for(usable_devices)
    with hb.Bridge("virtual_wall", "rawhid", recording=file) as bridge:
        summary = bridge.run(3.0)  # a whole tap comes after the ramp, whenever the run begins
    own = summary.certification.own_loop
    assert own is not None
    assert own.excess_tick < 0
    assert summary.peak_force > 1.0
    assert model.get("work") < model.get("burned") + 1e-6
    assert hb.audit(file, in_process=True).verdict == "passive"


@pytest.mark.usefixtures("no_spin")
def test_a_falcon_pulled_out_of_a_run_comes_back(plug_usb: Plug, tmp_path: Path) -> None:
    _pulled_out_of_a_run(plug_usb, benches.falcon, benches.FALCON, tmp_path)


@pytest.mark.usefixtures("no_spin")
def test_a_home_made_device_pulled_out_of_a_run_comes_back(plug_usb: Plug, tmp_path: Path) -> None:
    _pulled_out_of_a_run(plug_usb, benches.rawhid, "rawhid", tmp_path)


@pytest.mark.usefixtures("no_spin")
def test_a_stick_pulled_out_of_a_run_comes_back(plug_usb: Plug, tmp_path: Path) -> None:
    _pulled_out_of_a_run(plug_usb, benches.stick, benches.STICK, tmp_path)
