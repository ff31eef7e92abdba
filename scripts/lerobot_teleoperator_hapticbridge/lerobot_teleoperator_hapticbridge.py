"""Plugin that LeRobot finds: it registers the teleoperator ``hapticbridge``."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

from hapticbridge.program import lerobot

HapticDevice = lerobot.HapticDevice
"""Class that LeRobot makes: the configuration's name without ``Config``, in the same module."""


@TeleoperatorConfig.register_subclass("hapticbridge")
@dataclass(kw_only=True)
class HapticDeviceConfig(lerobot.HapticDeviceConfig):
    """Configuration of a haptic device, in the module in which LeRobot looks for its class."""
