"""Device profile: properties of a device type or of one unit, each number with its source.

A profile is a TOML file (``profiles`` lists them). It supplies numbers that a driver cannot read,
above all the damping b.

    format = 1
    name = "Novint Falcon"
    device = "falcon"            # name of the driver
    serial = "FT000001"          # only in a profile of one unit
    models = ["omega.3"]         # models as named by the driver; none: all models

    [damping]                    # one table per number of the data sheet, SI units
    value = 1.7                  # or "unknown"
    interval = [1.6, 1.8]        # 95 % interval of a measured value
    unit = "N s/m"
    source = "identified on 2026-03-01, 12 s per axis, without a hand"
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import platformdirs
import tomli_w

from hapticbridge.arguments import is_number
from hapticbridge.device.base import AXES, DATA_SHEET_UNITS, DeviceInfo, checked_number
from hapticbridge.errors import DeviceError, choices
from hapticbridge.files import user_folder

FORMAT = 1
"""Version of the file format."""

UNITS = {name: unit for name, unit in DATA_SHEET_UNITS.items() if name != "duration"} | {
    "workspace": "m",
    "force_continuous": "N",
    "stiffness_offered": "N/m",
    "damping_offered": "N s/m",
}
"""SI units of the numbers in a profile. ``workspace`` has three lengths. The largest stiffness and
damping stated by a maker or a library are shown and bound nothing."""

LOWER_END = ("damping", "rotational_damping", "friction", "mass", "rotational_inertia")
"""Numbers for which the guarantee uses the lower end of the interval, the cautious one."""

_TEXTS = ("name", "device", "serial", "about")


@dataclass(frozen=True, slots=True)
class Quantity:
    """A number of a profile.

    Attributes:
        value: One number, three lengths (``workspace``), or None if unknown.
        source: Source of the number, not empty.
        interval: 95 % interval of the true value, or None.
    """

    value: float | tuple[float, ...] | None
    source: str
    interval: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Profile:
    """Known properties of a device.

    Attributes:
        name: Name of the device.
        device: Name of the driver, as for ``--device``.
        serial: Serial number of the unit; empty for a device type.
        axes: Axes out of ``AXES``; None if the driver reports them.
        about: Further description in a sentence; may be empty.
        quantities: Numbers by name, see ``UNITS``.
        path: The file.
        models: Models for which it holds, as named by the driver; empty for all.
    """

    name: str
    device: str
    serial: str
    axes: tuple[str, ...] | None
    about: str
    quantities: Mapping[str, Quantity]
    path: Path | None = None
    models: tuple[str, ...] = ()

    def is_for(self, model: str) -> bool:
        """Returns whether it holds for a model; an empty model stands for any."""
        return not model or not self.models or self.names(model)

    def names(self, model: str) -> bool:
        """Returns whether it names a model, ignoring case."""
        return model.casefold() in (known.casefold() for known in self.models)

    def fill(self, info: DeviceInfo) -> DeviceInfo:
        """Returns a data sheet with its unknown values filled in.

        Values from the driver are kept, except for limits, where the lower one is used.

        Raises:
            DeviceError: A value is out of the data sheet's range.
        """
        known: dict[str, Any] = {}
        for name, quantity in self.quantities.items():
            if name not in DATA_SHEET_UNITS or not isinstance(quantity.value, float):
                continue
            before = getattr(info, name)
            value = quantity.value
            if quantity.interval is not None and name in LOWER_END:
                value = max(quantity.interval[0], 0.0)
            if before is None:
                known[name] = value
                if name == "delay":
                    known["is_delay_measured"] = quantity.interval is not None
            elif name.endswith("_limit"):
                known[name] = min(before, value)
        return dataclasses.replace(info, **known)

    def to_toml(self) -> str:
        """Returns the file's text, which ``read_profile`` converts back to an equal profile."""
        plain: dict[str, object] = {"format": FORMAT}
        plain |= {name: getattr(self, name) for name in _TEXTS if getattr(self, name)}
        if self.axes is not None:
            plain["axes"] = list(self.axes)
        if self.models:
            plain["models"] = list(self.models)
        for name, quantity in self.quantities.items():
            value = quantity.value
            table: dict[str, object] = {"value": "unknown" if value is None else value}
            if quantity.interval is not None:
                table["interval"] = list(quantity.interval)
            plain[name] = table | {"unit": UNITS[name], "source": quantity.source}
        return tomli_w.dumps(plain)


def read_profile(path: Path) -> Profile:
    """Reads a profile.

    Raises:
        DeviceError: The file cannot be read or is not valid; the message names the place.
    """
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DeviceError(f"cannot read profile '{path}': {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise DeviceError(f"profile '{path}' is not TOML: {error}") from None
    try:
        return _profile(raw, path)
    except DeviceError as error:
        raise DeviceError(f"profile '{path}': {error}") from None


def _profile(raw: dict[str, object], path: Path) -> Profile:
    if raw.pop("format", None) != FORMAT:
        raise DeviceError(f"format must be {FORMAT}")
    texts = {name: raw.pop(name, "") for name in _TEXTS}
    for name, text in texts.items():
        if not isinstance(text, str) or (name in ("name", "device") and not text):
            raise DeviceError(
                f"{name} is {text!r}; it must be a text, and name and device not empty"
            )
    axes = raw.pop("axes", None)
    if axes is not None and (
        not isinstance(axes, list) or not axes or [a for a in AXES if a in axes] != axes
    ):
        raise DeviceError(f"axes is {axes!r}; it must be of {', '.join(AXES)}, in this order")
    models = raw.pop("models", [])
    if not isinstance(models, list) or not all(isinstance(m, str) and m for m in models):
        raise DeviceError(f"models is {models!r}; it must be a list of texts that are not empty")
    if unknown := raw.keys() - UNITS.keys():
        raise DeviceError(f"unknown tables {choices(unknown)}; valid tables: {choices(UNITS)}")
    return Profile(
        axes=None if axes is None else tuple(axes),
        quantities={name: _quantity(name, table) for name, table in raw.items()},
        path=path,
        models=tuple(models),
        **{name: str(text) for name, text in texts.items()},
    )


def _quantity(name: str, table: object) -> Quantity:
    if not isinstance(table, dict) or not table.keys() <= {"value", "interval", "unit", "source"}:
        raise DeviceError(
            f"[{name}] must hold value and source, and optionally unit and interval, and no more"
        )
    if table.get("unit", UNITS[name]) != UNITS[name]:
        raise DeviceError(f"[{name}] unit is {table['unit']!r}; it must be {UNITS[name]!r}")
    source = table.get("source")
    if not isinstance(source, str) or not source:
        raise DeviceError(f"[{name}] needs a source: the origin of the number, as a text")
    raw, interval = table.get("value"), table.get("interval")
    value: float | tuple[float, ...] | None = None
    if name == "workspace" and isinstance(raw, list):
        value = tuple(checked_number(name, part, "m", is_positive=True) for part in raw)
        if len(value) != 3:
            raise DeviceError(f"[{name}] value is {raw!r}; it must be three lengths in m")
    elif raw != "unknown":
        value = checked_number(f"[{name}] value", raw, UNITS[name])
    if interval is None:
        return Quantity(value, source)
    if not isinstance(interval, list) or len(interval) != 2 or not isinstance(value, float):
        raise DeviceError(
            f"[{name}] interval is {interval!r}; it must be two numbers around a single value"
        )
    least, most = (float(end) if is_number(end) else math.nan for end in interval)
    if not least <= value <= most:
        raise DeviceError(f"[{name}] interval is {interval!r}; it must contain the value {value:g}")
    return Quantity(value, source, (least, most))


# Search of profiles: the user's own take precedence over shipped ones

SHIPPED = Path(__file__).parent / "profiles"


def own_folder() -> Path | None:
    """Returns the folder of the user's own profiles, which may not exist; None without a home.

    It is in the platform's configuration folder; ``identify`` writes profiles there.
    """
    above = user_folder(platformdirs.user_config_dir)
    return above and above / "devices"


def profiles() -> dict[str, Path]:
    """Returns all profiles by name; the user's own replace shipped ones of equal name."""
    found = {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}
    if own := own_folder():
        found |= {path.stem: path for path in sorted(own.glob("*.toml"))}
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
