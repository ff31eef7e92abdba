"""Haptic devices: real, simulated and replayed, behind one protocol."""

from hapticbridge.device.base import AXES as AXES
from hapticbridge.device.base import DATA_SHEET_UNITS as DATA_SHEET_UNITS
from hapticbridge.device.base import Device as Device
from hapticbridge.device.base import DeviceInfo as DeviceInfo
from hapticbridge.device.hand import DEFAULT_HAND as DEFAULT_HAND
from hapticbridge.device.hand import Hand as Hand
from hapticbridge.device.hand import random_hand as random_hand
from hapticbridge.device.library import device_for as device_for
from hapticbridge.device.library import open_device as open_device
from hapticbridge.device.motion import Motion as Motion
from hapticbridge.device.motion_csv import read_motion as read_motion
from hapticbridge.device.scene_hand import scene_hand as scene_hand
from hapticbridge.device.simulated import SimulatedDevice as SimulatedDevice
from hapticbridge.device.trajectory import ReplayDevice as ReplayDevice
from hapticbridge.device.trajectory import TrajectoryDevice as TrajectoryDevice
