"""The contract that every device fulfils, and the refusals of data sheets and specifications."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import re
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from device_benches import PERIOD, FalconBench, HaplyBench, paddle
from emulated.dhd_stub import OMEGA3, SIGMA7, Stub
from emulated.evdev_model import WheelModel
from emulated.hd_stub import HdStub
from emulated.hid_seam import HidSeam, Timed
from emulated.pid_layouts import ODD
from emulated.pid_model import PidStick
from emulated.rawhid_model import Claims, RawHid
from emulated.serial_seam import SerialSeam, VirtualPort
from emulated.spacemouse_model import SpaceMouse
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticbridge as hb
from hapticbridge.clock import RealClock, SimulatedClock
from hapticbridge.device import (
    AXES,
    Device,
    DeviceInfo,
    Hand,
    ReplayDevice,
    SimulatedDevice,
    open_device,
)
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.mouse import MouseDevice
from hapticbridge.device.pid.device import open_pid
from hapticbridge.device.rawhid.device import open_rawhid
from hapticbridge.device.rawhid.serial import open_serial
from hapticbridge.device.spacemouse import open_spacemouse
from hapticbridge.device.wheel.device import open_wheel
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE, TickFlag
from hapticbridge.testing.device_contract import CONTRACT, Check


def written(path: Path) -> Path:
    rng = np.random.default_rng(8)
    quaternions = rng.normal(size=(40, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    rows = np.column_stack([0.005 * np.arange(40), rng.normal(0.0, 0.02, (40, 3)), quaternions])
    np.savetxt(path, rows, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    return path


def replayed(_: Path) -> Device:
    ticks = np.zeros(200, TICK_DTYPE)
    ticks["tick"] = np.arange(200)
    ticks["device_position"][:, 1] = np.linspace(0.0, 0.1, 200)
    ticks["device_quaternion"][:, 0] = 1.0
    return ReplayDevice(ticks, PERIOD)


def pushed(when: float) -> tuple[float, ...]:
    return (0.5, -0.2, 0.3, 0.4, 0.1, 1.0) if when < 0.2 else (0.0,) * 6


Built = tuple[Device, Timed, Callable[[], Iterable[float]]]
"""A driver, the time of its emulated device, and what the device's motors give."""


class Ticking:
    """A real driver and an emulated device as one, moved by one period before each read.

    Each start takes a new device out of the box, so that two runs can be alike.

    Args:
        build: Makes the driver and what its device is plugged into.
    """

    def __init__(self, build: Callable[[], Built]) -> None:
        self.build, self.is_used = build, False
        self.device, self.seam, self.motors = build()
        self.info = self.device.info

    def start(self, period: float) -> NDArray[np.void]:
        if self.is_used:
            self.device, self.seam, self.motors = self.build()
        sample, self.is_used = self.device.start(period), True
        self.period, self.next = period, self.seam.now
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        if self.is_used:
            self._advance()
        return self.device.read(sample)

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.device.write(wrench)

    def close(self) -> None:
        self.device.close()

    def force(self) -> Iterable[float]:
        """Returns what the motors give a period later."""
        self._advance()
        return self.motors()

    def _advance(self) -> None:
        self.seam.advance(self.next)
        self.next += self.period


def ticking(
    model: Callable[[], RawHid | PidStick | SpaceMouse], opener: Callable[..., Device]
) -> Device:
    """Returns a real driver on an emulated device that lives in virtual time."""

    def build() -> Built:
        plugged = model()
        seam = HidSeam(plugged)
        return opener({}, ignore_message, seam), seam, lambda: motors_of(plugged)

    return Ticking(build)


def motors_of(device: RawHid | PidStick | SpaceMouse) -> Iterable[float]:
    if isinstance(device, RawHid):
        return device.wrench
    return device.force() if isinstance(device, PidStick) else ()


def falcon(_: Path) -> Device:
    def build() -> Built:
        bench = FalconBench()
        return bench.opened(), bench.time, lambda: bench.model.motors

    return Ticking(build)


def haply(_: Path) -> Device:
    def build() -> Built:
        bench = HaplyBench()
        return bench.opened(), bench.time, lambda: bench.service.devices["049D"].force

    return Ticking(build)


def verse_grip(_: Path) -> Device:
    def build() -> Built:
        bench = HaplyBench()
        bench.service.orientation = {"w": 0.6, "x": 0.0, "y": 0.8, "z": 0.0}
        return bench.opened(), bench.time, lambda: bench.service.devices["049D"].force

    return Ticking(build)


def wheel(_: Path) -> Device:
    def build() -> Built:
        model = WheelModel(SimulatedDevice())
        device = open_wheel({"max_torque": 2.0, "range": 900.0}, ignore_message, model)
        return device, model, lambda: [model.torque() if model.files else 0.0]

    return Ticking(build)


def force_dimension(kind: int) -> Device:
    def build() -> Built:
        stub = Stub(kind)
        return stub.opened(), stub, stub.force

    return Ticking(build)


def touch(_: Path) -> Device:
    def build() -> Built:
        stub = HdStub()
        return stub.opened(), stub, stub.force

    return Ticking(build)


def serial(_: Path) -> Device:
    def build() -> Built:
        board = RawHid(SimulatedDevice(), Claims(rate=500.0))
        seam = SerialSeam(board)
        return open_serial({}, ignore_message, seam), VirtualPort(seam), lambda: board.wrench

    return Ticking(build)


class Dragged(MouseDevice):
    """A mouse that is dragged aside as soon as it is started."""

    def start(self, period: float) -> NDArray[np.void]:
        sample = super().start(period)
        self.aim((0.02, 0.0, -0.01, 0.8, 0.0, 0.6, 0.0))
        return sample


DEVICES: dict[str, Callable[[Path], Device]] = {
    "simulated": lambda _: open_device("simulated"),
    "free": lambda _: open_device("simulated:hand=none,damping=0"),
    "rough": lambda _: open_device(
        "simulated:friction=0.4,resolution=1e-5,rotational_resolution=1e-3,delay=3"
    ),
    "guided": lambda path: open_device("simulated", path=written(path / "hand.csv")),
    "trajectory": lambda path: open_device(f"trajectory:{written(path / 'hand.csv')}"),
    "replay": replayed,
    "rawhid": lambda _: ticking(lambda: RawHid(SimulatedDevice()), open_rawhid),
    "paddle": lambda _: ticking(paddle, open_rawhid),
    "serial": serial,
    "mouse": lambda _: Dragged(),
    "spacemouse": lambda _: ticking(lambda: SpaceMouse(pushed), open_spacemouse),
    "new spacemouse": lambda _: ticking(
        lambda: SpaceMouse(pushed, has_long_reports=True), open_spacemouse
    ),
    "falcon": falcon,
    "haply": haply,
    "verse grip": verse_grip,
    "omega.3": lambda _: force_dimension(OMEGA3),
    "sigma.7": lambda _: force_dimension(SIGMA7),
    "touch": touch,
    "wheel": wheel,
    "stick": lambda _: ticking(lambda: PidStick(SimulatedDevice()), open_pid),
    "odd stick": lambda _: ticking(lambda: PidStick(SimulatedDevice(), ODD), open_pid),
}


@pytest.mark.parametrize("name", DEVICES)
@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_a_device_fulfils_the_contract(check: Check, name: str, tmp_path: Path) -> None:
    device = DEVICES[name](tmp_path)
    force = device.force if isinstance(device, Ticking) else None
    check(device, force=force, clock=SimulatedClock())


class OwnTime(SimulatedClock):
    """Time of a device that moves whether it is read or not."""

    name = RealClock.name

    def spend(self, seconds: float) -> None:
        self._now += round(1e9 * seconds)


class Crooked(SimulatedDevice):
    """A device with one fault, or with none."""

    def __init__(self, fault: str, time: OwnTime | None = None) -> None:
        super().__init__()
        self.fault, self.starts, self.closings, self.reads = fault, 0, 0, 0
        self.time = time or OwnTime()
        if fault == "prescribed":
            self.info = dataclasses.replace(self.info, is_prescribed=True)
        if fault == "plane":
            self.info = dataclasses.replace(self.info, axes=("x", "y"))
        if fault == "turned":
            self.info = dataclasses.replace(self.info, axes=("x", "y", "z"))
        if fault == "real":
            self.info = dataclasses.replace(self.info, is_real=True)
        if fault == "fast":
            self.info = dataclasses.replace(self.info, reach=100.0)

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        if self.fault == "period":
            period = 1e-3
        self.starts += 1
        return super().start(period, parts)

    def read(self, sample: NDArray[np.void]) -> int:
        if self.fault == "before" and not self.starts:
            return 0
        buttons = sample["buttons"].copy()
        flags = super().read(sample)
        self.reads += 1
        if self.fault == "infinite" and self.reads == 200:
            sample["position"][0, 1] = math.inf
        if self.fault == "norm":
            sample["quaternion"] *= 1.0 + 1e-9
        if self.fault == "sign":
            sample["quaternion"] *= -1.0
        if self.fault == "still":
            sample["position"] = 0.0
        if self.fault == "unwritten":
            sample["buttons"] = buttons
        if self.fault == "again":
            sample["position"][0, 0] += 1e-9 * self.starts
        if self.fault == "plane":
            sample["position"][0, 2] = 0.01
        if self.fault in ("millimetres", "fast"):
            sample["position"] *= 1000.0
        if self.fault == "waits":
            self.time.spend(0.05)
        return None if self.fault == "none" else flags  # type: ignore[return-value]

    def write(self, wrench: NDArray[np.float64]) -> None:
        super().write(wrench)
        if self.fault == "waits to write":
            self.time.spend(0.05)

    def close(self) -> None:
        self.closings += 1
        if self.fault == "pushes on":
            return
        if self.fault == "close" and self.closings > 1:
            raise DeviceError("closed twice")
        super().close()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("infinite", "a position is not finite"),
        ("norm", "a quaternion has the norm 1.000000001"),
        ("sign", "a quaternion has qw < 0; negate it"),
        ("still", "the device did not move within 300 ticks"),
        ("unwritten", "read() leaves 'buttons' unwritten"),
        ("again", "a second run differs; start() must reset all"),
        ("prescribed", "is_prescribed is True, but the wrench moved it"),
        ("close", "closed twice"),
        ("period", "start(0.0) must raise DeviceError"),
        ("before", "read before start() must raise DeviceError"),
        ("none", "read() returned None; it must be 0, or TickFlag.STALE_SAMPLE"),
        ("waits", "read() waits: more than 10% of the calls took over 0.5 ms; take what"),
        ("waits to write", "write() waits: more than 10% of the calls took over 0.5 ms"),
        ("pushes on", "close() leaves the force on: write a zero force first"),
        ("real", "the motors of a real device must be seen: name them as check(device, force="),
        ("plane", "z reaches 0.01 m, but the data sheet has no axis z"),
        ("turned", "the quaternion turns about rx, but the data sheet has no axis rx"),
        ("millimetres", "m from the origin, farther than 2 m: report metres, or state the reach"),
        ("fast", "over 2 times its speed_limit of 5 m/s: report metres, or state its speed"),
    ],
)
def test_the_contract_names_what_a_device_breaks(fault: str, words: str) -> None:
    assert words in " | ".join(broken_clauses(lambda time: Crooked(fault, time)))


def broken_clauses(build: Callable[[OwnTime], Device], **options: Any) -> list[str]:
    """Returns the messages of the checks that a device fails."""
    broken = []
    for check in CONTRACT:
        time = OwnTime()
        try:
            check(build(time), clock=time, **options)
        except (AssertionError, DeviceError) as error:
            broken.append(str(error))
    return broken


class Streaming(Crooked):
    """A correct driver of hardware that moves in its own time; a read returns the newest sample."""

    def __init__(self, time: OwnTime, *, lets_go: bool = True) -> None:
        super().__init__("real", time)
        self.lets_go, self.newest = lets_go, np.zeros(1, SAMPLE_DTYPE)

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        self.newest = super().start(period, parts)
        self.seen = self.time.now()
        return self.newest.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        if not self.starts:
            raise DeviceError("call start() first")
        is_new = self.time.now() >= self.seen + 2_000_000  # the hardware is half as fast
        while self.time.now() >= self.seen + 2_000_000:
            super().read(self.newest)
            self.seen += 2_000_000
        sample[0] = self.newest[0]
        return 0 if is_new else int(TickFlag.STALE_SAMPLE)

    def force(self) -> list[float]:
        return self.stepper[0]["written"][0].tolist()  # type: ignore[no-any-return]

    def close(self) -> None:
        if self.lets_go:
            super().close()


def test_a_driver_of_hardware_with_a_time_of_its_own_fulfils_the_contract() -> None:
    units: list[Streaming] = []

    def build(time: OwnTime, *, lets_go: bool = True) -> Device:
        units.append(Streaming(time, lets_go=lets_go))
        return units[-1]

    def force() -> list[float]:
        return units[-1].force()

    assert broken_clauses(build, force=force) == []
    assert broken_clauses(Streaming) == [
        "the motors of a real device must be seen: name them as check(device, force=unit.force)"
    ]
    assert broken_clauses(lambda time: build(time, lets_go=False), force=force) == [
        "close() leaves the force on: write a zero force first"
    ]
    assert broken_clauses(build, force=lambda: [0.0] * 6) == [
        "force= reports no force, although one was written"
    ]


def test_a_failed_check_closes_the_device() -> None:
    device = Crooked("none")
    with pytest.raises(AssertionError):
        CONTRACT[1](device, clock=device.time)
    assert device.closings == 1


@pytest.mark.parametrize(
    "name", ["rawhid", "haply", "omega.3", "sigma.7", "touch", "wheel", "stick"]
)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_force_that_is_not_finite_is_not_sent(name: str, value: float, tmp_path: Path) -> None:
    device = DEVICES[name](tmp_path)
    device.start(PERIOD)
    for axis in [AXES.index(device.info.axes[0]), AXES.index(device.info.axes[-1])]:
        with pytest.raises(DeviceError, match="that is not finite was not sent"):
            device.write(np.where(np.arange(6) == axis, value, 0.0))


INFO = SimulatedDevice().info

positive = st.floats(1e-300, 1e300)
unknown_or_positive = st.none() | positive
at_least_zero = st.floats(0.0, 1e300)


unknown_or_not_negative = st.none() | at_least_zero
some_axes = st.sets(st.sampled_from(AXES), min_size=1)


@given(
    st.builds(
        DeviceInfo,
        name=st.text(min_size=1),
        axes=some_axes.map(lambda axes: tuple(axis for axis in AXES if axis in axes)),
        is_prescribed=st.booleans(),
        is_real=st.booleans(),
        **dict.fromkeys(("mass", "rotational_inertia", "rate"), unknown_or_positive),
        **dict.fromkeys(("damping", "rotational_damping", "friction"), unknown_or_not_negative),
        **dict.fromkeys(("resolution", "duration"), unknown_or_not_negative),
        **dict.fromkeys(("force_limit", "torque_limit"), positive),
        delay=st.none() | st.floats(0.0, 1.0),
        speed_limit=at_least_zero,
    )
)
def test_any_data_sheet_survives_json(info: DeviceInfo) -> None:
    assert DeviceInfo.from_json(info.to_json()) == info


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": ""}, "name is ''"),
        ({"name": 3}, "name is 3"),
        ({"axes": ()}, "axes is (); it must be one or more of ('x', 'y', 'z', 'rx', 'ry', 'rz')"),
        ({"axes": "xyz"}, "axes is 'xyz'; it must be of x, y, z"),
        (
            {"axes": ("y", "x")},
            "axes is ('y', 'x'); it must be of x, y, z, rx, ry, rz, each once, in",
        ),
        ({"axes": ("x", "x")}, "axes is ('x', 'x')"),
        ({"axes": ("x", "w")}, "axes is ('x', 'w')"),
        ({"axes": ("x", "y"), "sensed": ("y",)}, "sensed is ('y',); it must be of z, rx, ry, rz,"),
        (
            {"axes": ("x",), "sensed": ("rz", "rx")},
            "must be of y, z, rx, ry, rz, each once, in this order",
        ),
        ({"axes": ("x",), "sensed": "rx"}, "sensed is 'rx'"),
        ({"delay": -1e-3}, "delay is -0.001 s; it must be 0 to 1"),
        ({"delay": 2}, "delay is 2 s; it must be 0 to 1"),
        ({"force_limit": 0}, "force_limit is 0; it must be > 0: it limits the force on the tool"),
        (
            {"force_limit": 0.0, "axes": ("rx",)},
            "a device without any motor states is_prescribed=True",
        ),
        ({"torque_limit": 0, "axes": ("x",)}, "torque_limit is 0; it must be > 0: it limits the"),
        ({"force_limit": -1.0}, "force limit is -1.0 N; it must be finite and > 0"),
        ({"mass": 0.0}, "mass is 0.0 kg; it must be finite and > 0"),
        ({"damping": -0.1}, "damping is -0.1 N s/m; it must be finite and >= 0"),
        ({"damping": "2"}, "damping is '2'"),
        ({"friction": True}, "friction is True"),
        ({"force_limit": None}, "force limit is None"),
        ({"speed_limit": math.inf}, "speed limit is inf"),
        ({"rate": math.nan}, "rate is nan"),
        ({"is_real": 1}, "is real is 1; it must be True or False"),
    ],
)
def test_a_bad_data_sheet_is_refused(change: dict[str, object], words: str) -> None:
    values: dict[str, object] = {**dataclasses.asdict(INFO), **change}
    with pytest.raises(DeviceError, match=re.escape(words)):
        DeviceInfo(**values)  # type: ignore[arg-type]
    with pytest.raises(DeviceError):
        DeviceInfo.from_json(json.dumps(values))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("[1]", "device data is [1]; it must be an object"),
        ("{}", "device data has no 'axes', 'buttons', 'damping'"),
        ('{"colour": "red"}', "device data has unknown fields 'colour'"),
    ],
)
def test_text_that_is_no_data_sheet_is_refused(text: str, words: str) -> None:
    with pytest.raises(DeviceError, match=re.escape(words)):
        DeviceInfo.from_json(text)


def test_options_reach_the_device_and_the_specification_goes_first(tmp_path: Path) -> None:
    both: Any = open_device("simulated: damping = 5, delay=2,hand_mass=0.3", damping=7.0)
    assert (both.info.damping, both.hand) == (5.0, Hand(mass=0.3))
    free: Any = open_device("simulated:hand=none", path=written(tmp_path / "hand.csv"))
    assert (free.hand, free.info.duration) == (None, None)
    file = written(tmp_path / "a,mass=c:d.csv")
    guided: Any = open_device(f"simulated:friction=0.1,path={file}", hand=Hand(stiffness=50.0))
    assert guided.info.duration == pytest.approx(0.195)
    assert guided.hand == Hand(stiffness=50.0)
    assert open_device(f"trajectory:{file}", torque_limit=0.1).info.torque_limit == 0.1


@pytest.mark.parametrize(
    ("spec", "options", "words"),
    [
        (
            "falcn",
            {},
            "unknown device 'falcn'; did you mean 'falcon'? choose one of 'falcon', ",
        ),
        ("inverse3", {}, "unknown device 'inverse3'; did you mean 'haply' (Haply Inverse3, "),
        ("Omega.7", {}, "did you mean 'forcedimension' (Force Dimension omega, "),
        ("geomagic", {}, "did you mean 'touch' ("),
        ("phantom", {}, "did you mean 'touch' ("),
        ("omni", {}, "did you mean 'touch' ("),
        ("novint", {}, "did you mean 'falcon' ("),
        ("SpaceNavigator", {}, "did you mean 'spacemouse' ("),
        ("xbox", {}, "unknown device 'xbox'; choose one of "),
        ("haply:colour=red", {}, "unknown option 'colour' of the haply device; choose one of 'd"),
        ("spacemouse", {"colour": 1}, "unknown option 'colour' of the spacemouse device"),
        ("spacemouse:speed=fast", {}, "speed is 'fast'; it must be a number"),
        ("", {}, "unknown device ''"),
        ("simulated", {"colour": 1}, "unknown option 'colour'"),
        ("simulated:damping", {}, "'damping' is not an option; write options as name=value"),
        ("simulated:damping=5,damping=6", {}, "option 'damping' is set twice"),
        ("simulated:damping=much", {}, "damping is 'much'; it must be a number"),
        ("simulated:delay=1.5", {}, "delay is '1.5'; it must be a whole number"),
        ("simulated:hand_mass=-1", {}, "hand mass is -1.0 kg"),
        ("simulated:hand=left", {}, "hand is 'left'; it must be 'none'; 'hand_damping'"),
        ("simulated:hand=none,hand_mass=1", {}, "hand and 'hand_mass' exclude each other"),
        ("simulated:path=/no/such.csv", {}, "/no/such.csv: no such file"),
        (
            "simulated:friction=0.1,path=a,b.csv,mass=0.1,damping=3",
            {},
            "path= must come last, because all text after it is the file's name: write "
            "mass=0.1,damping=3,path=a,b.csv",
        ),
        ("trajectory", {}, "trajectory needs a file: 'trajectory:FILE'"),
        ("trajectory:a.csv", {"damping": 2}, "unknown option 'damping' of the trajectory device"),
    ],
)
def test_bad_specifications_are_refused(spec: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(DeviceError, match=re.escape(words)):
        open_device(spec, **options)


def test_the_device_in_the_protocols_description_is_a_whole_one(tmp_path: Path) -> None:
    description = inspect.getdoc(Device) or ""
    example = description.partition("::\n")[2].partition("\nAttributes:")[0]
    names: dict[str, Any] = {}
    exec(textwrap.dedent(example), names)
    assert (names["summary"].ticks, names["summary"].verdict) == (1000, "passive")
    path = tmp_path / "run.mcap"
    with hb.Bridge("point_mass", names["Rail"](), clock=hb.SimulatedClock(), recording=path) as run:
        summary = run.run(0.5)
    assert summary.is_certified is True
    assert hb.audit(path).verdict == "passive"
