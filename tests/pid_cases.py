"""Force-feedback sticks behind the real driver, for several test files."""

from __future__ import annotations

from collections.abc import Mapping

from emulated.hid_seam import HidSeam
from emulated.pid_layouts import ODD, USUAL, Report
from emulated.pid_model import PidStick

from hapticbridge.device import SimulatedDevice
from hapticbridge.device.driver import ignore_message
from hapticbridge.device.pid.device import PidDevice, open_pid

PERIOD = 1e-3

LAYOUTS: dict[str, Mapping[str, Report]] = {"usual": USUAL, "odd": ODD}
"""Two sticks that have no number, width or order in common."""

MOUSE = bytes.fromhex(
    "0501 0902 a101 0901 a100 0509 1901 2903 1500 2501 9503 7501 8102 9501 7505 8101"
    "0501 0930 0931 1581 257f 7508 9502 8106 c0c0"
)
"""The mouse of the HID standard's appendix E.10."""

NEWTONS, TRAVEL = 4.0, 0.08
"""The models' own, which nobody can ask them for."""

SCALE: dict[str, object] = {"newtons": NEWTONS, "travel": TRAVEL}


def opened(model: PidStick | None = None, **options: object) -> tuple[PidDevice, PidStick, HidSeam]:
    """Returns the driver, opened; the device; and what it is plugged into."""
    model = model or PidStick(SimulatedDevice())
    seam = HidSeam(model)
    seam.advance(0.0)
    return open_pid({**SCALE, **options}, ignore_message, seam), model, seam
