"""Motions from files and recordings, against NumPy's and SciPy's interpolation."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

import hapticbridge as hb
from hapticbridge.device import Motion, ReplayDevice, TrajectoryDevice, open_device, read_motion
from hapticbridge.device.base import Device
from hapticbridge.errors import DeviceError, RecordingError
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.recording import RecordingWriter

Array = NDArray[np.float64]
PERIOD = 1e-3


def run(device: Device, ticks: int, period: float = PERIOD) -> NDArray[np.void]:
    samples = np.zeros(ticks, SAMPLE_DTYPE)
    device.start(period)
    for k in range(ticks):
        device.read(samples[k : k + 1])
        device.write(np.full(6, 9.0))
    return samples


def rotations(quaternions: Array) -> Rotation:
    return Rotation.from_quat(quaternions[:, [1, 2, 3, 0]])  # SciPy puts w last


def recorded(count: int) -> NDArray[np.void]:
    rng = np.random.default_rng(3)
    ticks = np.zeros(count, TICK_DTYPE)
    ticks["tick"] = np.arange(count)
    ticks["device_position"] = rng.normal(0.0, 0.1, (count, 3))
    quaternions = rng.normal(size=(count, 4))
    quaternions[:, 0] = np.abs(quaternions[:, 0])
    ticks["device_quaternion"] = quaternions / np.linalg.norm(quaternions, axis=1)[:, None]
    ticks["buttons"] = rng.integers(0, 8, count)
    return ticks


@given(seed=st.integers(0, 10_000), period=st.floats(5e-4, 0.05))
@settings(max_examples=40)
def test_rows_are_interpolated_linearly_and_by_slerp(seed: int, period: float) -> None:
    rng = np.random.default_rng(seed)
    times = rng.uniform(-5.0, 5.0) + np.cumsum(rng.uniform(1e-3, 0.1, 8))
    positions = rng.normal(size=(8, 3))
    turned = Rotation.random(8, rng)
    motion = Motion(times, positions, turned.as_quat(scalar_first=True))
    samples = run(TrajectoryDevice(motion), 60, period)
    asked = np.minimum(times[0] + period * np.arange(60), times[-1])
    expected = np.column_stack([np.interp(asked, times, positions[:, i]) for i in range(3)])
    np.testing.assert_allclose(samples["position"], expected, atol=1e-11)
    difference = Slerp(times, turned)(asked).inv() * rotations(samples["quaternion"])
    # a row of 1 ms amplifies the rounding of the times, 1e-15 s, to 1e-12 of a turn
    assert difference.magnitude().max() < 1e-10


def test_at_the_time_of_a_row_the_sample_is_that_row_to_the_bit() -> None:
    rng = np.random.default_rng(9)
    turned = Rotation.random(30, rng).as_quat()[:, [3, 0, 1, 2]]
    motion = Motion(np.arange(30) * 0.5, rng.normal(size=(30, 3)), turned)
    samples = run(TrajectoryDevice(motion), 59, 0.25)[::2]
    assert samples["position"].tobytes() == motion.table[:, 1:4].tobytes()
    assert samples["quaternion"].tobytes() == motion.table[:, 4:].tobytes()


def test_the_first_sample_is_the_first_row_and_the_last_row_holds(tmp_path: Path) -> None:
    file = tmp_path / "hand.csv"
    file.write_text("t,x,y,z\n10.5,1,2,3\n10.5035,1.5,2,2\n")
    device = open_device(f"trajectory:{file}")
    assert device.info.duration == pytest.approx(0.0035, abs=1e-12)
    assert device.info.is_prescribed
    assert device.info.damping is None
    samples = run(device, 8)
    assert samples["position"][0].tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(samples["position"][1], [1 + 0.5 / 3.5, 2.0, 3 - 1 / 3.5])
    assert samples["position"][4:].tolist() == [[1.5, 2.0, 2.0]] * 4
    assert samples["quaternion"].tolist() == [[1.0, 0.0, 0.0, 0.0]] * 8


def test_columns_may_come_in_any_order_with_comments_and_any_line_ends(tmp_path: Path) -> None:
    file = tmp_path / "a, b: c=1.csv"
    text = """\ufeff# a hand at 2 Hz\r\n\r\n"qz", "z","t",x,QW,y,qx,qy\r
 0, 3e0, 0, 1, -1.0004, 2, 0, 0\r\n# half time\r\n0.6,3,0.5,1,0.8,2,0,0\r\n"""
    file.write_bytes(text.encode())
    table = read_motion(file).table
    expected = np.array([[0, 1, 2, 3, 1, 0, 0, 0], [0.5, 1, 2, 3, 0.8, 0, 0, 0.6]])
    np.testing.assert_allclose(table, expected, rtol=0, atol=1e-15)
    assert run(open_device(f"trajectory:{file}"), 1)["position"].tolist() == [[1.0, 2.0, 3.0]]


HEADER = "t,x,y,z\n"
GOOD = HEADER + "0,0,0,0\n1,0,0,0\n"
TURNED = "t,x,y,z,qw,qx,qy,qz\n"


@pytest.mark.parametrize(
    "text",
    [
        "t;x;y;z\n0;0;0;0\n0,5;0,01;-1e-3;0\n",
        "t\tx\ty\tz\n0\t0\t0\t0\n.5\t.01\t-.001\t0\n",
        '"t", "x","y","z"\n"0","0","0","0"\n"0.5", ".01","-.001",0\n',
    ],
    ids=["semicolons and decimal commas", "tabs", "quotes"],
)
def test_columns_may_be_separated_as_other_programs_do(tmp_path: Path, text: str) -> None:
    file = tmp_path / "motion.csv"
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        file.write_text(text, encoding=encoding)
        assert read_motion(file).table[1, :4].tolist() == [0.5, 0.01, -0.001, 0.0]
    file.write_bytes(text.encode("utf-16")[:-1])
    with pytest.raises(DeviceError, match="not UTF-16 text"):
        read_motion(file)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty; it needs a header t,x,y,z and two rows"),
        ("# only this\n", "the file is empty"),
        (HEADER, "line 1: the file ends after 0 of at least two rows"),
        (HEADER + "0,1,2,3\n", "line 2: the file ends after 1 of at least two rows"),
        ("t,x,z\n0,0,0\n1,0,0\n", "line 1: column y is missing; a header with the columns t,x,y,z"),
        ("#\ntime,x,y,z\n", "line 2: column t is missing"),
        ("t,x,y,z,w\n", "line 1: unknown column 'w'"),
        ("t,x,y,z,x\n", "line 1: column x occurs twice"),
        ("t,x,y,z,qw,qx\n", "line 1: column qy, qz is missing; an orientation needs all"),
        ("0,0,0,0\n1,0,0,0\n", "line 1: numbers where a header"),
        (HEADER + "0,0,0,0\n\n1,0,zero,0\n", "line 4: column 'y' holds 'zero'"),
        (HEADER + "0,0,0,0\n1,0,,0\n", "line 3: column 'y' holds ''"),
        (HEADER + "0,0,0,0\n1,0,0,nan\n", "line 3: z = nan is not finite"),
        (HEADER + "0,0,0,0\n1,-inf,0,0\n", "line 3: x = -inf is not finite"),
        (HEADER + "0,0,0,0\n1,0,0,1e999\n", "line 3: z = inf is not finite"),
        (HEADER + "0,0,0,0\n1,0,0,0\n#\n1,0,0,0\n", "line 5: time 1 s after 1 s; times must str"),
        (HEADER + "0,0,0,0\n-1,0,0,0\n", "line 3: time -1 s after 0 s"),
        (HEADER + "-1e308,0,0,0\n1e308,0,0,0\n", "line 2: t = -1e+308 is beyond ±1e+12"),
        (TURNED + "0,0,0,0,1,0,0,0\n1,0,0,0,1,0.05,0,0\n", "line 3: quaternion of norm 1.00125"),
        (TURNED + "0,0,0,0,0,0,0,0\n1,0,0,0,1,0,0,0\n", "line 2: quaternion of norm 0"),
        (TURNED + "0,0,0,0,1e200,0,0,0\n1,0,0,0,1,0,0,0\n", "line 2: qw = 1e+200 is beyond"),
        (GOOD + "2,0,0\n", "line 4: 3 fields where the header names 4 columns"),
        (GOOD + "2,0,0,0,0\n", "line 4: 5 fields"),
        # two faults: the earlier line is named
        (HEADER + "0,0,0,0\n0,0,0,0\n1,0,nan,0\n", "line 3: time 0 s after 0 s"),
    ],
)
def test_bad_files_are_refused_with_name_and_line(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "hand.csv"
    file.write_text(text)
    with pytest.raises(DeviceError) as error:
        open_device(f"trajectory:{file}")
    assert str(file) in str(error.value)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "utf-32", "utf-32-be"])
def test_text_of_another_encoding_is_named_as_that(encoding: str, tmp_path: Path) -> None:
    """Its columns are there, and separated by commas."""
    file = tmp_path / "hand.csv"
    file.write_bytes(GOOD.encode(encoding))
    with pytest.raises(DeviceError, match=r"line 1: holds a NUL .* write the table in UTF-8"):
        read_motion(file)


def test_a_button_of_a_motion_without_buttons_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "hand.csv"
    file.write_text(GOOD)
    for options in (hb.BridgeOptions(clutch=0), hb.BridgeOptions(dead_man=0)):
        with pytest.raises(DeviceError, match="button 0, and the device 'trajectory' has none"):
            hb.Bridge("point_mass", f"trajectory:{file}", options=options)


def test_no_text_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    binary, fifo, closed = (tmp_path / name for name in ("hand.csv", "pipe.csv", "closed.csv"))
    binary.write_bytes(b"t,x,y,z\n0,0,0,0\n1,\xff\xfe,0,0\n")
    closed.write_text(GOOD)
    os.mkfifo(fifo)
    read_text = Path.read_text

    def denied(path: Path, *_: Any, **__: Any) -> str:  # root may read everything
        if path == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return read_text(path, encoding="utf-8")

    monkeypatch.setattr(Path, "read_text", denied)
    for path, words in [
        (binary, "line 3: not UTF-8 text"),
        (tmp_path / "no.csv", "no such file"),
        (tmp_path, "is a directory"),
        (fifo, "is not a regular file"),
        (Path("a\0b"), "cannot be read (embedded null byte)"),
        (tmp_path / ("n" * 300), "cannot be read (File name too long)"),
        (closed, "cannot be read (Permission denied)"),
    ]:
        with pytest.raises(DeviceError, match=re.escape(words)):
            open_device(f"trajectory:{path}")


def test_arrays_that_are_no_motion_are_refused() -> None:
    for times, positions, words in [
        ([0.0], np.zeros((1, 3)), "n >= 2"),
        ([0.0, 1.0], np.zeros((3, 3)), "must be (n,), (n, 3) and (n, 4)"),
        ([0.0, 0.0], np.zeros((2, 3)), "row 1 of the motion: time 0 s after 0 s"),
        ([0.0, 1.0], np.full((2, 3), np.nan), "row 0 of the motion: x = nan"),
    ]:
        with pytest.raises(DeviceError, match=re.escape(words)):
            Motion(times, positions)


def test_a_relative_motion_starts_at_the_origin_in_the_same_axes() -> None:
    rng = np.random.default_rng(7)
    turned = Rotation.random(5, rng)
    motion = Motion(np.arange(5.0), rng.normal(size=(5, 3)), turned.as_quat()[:, [3, 0, 1, 2]])
    relative = motion.relative().table
    assert relative[0].tolist() == pytest.approx([0, 0, 0, 0, 1, 0, 0, 0])
    np.testing.assert_allclose(relative[:, 1:4], motion.table[:, 1:4] - motion.table[0, 1:4])
    difference = (turned * turned[0].inv()).inv() * rotations(relative[:, 4:])
    assert difference.magnitude().max() < 1e-12


def test_a_recording_is_replayed_sample_by_sample_with_its_buttons() -> None:
    ticks = recorded(20)
    device = ReplayDevice(ticks, PERIOD)
    assert device.info.duration == pytest.approx(0.019)
    assert device.info.rate == pytest.approx(1000.0)
    assert device.info.is_prescribed
    samples = run(device, 25)
    sources = ("device_position", "device_quaternion", "buttons")
    for field, source in zip(("position", "quaternion", "buttons"), sources, strict=True):
        assert samples[field][:20].tobytes() == ticks[source].tobytes()
        assert samples[field][20:].tobytes() == ticks[source][[19] * 5].tobytes()


def test_a_recording_is_opened_by_its_name_or_its_first_bytes(tmp_path: Path) -> None:
    ticks = recorded(300)
    for name in ("run.mcap", "run.txt"):
        writer = RecordingWriter(tmp_path / name, {"period_s": "0.001"}, (), 0)
        writer.write_ticks(ticks)
        writer.close()
        device = open_device(f"trajectory:{tmp_path / name}", force_limit=4)
        assert device.info.force_limit == 4.0
        samples = run(device, 300)
        assert samples["position"].tobytes() == ticks["device_position"].tobytes()
    writer = RecordingWriter(tmp_path / "old.mcap", {}, (), 0)
    writer.write_ticks(ticks)
    writer.close()
    with pytest.raises(DeviceError, match=r"old\.mcap: the recording lacks its period"):
        open_device(f"trajectory:{tmp_path / 'old.mcap'}")
    with pytest.raises(RecordingError, match=r"none\.mcap"):
        open_device(f"trajectory:{tmp_path / 'none.mcap'}")


def test_a_recording_at_another_rate_is_refused_with_both() -> None:
    device = ReplayDevice(recorded(20), 2e-3, name="old.mcap")
    with pytest.raises(DeviceError, match=r"old\.mcap: was recorded at 500 Hz.* at 1000 Hz"):
        device.start(PERIOD)
    device.start(0.002 * (1 + 1e-15))


def test_a_recording_that_is_no_motion_is_refused() -> None:
    lost, tripped, unturned = recorded(20), recorded(20), recorded(20)
    lost["tick"][7:] += 3
    tripped["device_position"][19, 1] = np.nan
    unturned["device_quaternion"][4] = 0.0
    for ticks, words in [
        (recorded(1), "holds 1 of at least two ticks"),
        (lost, "tick 6 is followed by tick 10"),
        (tripped, "pose at tick 19 is not finite"),
        (unturned, "pose at tick 4"),
    ]:
        with pytest.raises(DeviceError, match=f"^run.mcap: .*{words}"):
            ReplayDevice(ticks, PERIOD, name="run.mcap")
