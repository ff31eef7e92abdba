"""Which profile is whose: shipped ones, and the user's own before them.

Shipped profiles lie beside this module in ``profiles/``; a user's own, which ``identify`` writes,
in the platform's configuration folder.
"""

from __future__ import annotations

from pathlib import Path

import platformdirs

from hapticbridge.device.profile import Profile, read_profile
from hapticbridge.errors import DeviceError, choices

SHIPPED = Path(__file__).parent / "profiles"


def own_folder() -> Path:
    """Returns the folder of the user's own profiles; it need not exist."""
    return Path(platformdirs.user_config_dir("hapticbridge", appauthor=False)) / "devices"


def profiles() -> dict[str, Path]:
    """Returns all profiles by name, the user's own in the place of shipped ones."""
    found = {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}
    found |= {path.stem: path for path in sorted(own_folder().glob("*.toml"))}
    return found


def profile_named(name: str) -> Profile:
    """Returns a profile by name, or from a file.

    Raises:
        DeviceError: There is none of that name, or it is not valid.
    """
    known = profiles()
    if name in known:
        return read_profile(known[name])
    if name.endswith(".toml"):
        return read_profile(Path(name))
    raise DeviceError(f"unknown profile '{name}'; there are {choices(known)}, or a .toml file")


def profile_of(device: str, serial: str = "", model: str = "") -> Profile | None:
    """Returns the profile of a unit, else that of its model, else that of its driver, else None.

    A user's ``DEVICE-SERIAL.toml`` goes before ``DEVICE.toml``, which goes before the shipped one
    that names the model; a file of the user's with its name goes in its place.

    Args:
        device: Name of the driver.
        serial: Of the unit; may be empty.
        model: What the driver calls it; empty: only a profile for all models of the driver.

    Raises:
        DeviceError: The file is not valid.
    """
    known = profiles()
    names = [f"{device}-{serial}"] if serial else []
    for name in (*names, device):
        if name in known and (found := read_profile(known[name])).is_for(model):
            return found
    return next((found for found in _by_model(device) if found.names(model)), None)


def modelled(device: str) -> tuple[str, ...]:
    """Returns the models of a driver that there are profiles for.

    Raises:
        DeviceError: A file is not valid.
    """
    return tuple(model for found in _by_model(device) for model in found.models)


def _by_model(device: str) -> list[Profile]:
    # only names that are shipped: a broken file of the user's for another device is not read here
    known = profiles()
    found = [read_profile(known[path.stem]) for path in sorted(SHIPPED.glob("*.toml"))]
    return [profile for profile in found if profile.device == device and profile.models]
