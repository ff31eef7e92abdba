"""Raw HID devices behind the real driver, for several test files."""

from __future__ import annotations

from emulated.hid_seam import HidSeam
from emulated.rawhid_model import Claims, RawHid

from hapticbridge.device import SimulatedDevice
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.rawhid.device import RawHidDevice, open_rawhid

PERIOD = 1e-3


def opened(model: RawHid | None = None, **options: object) -> tuple[RawHidDevice, RawHid, HidSeam]:
    """Returns the driver, opened; the device; and what it is plugged into."""
    model = model or RawHid(SimulatedDevice())
    seam = HidSeam(model)
    return open_rawhid(options, ignore_message, seam, lambda: seam.now), model, seam


def paddle() -> RawHid:
    """Returns a device of one axis that knows little of itself."""
    nan = float("nan")
    claims = Claims(
        axes=0b1, mass=nan, damping=0.8, rotational_inertia=nan, rotational_damping=nan,
        friction=nan, resolution=1.5e-5, force_limit=4.0, torque_limit=nan, speed_limit=2.0,
        delay=nan,
    )  # fmt: skip
    mechanics = SimulatedDevice(mass=0.05, damping=0.8, friction=0.05)
    return RawHid(mechanics, claims, title="paddle")
