"""Search of profiles: the user's own take precedence over shipped ones."""

from __future__ import annotations

from pathlib import Path

import platformdirs

from hapticbridge.device.profile import Profile, read_profile
from hapticbridge.errors import DeviceError, choices

SHIPPED = Path(__file__).parent / "profiles"


def own_folder() -> Path:
    """Returns the folder of the user's own profiles, which may not exist.

    It is in the platform's configuration folder; ``identify`` writes profiles there.
    """
    return Path(platformdirs.user_config_dir("hapticbridge", appauthor=False)) / "devices"


def profiles() -> dict[str, Path]:
    """Returns all profiles by name; the user's own replace shipped ones of equal name."""
    found = {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}
    found |= {path.stem: path for path in sorted(own_folder().glob("*.toml"))}
    return found


def profile_named(name: str) -> Profile:
    """Returns a profile by name, or from a file.

    Raises:
        DeviceError: No profile has that name, or it is not valid.
    """
    known = profiles()
    if name in known:
        return read_profile(known[name])
    if name.endswith(".toml"):
        return read_profile(Path(name))
    raise DeviceError(
        f"unknown profile '{name}'; choose one of {choices(known)}, or name a .toml file"
    )


def profile_of(device: str, serial: str = "", model: str = "") -> Profile | None:
    """Returns the profile of a unit, else of its driver or model, else None.

    The order is the user's ``DEVICE-SERIAL.toml``, then ``DEVICE.toml``, then the shipped profile
    that names the model. A user's file with the name of a shipped profile replaces it. Without a
    model, only a profile for all models of the driver fits.

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
    """Returns the models of a driver that have profiles."""
    return tuple(model for found in _by_model(device) for model in found.models)


def _by_model(device: str) -> list[Profile]:
    # only shipped names, so that a user's broken file for another device is not read here
    known = profiles()
    found = [read_profile(known[path.stem]) for path in sorted(SHIPPED.glob("*.toml"))]
    return [profile for profile in found if profile.device == device and profile.models]
