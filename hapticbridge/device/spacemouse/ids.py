"""Products of the SpaceMouse family."""

from __future__ import annotations

from hapticbridge.device.plugged import UsbId

_LOGITECH = {
    0xC603: "SpaceMouse Plus XT",
    0xC605: "CadMan",
    0xC606: "SpaceMouse Classic",
    0xC621: "Spaceball 5000",
    0xC623: "SpaceTraveler",
    0xC625: "SpacePilot",
    0xC626: "SpaceNavigator",
    0xC627: "SpaceExplorer",
    0xC628: "SpaceNavigator for Notebooks",
    0xC629: "SpacePilot Pro",
    0xC62B: "SpaceMouse Pro",
}

_3DCONNEXION = {
    0xC62E: "SpaceMouse Wireless (cable)",
    0xC62F: "SpaceMouse Wireless (receiver)",
    0xC631: "SpaceMouse Pro Wireless (cable)",
    0xC632: "SpaceMouse Pro Wireless (receiver)",
    0xC633: "SpaceMouse Enterprise",
    0xC635: "SpaceMouse Compact",
    0xC636: "SpaceMouse Module",
    0xC638: "SpaceMouse Pro Wireless (Bluetooth)",
    0xC63A: "SpaceMouse Wireless (Bluetooth)",
    0xC641: "SpaceMouse Module (USB)",
    0xC652: "Universal Receiver",
}

IDS = (
    *(UsbId(0x046D, product, model) for product, model in _LOGITECH.items()),
    *(UsbId(0x256F, product, model) for product, model in _3DCONNEXION.items()),
)
"""All products: Logitech's ids first, then 3Dconnexion's. The CadMouse models (256f: c650, c651,
c654 to c658, c664, c665, c668) are two-dimensional mice and are left out. Source: spacenavd of
December 2025 and pyspacemouse of June 2026."""
