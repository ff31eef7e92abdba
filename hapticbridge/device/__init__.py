"""Haptic devices: real, simulated and replayed, behind one protocol."""

from hapticbridge.device.base import Device as Device
from hapticbridge.device.data_sheet import AXES as AXES
from hapticbridge.device.data_sheet import DATA_SHEET_UNITS as DATA_SHEET_UNITS
from hapticbridge.device.data_sheet import DeviceInfo as DeviceInfo
from hapticbridge.device.library import device_for as device_for
from hapticbridge.device.library import open_device as open_device
from hapticbridge.device.simulated.driver import SimulatedDevice as SimulatedDevice
from hapticbridge.device.simulated.hand import DEFAULT_HAND as DEFAULT_HAND
from hapticbridge.device.simulated.hand import Hand as Hand
from hapticbridge.device.simulated.hand import random_hand as random_hand
from hapticbridge.device.simulated.scene_hand import scene_hand as scene_hand
from hapticbridge.device.trajectory.driver import ReplayDevice as ReplayDevice
from hapticbridge.device.trajectory.driver import TrajectoryDevice as TrajectoryDevice
from hapticbridge.device.trajectory.motion import Motion as Motion
from hapticbridge.device.trajectory.motion_csv import read_motion as read_motion
