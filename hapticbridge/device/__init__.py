"""Haptic devices: real, simulated and replayed, behind one protocol.

Read ``base`` (four calls) and ``data_sheet`` (what is known of a device) first, then ``simulated``
and ``trajectory``, which need no hardware, then a real driver; ``rawhid`` is the plainest. Real
ones stand on ``transport``, which carries their bytes and finds them. ``families`` is the table of
their drivers, ``discovery`` lists those that are plugged in; ``library`` opens one by its
``specification`` and fills in its sheet from a ``profile`` (``profile_search``). What all share is
in ``lateness_above_baseline``, ``silence`` and ``last_word``.
"""

from hapticbridge.device.base import AXES as AXES
from hapticbridge.device.base import DATA_SHEET_UNITS as DATA_SHEET_UNITS
from hapticbridge.device.base import Device as Device
from hapticbridge.device.base import DeviceInfo as DeviceInfo
from hapticbridge.device.registry import device_for as device_for
from hapticbridge.device.registry import open_device as open_device
from hapticbridge.device.simulated.device import SimulatedDevice as SimulatedDevice
from hapticbridge.device.simulated.device import scene_hand as scene_hand
from hapticbridge.device.simulated.hand import DEFAULT_HAND as DEFAULT_HAND
from hapticbridge.device.simulated.hand import Hand as Hand
from hapticbridge.device.simulated.hand import random_hand as random_hand
from hapticbridge.device.trajectory import Motion as Motion
from hapticbridge.device.trajectory import ReplayDevice as ReplayDevice
from hapticbridge.device.trajectory import TrajectoryDevice as TrajectoryDevice
from hapticbridge.device.trajectory import read_motion as read_motion
