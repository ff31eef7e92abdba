"""Emulated devices behind their real drivers in virtual time, which several test files use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from emulated.dhd_stub import Stub
from emulated.falcon_model import FalconModel
from emulated.handle import Handle
from emulated.haply_service import HaplyService
from emulated.haply_service import VirtualLink as HaplyLink
from emulated.haply_service import VirtualTime as HaplyTime
from emulated.hd_stub import HdStub
from emulated.hid_seam import DrivingClock, HidSeam, Timed
from emulated.pid_layouts import ODD, USUAL, Report
from emulated.pid_model import PidStick
from emulated.rawhid_model import NAN, Claims, RawHid
from emulated.virtual_usb import VirtualClock, VirtualLink, VirtualTime

from hapticbridge.clock import Clock, SimulatedClock
from hapticbridge.device import Device, SimulatedDevice
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.falcon.device import FalconDevice
from hapticbridge.device.haply import HaplyDevice
from hapticbridge.device.haply import opened as open_haply
from hapticbridge.device.pid.device import PidDevice, open_pid
from hapticbridge.device.rawhid.device import RawHidDevice, open_rawhid
from hapticbridge.kernel.record import SAMPLE_DTYPE

PERIOD = 1e-3


def read(device: Device, time: Timed, seconds: float = PERIOD) -> tuple[int, np.void]:
    """Reads after that much time; returns flag and sample."""
    sample = np.zeros(1, SAMPLE_DTYPE)
    time.advance(time.now + seconds)
    return device.read(sample), sample[0]


def ticks(device: Device, time: Timed, count: int, wrench: np.ndarray) -> list[int]:
    """Runs a loop of that many ticks; returns the flags of its reads."""
    flags = []
    for _ in range(count):
        flags.append(read(device, time)[0])
        device.write(wrench)
    return flags


class FalconBench:
    """A Falcon model, its time, and a link to it.

    Args:
        mechanics: What moves and who holds it; None: a grip of 0.4 kg in a usual hand.
        **options: The model's.
    """

    def __init__(self, mechanics: SimulatedDevice | None = None, **options: Any) -> None:
        mechanics = mechanics or SimulatedDevice(mass=0.4, damping=2.0)
        self.model = FalconModel(Handle(mechanics), **options)
        self.time = VirtualTime(self.model)
        self.link = VirtualLink(self.time)
        self.told: list[str] = []

    def opened(
        self, name: str = "falcon", firmware: str | None = None, **numbers: float
    ) -> FalconDevice:
        return FalconDevice(self.link, name=name, firmware=firmware, numbers=numbers,
                            notify=self.told.append)  # fmt: skip

    def clock(self, drift: float = 0.0) -> VirtualClock:
        clock = VirtualClock(self.time, drift)
        clock.start(round(1e9 * PERIOD))
        return clock


class HaplyBench:
    """A service with one device or several, a connection to it, and their time.

    Args:
        *mechanics: What moves; the first is device 049D, the second 049E and so on.
        resolution: Step of the reported position in m.
        **options: The connection's.
    """

    def __init__(
        self, *mechanics: SimulatedDevice, resolution: float = 0.0, **options: float
    ) -> None:
        devices = mechanics or (SimulatedDevice(),)
        names = [f"049{letter}" for letter in "DEF"]
        self.service = HaplyService(dict(zip(names, devices, strict=False)), resolution)
        self.options = options
        self.told: list[str] = []

    def opened(self, **options: Any) -> HaplyDevice:
        self.link = HaplyLink(self.service, **self.options)
        self.time = HaplyTime(self.link)
        return open_haply(self.link, options, self.told.append)


LAYOUTS: dict[str, Mapping[str, Report]] = {"usual": USUAL, "odd": ODD}
"""Two sticks that have no number, width or order in common."""

MOUSE = bytes.fromhex(
    "0501 0902 a101 0901 a100 0509 1901 2903 1500 2501 9503 7501 8102 9501 7505 8101"
    "0501 0930 0931 1581 257f 7508 9502 8106 c0c0"
)
"""The mouse of the HID standard's appendix E.10."""

NEWTONS, TRAVEL = 4.0, 0.08
"""The sticks' own, which nothing can ask them for."""

SCALE: dict[str, object] = {"newtons": NEWTONS, "travel": TRAVEL}


Stick = tuple[PidDevice, PidStick, HidSeam]


def opened_stick(model: PidStick | None = None, **options: object) -> Stick:
    """Returns the driver, opened; the device; and what it is plugged into."""
    model = model or PidStick(SimulatedDevice())
    seam = HidSeam(model)
    seam.advance(0.0)
    return open_pid({**SCALE, **options}, ignore_message, seam), model, seam


HomeMade = tuple[RawHidDevice, RawHid, HidSeam]


def opened_rawhid(model: RawHid | None = None, **options: object) -> HomeMade:
    """Returns the driver, opened; the device; and what it is plugged into."""
    model = model or RawHid(SimulatedDevice())
    seam = HidSeam(model)
    return open_rawhid(options, ignore_message, seam, lambda: seam.now), model, seam


def paddle() -> RawHid:
    """Returns a device of one axis that knows little of itself."""
    claims = Claims(
        axes=0b1, mass=NAN, damping=0.8, rotational_inertia=NAN, rotational_damping=NAN,
        friction=NAN, resolution=1.5e-5, force_limit=4.0, torque_limit=NAN, speed_limit=2.0,
        delay=NAN,
    )  # fmt: skip
    return RawHid(SimulatedDevice(mass=0.05, damping=0.8, friction=0.05), claims, title="paddle")


def mechanics(seed: int) -> dict[str, float]:
    """Returns mass, damping and friction of a desktop device, in SI units."""
    rng = np.random.default_rng(seed)
    ranges = {"mass": (0.15, 0.8), "damping": (0.4, 4.0), "friction": (0.05, 0.4)}
    return {
        name: float(np.exp(rng.uniform(np.log(least), np.log(most))))
        for name, (least, most) in ranges.items()
    }


def unheld(driver: str, numbers: Mapping[str, float]) -> tuple[Device, Clock]:
    """Returns a device of these mechanics that nobody holds, behind a driver, and its time."""
    moved = SimulatedDevice(hand=None, **numbers)  # type: ignore[arg-type]
    if driver == "simulated":
        fine = {**numbers, "resolution": 1e-5}
        return SimulatedDevice(hand=None, **fine), SimulatedClock()  # type: ignore[arg-type]
    if driver == "falcon":
        falcon = FalconBench(moved)
        return falcon.opened(), falcon.clock()
    if driver == "haply":
        haply = HaplyBench(moved, resolution=1e-5)
        return haply.opened(force_limit=8.0), DrivingClock(haply.time)
    if driver in ("forcedimension", "touch"):
        stub = Stub() if driver == "forcedimension" else HdStub()
        stub.call("mechanics", numbers["mass"], numbers["damping"], numbers["friction"], 1e-5)
        return stub.opened(), DrivingClock(stub)
    if driver == "pid":
        stick, _, seam = opened_stick(PidStick(moved, newtons=NEWTONS, travel=TRAVEL))
        return stick, DrivingClock(seam)
    device, _, seam = opened_rawhid(RawHid(moved))
    return device, DrivingClock(seam)


DRIVERS = ("simulated", "falcon", "rawhid", "pid", "haply", "forcedimension", "touch")
