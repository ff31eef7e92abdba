"""Everything beside scene and device motion that decides what a run computes."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.arguments import Arguments
from hapticbridge.coupling import Coupling
from hapticbridge.errors import HapticBridgeError
from hapticbridge.files import read_json
from hapticbridge.kernel.codes import COUPLED, DIRECT, HELD, LOSSLESS, WELD, has_law, laws_per_tick

# What the guard does within a tick, as numbers: part of what decides what a run computes.

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
class GuardParameters:
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
    def from_json(cls, text: str) -> GuardParameters:
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


UNGUARDED = GuardParameters()
"""Of runs that nobody feels, and of recordings made before there was a guard."""


SLACK_SHARE = 0.5
"""Share of ½‖δx_i‖²_{K + nB/T} that counts as slack where n > 1 laws are computed in a tick; no
unit. A larger one needs more device damping (infinite at 1 and B = 0), a smaller one calls an
environment active sooner."""

MOST_SUBSTEPS = 100
"""MuJoCo steps per tick at most; more would not fit into any period that can be felt."""


def checked_substeps(substeps: int, error: type[HapticBridgeError] = HapticBridgeError) -> int:
    """Returns a number of MuJoCo steps per tick, 1 to ``MOST_SUBSTEPS``.

    Raises:
        HapticBridgeError: It is not; of the kind asked for.
    """
    return Arguments(error).whole("substeps", substeps, least=1, most=MOST_SUBSTEPS)


def refuse_substeps(scheme: int, substeps: int) -> None:
    """Refuses more than one MuJoCo step per tick for a scheme that takes but one.

    Raises:
        HapticBridgeError: Says why the scheme takes but one.
    """
    reasons = {
        DIRECT: "a tool without mass has no motion to divide",
        LOSSLESS: "a lossless coupling carries half of a tick's wrench over to the next",
    }
    if substeps != 1 and scheme in reasons:
        raise HapticBridgeError(f"substeps is {substeps!r}; {reasons[scheme]}, so it must be 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunParameters:
    """Everything beside scene and device motion that decides what a run computes.

    Attributes:
        grip: Name of the site on the tool.
        period: T in s.
        substeps: MuJoCo steps per tick, >= 1.
        coupling: K and B' of the law, which is not what is felt (``rendering.Method.used``).
        scale: Handle motion per device motion, without unit.
        force_scale: Force on the device per force on the tool, without unit. Power is equal on both
            sides where it equals ``scale``; torques return by force_scale / scale.
        axes: Row-major rotation from the device's frame to the scene's.
        force_limit: Largest force norm on the device in N.
        torque_limit: Largest torque norm on the device in N m.
        ramp_ticks: Ticks over which the wrench on the device rises to its full value.
        device_origin: Device pose (x, y, z, qw, qx, qy, qz) that maps to ``handle_origin``.
        handle_origin: Handle pose of the same form, in the scene.
        device_start: Device pose of the same form before the first tick.
        scheme: How the wrench reaches the tool, one of ``kernel.scheme``'s five.
        felt: The coupling that the tool is really held by, where it is not ``coupling`` (a weld);
            the device condition is judged by it.
        contact_stiffness: K_c in N/m per contact of a tool without mass, > 0 for it, else 0.
        device_damping: b of the device in N s/m, None where unknown, in rotation too, or where the
            motion is prescribed. What the device was given is held against what this burns.
        device_rotational_damping: In N m s/rad, None likewise, or where nothing turns.
        guarding: What the guard does within a tick.

    Raises:
        HapticBridgeError: A value is out of range.
    """

    grip: str
    period: float
    substeps: int
    coupling: Coupling
    scale: float = 1.0
    force_scale: float = 1.0
    axes: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    force_limit: float
    torque_limit: float
    ramp_ticks: int
    device_origin: tuple[float, ...]
    handle_origin: tuple[float, ...]
    device_start: tuple[float, ...]
    scheme: int = COUPLED
    felt: Coupling | None = None
    contact_stiffness: float = 0.0
    device_damping: float | None = None
    device_rotational_damping: float | None = None
    guarding: GuardParameters = UNGUARDED

    def __post_init__(self) -> None:
        checked_substeps(self.substeps)
        positive = ("period", "scale", "force_scale", "force_limit", "torque_limit")
        for name in positive:
            value = getattr(self, name)
            if not math.isfinite(value) or value <= 0:
                raise HapticBridgeError(f"{name} is {value!r}; it must be finite and > 0")
        if self.scheme not in (COUPLED, HELD, WELD, DIRECT, LOSSLESS):
            raise HapticBridgeError(f"scheme is {self.scheme!r}; it must be 0 to 4")
        stiffness = self.contact_stiffness
        if (
            not math.isfinite(stiffness)
            or stiffness < 0
            or (stiffness > 0) != (self.scheme == DIRECT)
        ):
            raise HapticBridgeError(
                f"contact stiffness is {stiffness!r} N/m; it must be finite and > 0 for a tool "
                "without mass, and has no meaning for another"
            )
        refuse_substeps(self.scheme, self.substeps)
        if self.ramp_ticks < 0:
            raise HapticBridgeError(f"ramp_ticks is {self.ramp_ticks}; it must be >= 0")
        for name in ("device_origin", "handle_origin", "device_start"):
            pose = getattr(self, name)
            if len(pose) != 7 or not all(math.isfinite(value) for value in pose):
                raise HapticBridgeError(f"{name} is {pose!r}; it must be 7 finite numbers")
            if abs(math.hypot(*pose[3:]) - 1) > 1e-9:
                raise HapticBridgeError(f"{name} is {pose!r}; its quaternion must have norm 1")
        rotation = np.asarray(self.axes, dtype=np.float64)
        if rotation.shape != (9,) or not (
            np.allclose(rotation.reshape(3, 3) @ rotation.reshape(3, 3).T, np.eye(3), atol=1e-12)
            and np.linalg.det(rotation.reshape(3, 3)) > 0
        ):
            raise _no_rotation(self.axes)

    @property
    def laws(self) -> int:
        """How often per tick the wrench on the tool is computed."""
        return laws_per_tick(self.scheme, self.substeps)

    @property
    def has_law(self) -> bool:
        """Whether the coupling law gives the wrench."""
        return has_law(self.scheme)

    def slack_gains(self) -> tuple[float, float]:
        """Returns gain g in N/m and its rotational counterpart in N m/rad: slack = Σ ½ g ‖δx_k‖².

        g = K + B/T with one law a tick, half of K/n + B/T with n > 1; zero where no coupling law
        gives the wrench (a weld, a tool without mass): the proof that affords a slack needs one.
        With several laws a tick, ½‖δx_i‖²_{K + nB/T} per law would be affordable at no device
        damping where B = 0; half of it is (``certificate.required_damping``), and of the motions
        δx_i the records only tell their sum, over which uniform motion is least.
        """
        if not self.has_law:
            return 0.0, 0.0
        coupling = self.coupling
        share = 1.0 if self.laws == 1 else SLACK_SHARE
        return (
            share * (coupling.stiffness / self.laws + coupling.damping / self.period),
            share
            * (
                coupling.rotational_stiffness / self.laws
                + coupling.rotational_damping / self.period
            ),
        )


_ROUNDING = 4 * np.finfo(np.float64).eps
"""How far from a rotation the polar factor may be by rounding; no unit."""


def rotation_numbers(matrix: ArrayLike) -> tuple[float, ...]:
    """Returns the 9 numbers, row by row, of the rotation nearest to a matrix.

    Axes are written with few digits (0.707107); the polar factor makes them a rotation to the last
    one, so that positions, orientations and forces turn by the same.

    Args:
        matrix: 3 × 3, or 9 numbers; orthogonal to 1e-5 and right-handed.

    Raises:
        HapticBridgeError: It is not.
    """
    try:
        given = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        given = np.zeros(0)
    if given.size == 9 and np.all(np.isfinite(given)):
        square = given.reshape(3, 3)
        off = np.abs(square @ square.T - np.eye(3)).max()
        if off < 1e-5 and np.linalg.det(square) > 0:
            if off < _ROUNDING:  # once more would turn the last digits of one that was recorded
                return tuple(square.ravel().tolist())
            left, _, right = np.linalg.svd(square)
            return tuple((left @ right).ravel().tolist())
    raise _no_rotation(matrix)


def _no_rotation(axes: object) -> HapticBridgeError:
    return HapticBridgeError(
        f"axes is {axes!r}; it must be the 9 numbers of a right-handed rotation matrix, row by row"
    )
