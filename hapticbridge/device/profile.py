"""Profiles: what is known of a kind of device, or of one unit, each number with its source.

A profile is a TOML file (``profile_search`` says where). It fills in what a driver cannot know,
above all the damping b.

    format = 1
    name = "Novint Falcon"
    device = "falcon"            # the driver it is for
    serial = "FT000001"          # only in a profile of one unit
    models = ["omega.3"]         # what the driver calls those it holds for; none: for all

    [damping]                    # one table per number of the data sheet, SI units
    value = 1.7                  # or "unknown"
    interval = [1.6, 1.8]        # where it was measured: 95 %
    unit = "N s/m"
    source = "identified on 2026-03-01, 12 s per axis, nobody holding it"
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

from hapticbridge.device.base import AXES, DATA_SHEET_UNITS, DeviceInfo, checked_number
from hapticbridge.errors import DeviceError, choices

FORMAT = 1
"""Version of the file's layout that is read and written."""

UNITS = {name: unit for name, unit in DATA_SHEET_UNITS.items() if name != "duration"} | {
    "workspace": "m",
    "force_continuous": "N",
    "stiffness_offered": "N/m",
    "damping_offered": "N s/m",
}
"""SI units of the numbers that a profile may hold. ``workspace`` is three lengths; what a maker or
a library offers as largest stiffness and damping is kept to be shown, and bounds nothing."""

LOWER_END = ("damping", "rotational_damping", "friction", "mass", "rotational_inertia")
"""Of these the guarantee takes the lower end of the interval: more would promise too much."""

_TEXTS = ("name", "device", "serial", "about")


@dataclass(frozen=True, slots=True)
class Quantity:
    """A number of a profile.

    Attributes:
        value: One number, three lengths (``workspace``), or None where unknown.
        source: Where it comes from, not empty.
        interval: Where the true value lies with 95 %, or None.
    """

    value: float | tuple[float, ...] | None
    source: str
    interval: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Profile:
    """What is known of a device.

    Attributes:
        name: What it is called.
        device: Name of the driver, as ``--device`` takes it.
        serial: Of the unit; empty for a kind.
        axes: Which of ``AXES`` it has; None where the driver tells.
        about: What else there is to say, in a sentence; may be empty.
        quantities: By name, see ``UNITS``.
        path: The file.
        models: What the driver calls the models that it holds for; empty where for all.
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
        """Returns whether it holds for a model, as the driver calls it; "" stands for any."""
        return not model or not self.models or self.names(model)

    def names(self, model: str) -> bool:
        """Returns whether it names a model, in whatever case."""
        return model.casefold() in (known.casefold() for known in self.models)

    def fill(self, info: DeviceInfo) -> DeviceInfo:
        """Returns a data sheet with what was unknown in it filled in.

        What the driver knows stays, but limits: the lower one holds.

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
            elif name.endswith("_limit"):
                known[name] = min(before, value)
        return dataclasses.replace(info, **known)

    def to_toml(self) -> str:
        """Returns the file's text, which ``read_profile`` reads back as the same profile."""
        plain: dict[str, object] = {"format": FORMAT}
        plain |= {name: getattr(self, name) for name in _TEXTS if getattr(self, name)}
        if self.axes is not None:
            plain["axes"] = list(self.axes)
        if self.models:
            plain["models"] = list(self.models)
        for name, quantity in self.quantities.items():
            value = quantity.value
            table: dict[str, object] = {
                "value": "unknown"
                if value is None
                else list(value)
                if isinstance(value, tuple)
                else value
            }
            if quantity.interval is not None:
                table["interval"] = list(quantity.interval)
            plain[name] = table | {"unit": UNITS[name], "source": quantity.source}
        return tomli_w.dumps(plain)


def read_profile(path: Path) -> Profile:
    """Reads a profile.

    Raises:
        DeviceError: The file cannot be read, or says where it is not valid.
    """
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DeviceError(f"cannot read profile '{path}': {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
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
            raise DeviceError(f"{name} = {text!r}: must be a text, and name and device not empty")
    axes = raw.pop("axes", None)
    if axes is not None and (
        not isinstance(axes, list) or not axes or [a for a in AXES if a in axes] != axes
    ):
        raise DeviceError(f"axes = {axes!r}: must be of {', '.join(AXES)}, in this order")
    models = raw.pop("models", [])
    if not isinstance(models, list) or not all(isinstance(m, str) and m for m in models):
        raise DeviceError(f"models = {models!r}: must be a list of texts that are not empty")
    if unknown := raw.keys() - UNITS.keys():
        raise DeviceError(f"it holds {choices(unknown)}; it may hold {choices(UNITS)}")
    return Profile(
        axes=None if axes is None else tuple(axes),
        quantities={name: _quantity(name, table) for name, table in raw.items()},
        path=path,
        models=tuple(models),
        **{name: str(text) for name, text in texts.items()},
    )


def _quantity(name: str, table: object) -> Quantity:
    if not isinstance(table, dict) or not table.keys() <= {"value", "interval", "unit", "source"}:
        raise DeviceError(f"[{name}] must hold value, source, and perhaps unit and interval")
    if table.get("unit", UNITS[name]) != UNITS[name]:
        raise DeviceError(f"[{name}] unit = {table['unit']!r}: must be {UNITS[name]!r}")
    source = table.get("source")
    if not isinstance(source, str) or not source:
        raise DeviceError(f"[{name}] needs a source: where the number comes from")
    raw, interval = table.get("value"), table.get("interval")
    value: float | tuple[float, ...] | None = None
    if name == "workspace" and isinstance(raw, list):
        value = tuple(checked_number(name, part, "m", is_positive=True) for part in raw)
        if len(value) != 3:
            raise DeviceError(f"[{name}] value = {raw!r}: must be three lengths in m")
    elif raw != "unknown":
        value = checked_number(f"[{name}] value", raw, UNITS[name])
    if interval is None:
        return Quantity(value, source)
    if not isinstance(interval, list) or len(interval) != 2 or not isinstance(value, float):
        raise DeviceError(f"[{name}] interval = {interval!r}: must be two numbers about a value")
    least, most = (float(end) if _is_number(end) else math.nan for end in interval)
    if not least <= value <= most:
        raise DeviceError(f"[{name}] interval = {interval!r}: must hold the value {value:g}")
    return Quantity(value, source, (least, most))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


# Which profile is whose: shipped ones, and the user's own before them.
#
# Shipped profiles lie beside this module in ``profiles/``; a user's own, which ``identify``
# writes, in the platform's configuration folder.

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
