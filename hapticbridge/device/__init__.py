"""Haptic devices: real, simulated and replayed, behind one protocol.

Read ``base`` first: four calls and a data sheet. ``simulated`` and ``trajectory`` need no hardware;
``spacemouse`` is the shortest driver of real hardware. Real drivers use ``transport`` for their
bytes. ``registry`` opens a device by its name and options, with the numbers of a ``profile``.
``driver`` describes a driver, ``discovery`` lists the devices that are plugged in. ``watchdog``
ends the force if device or program stops answering.
"""

from hapticbridge.device.base import AXES as AXES
from hapticbridge.device.base import DATA_SHEET_UNITS as DATA_SHEET_UNITS
from hapticbridge.device.base import Device as Device
from hapticbridge.device.base import DeviceInfo as DeviceInfo
from hapticbridge.device.motion_file import read_motion as read_motion
from hapticbridge.device.registry import device_for as device_for
from hapticbridge.device.registry import open_device as open_device
from hapticbridge.device.simulated.device import GrippingDevice as GrippingDevice
from hapticbridge.device.simulated.device import SimulatedDevice as SimulatedDevice
from hapticbridge.device.simulated.device import scene_hand as scene_hand
from hapticbridge.device.simulated.dynamics import DEFAULT_HAND as DEFAULT_HAND
from hapticbridge.device.simulated.dynamics import Hand as Hand
from hapticbridge.device.trajectory import Motion as Motion
from hapticbridge.device.trajectory import ReplayDevice as ReplayDevice
from hapticbridge.device.trajectory import TrajectoryDevice as TrajectoryDevice
