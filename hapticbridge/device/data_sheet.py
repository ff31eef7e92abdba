"""A haptic device's data sheet, as guard, certificate and recording use it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Real

from hapticbridge.errors import DeviceError, choices
from hapticbridge.jsonable import read_json


def checked_number(name: str, value: object, unit: str, *, is_positive: bool = False) -> float:
    """Returns a device's parameter as a float, or says what would be valid.

    Args:
        name: The parameter as the user knows it.
        value: A real number, finite and >= 0 (> 0 with ``is_positive``).
        unit: The parameter's unit, for the message.
        is_positive: Whether zero is refused too.

    Raises:
        DeviceError: The value is no number, not finite, or out of range.
    """
    bound = "> 0" if is_positive else ">= 0"
    message = f"{name} = {value!r}: must be a finite number {bound}" + (f" {unit}" if unit else "")
    if isinstance(value, bool) or not isinstance(value, Real):
        raise DeviceError(message)
    number = float(value)
    if not math.isfinite(number) or number < 0.0 or (is_positive and number == 0.0):
        raise DeviceError(message)
    return number


def checked_period(period: float) -> float:
    """Returns the loop's period in s, finite and > 0.

    Raises:
        DeviceError: It is not.
    """
    return checked_number("the loop's period", period, "s", is_positive=True)


DATA_SHEET_UNITS = {
    "mass": "kg",
    "damping": "N s/m",
    "rotational_inertia": "kg m²",
    "rotational_damping": "N m s/rad",
    "friction": "N",
    "resolution": "m",
    "force_limit": "N",
    "torque_limit": "N m",
    "speed_limit": "m/s",
    "rate": "Hz",
    "delay": "s",
    "duration": "s",
    "reach": "m",
}
"""SI units of the numbers in a device's data sheet."""

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Axes that a device may move along (x, y, z) and turn about (rx, ry, rz), in its own frame."""

USUAL_FORCE_LIMIT, USUAL_TORQUE_LIMIT, USUAL_SPEED_LIMIT = 10.0, 0.5, 5.0
"""In N, N m and m/s, for the sheets of devices that have no figure of their own: what a desktop
device gives, and a speed that no hand reaches, but a fault does. Where there is no motor, a limit
of force or torque limits only what is recorded."""

_NEVER_UNKNOWN = ("force_limit", "torque_limit", "speed_limit")
_POSITIVE = ("mass", "rotational_inertia", "rate", "reach")


def stated_numbers(options: Mapping[str, object], names: Iterable[str]) -> dict[str, float]:
    """Returns those numbers of the data sheet that a device's options state.

    Args:
        options: By name; None stands for one that is not stated.
        names: Of ``DATA_SHEET_UNITS``, which of them are looked for.

    Raises:
        DeviceError: A number is out of range.
    """
    return {name: _checked(name, options[name]) for name in names if options.get(name) is not None}


def _checked(name: str, value: object) -> float:
    return checked_number(name, value, DATA_SHEET_UNITS[name], is_positive=name in _POSITIVE)


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceInfo:
    """A device's data sheet, as the guard uses it and the recording keeps it.

    Attributes:
        name: What it is called, not empty.
        axes: Which of ``AXES`` it moves along and turns about, in that order, at least one. What
            is not there stays where it is, and no wrench acts on it.
        mass: Inertia felt at the handle in kg, > 0; None where unknown.
        damping: Physical damping b at the handle in N s/m, >= 0; None where unknown or where
            the motion is prescribed. The bound b >= KT/2 + B' is judged against it.
        rotational_inertia: In kg m², > 0; None where unknown.
        rotational_damping: In N m s/rad, >= 0; None where unknown.
        friction: Coulomb friction per axis in N, >= 0; None where unknown.
        resolution: Step of the reported position in m, >= 0 (0: none); None where unknown.
        force_limit: Largest force in N that the device may be sent, by norm, >= 0.
        torque_limit: Largest torque in N m, by norm, >= 0.
        speed_limit: Fastest motion in m/s that the device can make, >= 0.
        rate: The device's own rate in Hz, > 0; None where it follows the bridge.
        delay: How old a sample is when the loop reads it, plus the time until a written wrench
            acts, in s, >= 0; None where unknown.
        is_prescribed: Whether its motion does not react to force.
        is_real: Whether it moves a motor in somebody's hand.
        duration: Time in s after which its motion ends by itself, >= 0; None where it does not.
        serial: The unit's serial number; empty where it has none.
        reach: Distance in m from the origin of its frame, > 0, beyond which it has no place to be
            but at its stops; None where unknown.

    Raises:
        DeviceError: A value is of the wrong type, not finite, or out of range.
    """

    name: str
    axes: tuple[str, ...]
    mass: float | None
    damping: float | None
    rotational_inertia: float | None
    rotational_damping: float | None
    friction: float | None
    resolution: float | None
    force_limit: float
    torque_limit: float
    speed_limit: float
    rate: float | None
    delay: float | None
    is_prescribed: bool
    is_real: bool
    duration: float | None
    serial: str = ""
    reach: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise DeviceError(f"device name = {self.name!r}: must be a text that is not empty")
        if not isinstance(self.serial, str):
            raise DeviceError(f"serial = {self.serial!r}: must be a text")
        if not isinstance(self.axes, tuple | list) or not self.axes:
            raise DeviceError(f"axes = {self.axes!r}: must be one or more of {choices(AXES)}")
        if tuple(self.axes) != tuple(axis for axis in AXES if axis in self.axes):
            raise DeviceError(
                f"axes = {tuple(self.axes)!r}: must be of {', '.join(AXES)}, each once, in this "
                "order"
            )
        object.__setattr__(self, "axes", tuple(self.axes))
        for name in ("is_prescribed", "is_real"):
            if not isinstance(getattr(self, name), bool):
                raise DeviceError(f"{name} = {getattr(self, name)!r}: must be true or false")
        for name in DATA_SHEET_UNITS:
            value = getattr(self, name)
            if value is not None or name in _NEVER_UNKNOWN:
                object.__setattr__(self, name, _checked(name, value))

    @property
    def degrees_of_freedom(self) -> int:
        """How many axes it has."""
        return len(self.axes)

    @property
    def moves(self) -> bool:
        """Whether it moves along any axis."""
        return any(axis in self.axes for axis in AXES[:3])

    @property
    def turns(self) -> bool:
        """Whether it turns about any axis."""
        return any(axis in self.axes for axis in AXES[3:])

    @property
    def burning_damping(self) -> tuple[float | None, float | None]:
        """What the device burns energy with: b in N s/m and in N m s/rad; None, None where unknown.

        Unknown on one kind of axis is unknown altogether: nobody can tell which of them took the
        energy. A device without rotation needs none for it; one whose motion is prescribed keeps
        nothing of what it is given.
        """
        is_complete = self.rotational_damping is not None or not self.turns
        if self.is_prescribed or not is_complete:
            return None, None
        return self.damping, self.rotational_damping

    def to_json(self) -> str:
        """Returns the sheet as one JSON object: a key per attribute, null where unknown."""
        return json.dumps(dataclasses.asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> DeviceInfo:
        """Reads what ``to_json`` wrote.

        Raises:
            DeviceError: The text is not a JSON object with these keys (``serial`` and ``reach`` may
                be missing), or a value is invalid.
        """
        try:
            values = read_json(text)
        except ValueError as error:
            raise DeviceError(f"device data is not JSON: {error}") from None
        if not isinstance(values, dict):
            raise DeviceError(f"device data is not a JSON object but {values!r:.60}")
        names = {field.name for field in dataclasses.fields(cls)}
        if unknown := values.keys() - names:
            raise DeviceError(
                f"device data holds {choices(unknown)}, which it does not know; "
                f"it knows {choices(names)}"
            )
        needed = {f.name for f in dataclasses.fields(cls) if f.default is dataclasses.MISSING}
        if missing := needed - values.keys():
            raise DeviceError(f"device data lacks {choices(missing)}")
        return cls(**values)
