"""What the guard does within a tick, as numbers: part of what decides what a run computes."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from typing import Any

from hapticbridge.errors import HapticBridgeError
from hapticbridge.jsonable import read_json

OFF, DAMPER, ENVIRONMENT = 0, 1, 3
"""Passivity controllers as recordings number them: none; damping against the motion, and a tank
behind it, for what both ports owe; damping for what the environment's port owes alone. Recordings
of earlier versions have a 2 where a tank acted by itself."""

_TANK_ALONE = 2

MOST_BUTTONS = 32
"""Buttons that a mask may name; no handle has more."""

LATER = frozenset({"reach", "ramp_energy"})
"""What came after the first recordings with a guard, which do without."""

_POSITIVE = ("force_rise", "torque_rise", "longest_stall")
_TRIPS = ("speed", "turn_speed", "stretch", "angle", "energy")
_NOT_NEGATIVE = (
    "credit",
    "rotational_credit",
    "most_damping",
    "most_rotational_damping",
    "surplus",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Guarding:
    """What the guard does within a tick; everything is off by default.

    Attributes:
        controller: ``OFF``, ``DAMPER`` or ``ENVIRONMENT``.
        credit: Damping in N s/m that the energy account takes the device to burn.
        rotational_credit: Likewise in N m s/rad.
        most_damping: Largest damping in N s/m that the controller adds on an axis.
        most_rotational_damping: Likewise in N m s/rad.
        surplus: Largest energy in J that earlier dissipation may pay for.
        force_rise: Largest change of the force from tick to tick in N.
        torque_rise: Likewise in N m.
        stale_ticks: Ticks in a row without a new sample after which the wrench fades; 0: never.
        fade_ticks: Ticks in which it fades to zero.
        clutch: Mask of buttons; while one is held, the device moves without the handle.
        dead_man: Mask of buttons of which one must be held; 0: none need be.
        longest_stall: Time in s between two samples after which the coupling is re-seated.
        reseats: Whether a device that moved before the first tick is re-seated.
        speed: Speed of the device in m/s above which the run is stopped.
        turn_speed: Likewise in rad/s.
        stretch: Length of the coupling in m above which it is stopped.
        angle: Angle between handle and tool in rad, likewise.
        energy: Energy in J given to the device beyond what the hand put in, likewise.
        reach: Distance in m of the device from the origin of its frame beyond which it moves
            without the handle and without force.
        ramp_energy: Energy in J that the coupling may hold while the wrench rises at full pace; see
            ``kernel.ramp``.

    Raises:
        HapticBridgeError: A value is out of range.
    """

    controller: int = OFF
    credit: float = 0.0
    rotational_credit: float = 0.0
    most_damping: float = 0.0
    most_rotational_damping: float = 0.0
    surplus: float = 0.0
    force_rise: float = math.inf
    torque_rise: float = math.inf
    stale_ticks: int = 0
    fade_ticks: int = 1
    clutch: int = 0
    dead_man: int = 0
    longest_stall: float = math.inf
    reseats: bool = False
    speed: float = math.inf
    turn_speed: float = math.inf
    stretch: float = math.inf
    angle: float = math.inf
    energy: float = math.inf
    reach: float = math.inf
    ramp_energy: float = math.inf

    def __post_init__(self) -> None:
        if self.controller == _TANK_ALONE:
            raise HapticBridgeError(
                "the controller is a tank by itself, which only earlier versions of hapticbridge "
                "ran and judge; 'hapticbridge export' still reads a recording of it"
            )
        if self.controller not in (OFF, DAMPER, ENVIRONMENT):
            raise HapticBridgeError(f"controller is {self.controller!r}; it must be 0, 1 or 3")
        for name in _NOT_NEGATIVE:
            value = getattr(self, name)
            if not _is_number(value) or not 0 <= value < math.inf:
                raise HapticBridgeError(f"guard: {name} is {value!r}; it must be finite and >= 0")
        for name in (*_POSITIVE, *_TRIPS, *LATER):
            value = getattr(self, name)
            if not _is_number(value) or not value > 0:
                raise HapticBridgeError(f"guard: {name} is {value!r}; it must be > 0")
        for name, least in (("stale_ticks", 0), ("fade_ticks", 1), ("clutch", 0), ("dead_man", 0)):
            value = getattr(self, name)
            if not isinstance(value, int) or not least <= value < 2**MOST_BUTTONS:
                raise HapticBridgeError(f"guard: {name} is {value!r}; it must be >= {least}")

    def to_json(self) -> str:
        """Returns it as a recording keeps it: what is infinite is null."""
        values = asdict(self)
        return json.dumps({k: None if v == math.inf else v for k, v in values.items()})

    @classmethod
    def from_json(cls, text: str) -> Guarding:
        """Reads what ``to_json`` wrote.

        Raises:
            HapticBridgeError: The text is not that, or a value is out of range.
        """
        try:
            values = dict(read_json(text))
        except (ValueError, TypeError):
            values = {}
        names = {field.name for field in fields(cls)}
        if not names - LATER <= values.keys() <= names:
            raise HapticBridgeError(f"metadata 'guard' is {text!r:.80}; it does not name a guard")
        numbers: dict[str, Any] = {k: math.inf if v is None else v for k, v in values.items()}
        return cls(**numbers)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


UNGUARDED = Guarding()
"""Of runs that nobody feels, and of recordings made before there was a guard."""
