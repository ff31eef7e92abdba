"""Protocol of a haptic device: four calls and a data sheet."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import (
    Rule,
    check_fields,
    checked_value,
    is_number,
    option,
    rule,
    rule_of,
    shown,
)
from hapticbridge.dataclass_json import from_json, to_json
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.pose import Quaternion, canonical
from hapticbridge.kernel.record import SAMPLE_DTYPE


@contextmanager
def calling_on_error(close: Callable[[], None]) -> Iterator[None]:
    """Calls a function if the block fails, such as ``close`` of a device or of its link."""
    try:
        yield
    except BaseException:
        close()
        raise


class Closable(Protocol):
    """Link or guardian of a device."""

    def close(self) -> None:
        """Releases it."""


@contextmanager
def released(*parts: Closable | None) -> Iterator[None]:
    """Closes the parts of a device after its last command, which a lost device does not take.

    A lost device has no force, or its own watchdog ends it.
    """
    try:
        with suppress(DeviceLost):
            yield
    finally:
        for part in parts:
            if part is not None:
                part.close()


# Data sheet of a haptic device


def checked_number(name: str, value: object, unit: str, *, is_positive: bool = False) -> float:
    """Returns a parameter as a float if it is a finite real number >= 0 (> 0 with ``is_positive``).

    Raises:
        DeviceError: The value is not a number, not finite, or out of range.
    """
    own = Rule(unit=unit, least=0.0, is_open=is_positive)
    return float(checked_value(name, value, (float,), own, DeviceError))


ROTATION_ERROR = 1e-3
"""Largest deviation of R Rᵀ from the identity, without unit. A larger one is not due to
rounding."""


def checked_rotation(frame: Sequence[float], name: str) -> Quaternion:
    """Returns the unit quaternion (w, x, y, z) of a rotation matrix.

    Args:
        frame: Nine numbers, row by row.
        name: Name of the device in messages.

    Raises:
        DeviceError: The matrix is not a rotation, or a number in it is not finite.
    """
    flat = np.array(frame)
    matrix = flat.reshape(3, 3)
    is_finite = bool(np.isfinite(matrix).all())
    if not is_finite or not (
        np.abs(matrix @ matrix.T - np.eye(3)).max() < ROTATION_ERROR and np.linalg.det(matrix) > 0
    ):
        raise DeviceError(
            f"{name} reports an orientation that is not a rotation; check its cable and restart it"
        )
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, flat)
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return canonical((w, x, y, z))


def checked_period(period: float) -> float:
    """Returns the loop's period in s if it is finite and > 0; otherwise raises DeviceError."""
    return checked_number("the loop's period", period, "s", is_positive=True)


TIMING = 0.1
"""Length in s of a measurement of a device's rate or delay, before a run."""

ON_TIME = 0.95
"""Share of answers within the delay, without unit. The slowest answers are stalls of the host,
which the loop counts as missed deadlines."""


def usual_delay(times: Iterable[float]) -> float:
    """Returns the delay in s that the share ``ON_TIME`` of measured delays meets."""
    ordered = sorted(times)
    return ordered[math.ceil(ON_TIME * len(ordered)) - 1]


AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Axes of a device in its own frame: translation (x, y, z) and rotation (rx, ry, rz)."""

JUMP_MARGIN = 2.0
"""Factor on the data sheet's speed limit above which a motion is a fault, without unit. A late
sample followed by a punctual one shows up to two periods of motion in one."""

USUAL_FORCE_LIMIT, USUAL_TORQUE_LIMIT, USUAL_SPEED_LIMIT = 10.0, 0.5, 5.0
"""Default limits in N, N m and m/s for sheets without a figure of their own. Force and torque are
those of a desktop device; only a fault exceeds the speed. For a device without motors the limits of
force and torque apply only to the recording."""


def stated_numbers(options: Mapping[str, object], names: Iterable[str]) -> dict[str, float]:
    """Returns the numbers of the data sheet among a device's options; None means not stated.

    Raises:
        DeviceError: A number is out of range.
    """
    return {
        name: float(checked_value(name, options[name], (float,), _NUMBERS[name], DeviceError))
        for name in names
        if options.get(name) is not None
    }


def stated_switch(options: Mapping[str, object], name: str) -> bool:
    """Returns an option that is 1 (on) or 0 (off); on if it is not stated.

    Raises:
        DeviceError: It is neither.
    """
    value = options.get(name, 1.0)
    if value not in (0, 1):
        raise DeviceError(f"{name} is {shown(value)}; it must be 1 (on) or 0 (off)")
    return bool(value)


def _in_order(name: str, value: object, valid: Sequence[str]) -> tuple[str, ...]:
    """Returns axes as a tuple; refuses others than the valid ones, each once, in their order."""
    own = tuple(value) if isinstance(value, tuple | list) else None
    if own is None or own != tuple(axis for axis in valid if axis in own):
        raise DeviceError(
            f"{name} is {shown(value)}; it must be of {', '.join(valid)}, each once, in this order"
        )
    return own


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceInfo:
    """Data sheet of a device, used by the guard and stored in the recording.

    Attributes:
        name: Name of the device, not empty.
        axes: Axes out of ``AXES`` with a motor, in that order, at least one. Missing axes do not
            move, except those of ``sensed``, and no wrench acts on them.
        mass: Inertia at the handle in kg, > 0; None if unknown.
        damping: Physical damping b at the handle in N s/m, >= 0; None if unknown or if the motion
            is prescribed. The condition b >= KT/2 + B' is checked against it.
        rotational_inertia: Rotational inertia at the handle in kg m², > 0; None if unknown.
        rotational_damping: Rotational damping at the handle in N m s/rad, >= 0; None if unknown.
        friction: Coulomb friction per axis in N, >= 0; None if unknown.
        resolution: Step of the reported position in m, >= 0 (0: none); None if unknown.
        force_limit: Largest norm of a commanded force in N, > 0. The tool gets no more, either.
        torque_limit: Largest norm of a commanded torque in N m, > 0; by default 0.5.
        speed_limit: Largest possible speed in m/s, >= 0; by default 5. A pose that moves faster
            than twice this speed stops the run; 0 for none.
        rate: The device's own rate in Hz, > 0; None if it follows the bridge.
        delay: Age of a sample when the loop reads it, plus the time until a written wrench acts, in
            s, 0 to 1; None if unknown.
        is_delay_measured: True if ``delay`` was measured, as 'hapticbridge identify' does, or is
            exact, as in a simulation; a certificate names a delay that is a statement alone.
        is_prescribed: True if the motion does not react to force.
        is_real: True if motors act on a person's hand. The default is the safe one: such a device
            runs on a real clock only, and waits for the hand to be still.
        duration: Time in s after which the motion ends by itself, >= 0; None if it does not.
        serial: The unit's serial number; empty if it has none.
        buttons: Number of buttons; None if unknown.
        reach: Largest possible distance in m from the origin of its frame, > 0; beyond it are only
            the stops. None if unknown.
        sensed: Further axes that it senses without a motor, such as those of a wrist; by default
            none. The hand does not feel what its motion about them does.
        loop_period: Period in s of a loop of its own, in which it renders the coupling to a shown
            tool (``device.own_loop``), > 0; None without one.
        loop_delay: Time in s in that loop from reading a position to its force, >= 0.
        grip_axis: Data sheet of the grip between the fingers, with the one axis ``x``: how far it
            is closed in m. Its ``reach`` is its travel. None without one.

    Raises:
        DeviceError: A value is of the wrong type, not finite, or out of range.
    """

    name: str = field(metadata=rule(is_filled=True))
    axes: tuple[str, ...]
    mass: float | None = option(None, unit="kg", least=0.0, is_open=True)
    damping: float | None = option(None, unit="N s/m", least=0.0)
    rotational_inertia: float | None = option(None, unit="kg m²", least=0.0, is_open=True)
    rotational_damping: float | None = option(None, unit="N m s/rad", least=0.0)
    friction: float | None = option(None, unit="N", least=0.0)
    resolution: float | None = option(None, unit="m", least=0.0)
    force_limit: float = field(metadata=rule(unit="N", least=0.0, is_open=True))
    torque_limit: float = option(USUAL_TORQUE_LIMIT, unit="N m", least=0.0, is_open=True)
    speed_limit: float = option(USUAL_SPEED_LIMIT, unit="m/s", least=0.0)
    rate: float | None = option(None, unit="Hz", least=0.0, is_open=True)
    delay: float | None = option(None, unit="s", least=0.0, most=1.0)
    is_delay_measured: bool = False
    is_prescribed: bool = False
    is_real: bool = True
    duration: float | None = option(None, unit="s", least=0.0)
    serial: str = ""
    reach: float | None = option(None, unit="m", least=0.0, is_open=True)
    buttons: int | None = option(None, least=0)
    sensed: tuple[str, ...] = ()
    loop_period: float | None = option(None, unit="s", least=0.0, is_open=True)
    loop_delay: float = option(0.0, unit="s", least=0.0)
    grip_axis: DeviceInfo | None = None

    def __post_init__(self) -> None:
        for name, remedy in _WITHOUT_MOTOR.items():
            if is_number(value := getattr(self, name)) and value == 0:
                raise DeviceError(f"{name} is 0; it must be > 0: {remedy}")
        check_fields(self, DeviceError)
        axes = _in_order("axes", self.axes, AXES)
        if not axes:
            raise DeviceError(f"axes is {shown(self.axes)}; it must be one or more of {AXES}")
        sensed = _in_order("sensed", self.sensed, [axis for axis in AXES if axis not in axes])
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "sensed", sensed)
        if self.grip_axis is not None and self.grip_axis.axes != AXES[:1]:
            raise DeviceError(f"grip axis is {shown(self.grip_axis)}; it must have the axis x")

    @property
    def degrees_of_freedom(self) -> int:
        """Number of axes."""
        return len(self.axes)

    @property
    def moves(self) -> bool:
        """True if it moves along any axis."""
        return any(axis in self.axes for axis in AXES[:3])

    @property
    def turns(self) -> bool:
        """True if it turns about any axis."""
        return any(axis in self.axes for axis in AXES[3:])

    @property
    def senses(self) -> tuple[bool, bool]:
        """True if it senses translation, and if it senses rotation, without a motor."""
        return (
            any(axis in AXES[:3] for axis in self.sensed),
            any(axis in AXES[3:] for axis in self.sensed),
        )

    @property
    def dissipating_damping(self) -> tuple[float | None, float | None]:
        """Damping that dissipates energy, in N s/m and N m s/rad; (None, None) if unknown.

        If one kind of axis is unknown, both are, because the energy cannot be assigned to an axis.
        Without translation its part is 0. A device without rotation has no rotational part, and
        neither has a kind of axis that is sensed without a motor: its motion would dissipate
        nothing that the hand gets. A prescribed motion stores and dissipates nothing.
        """
        is_complete = self.rotational_damping is not None or not self.turns
        if self.is_prescribed or not is_complete:
            return None, None
        slides, turns = self.senses
        if slides:
            return None, None
        return self.damping if self.moves else 0.0, None if turns else self.rotational_damping

    def to_json(self) -> str:
        """Returns the sheet as one JSON object: a key per attribute, null if unknown."""
        return to_json(self)

    @classmethod
    def from_json(cls, text: str) -> DeviceInfo:
        """Returns the sheet from the text of ``to_json``.

        Raises:
            DeviceError: The text is not a JSON object with these keys, or a value is invalid.
        """
        return from_json(cls, text, "device data", DeviceError)


_WITHOUT_MOTOR = {
    "force_limit": (
        "it limits the force on the tool, too, even if no motor gives it to the hand; a device "
        "without any motor states is_prescribed=True"
    ),
    "torque_limit": "it limits the torque on the tool, too; for the usual 0.5 N m leave it out",
}
"""Remedies for limits of 0, by field."""

_NUMBERS = {each.name: rule_of(each) for each in fields(DeviceInfo) if rule_of(each).unit}

DATA_SHEET_UNITS = {name: own.unit for name, own in _NUMBERS.items()}
"""SI units of the numbers in a device's data sheet."""


class Device(Protocol):
    """Source of the handle's motion and sink of the wrench.

    The loop calls ``start`` once, then ``read`` and later ``write`` in each tick, and finally
    ``close``. The sample of tick k is the device's state at the time k · period, so the first
    ``read`` returns the pose of ``start`` if the device has not moved. A wrench written in tick k
    acts until the next write. No call may block the loop for longer than a fraction of the period:
    a slow transport reads in a thread of its own, and ``read`` returns its newest sample.

    A device with a grip axis returns two samples, the second that of the grip axis along x. If that
    axis is coupled, ``read`` gets two samples and ``write`` two wrenches, (2, 6); else one of each.

    If a device has a ``remark``, a clause on frames that it lost or forces that it did not give,
    the run's summary shows it; empty for nothing.

    An object with these calls can be given to a ``Bridge``. A package of its own selects it by a
    name (``guide/device_package.md``); ``testing.device_contract`` tests it.

    A whole device, a handle on a rail in a hand that swings it::

        import math

        import hapticbridge as hb
        import numpy as np

        class Rail:
            info = hb.DeviceInfo(
                name="rail", axes=("x",), force_limit=10.0, damping=2.0, delay=0.0, is_real=False
            )

            def start(self, period):
                self.period, self.tick = period, 0
                self.position = self.velocity = self.force = 0.0
                sample = np.zeros(1, hb.SAMPLE_DTYPE)
                sample["quaternion"][0] = 1.0, 0.0, 0.0, 0.0
                return sample

            def read(self, sample):
                if self.tick > 0:  # the first sample is the state at the start
                    pull = 0.3 * math.cos(6.0 * self.tick * self.period) + self.force
                    self.velocity += self.period * (pull - 2.0 * self.velocity) / 0.6
                    self.position += self.period * self.velocity
                self.tick += 1
                sample[0] = (self.position, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0
                return 0

            def write(self, wrench):
                self.force = wrench[0]

            def close(self):
                self.force = 0.0

        with hb.Bridge("point_mass", Rail(), clock=hb.SimulatedClock()) as bridge:
            summary = bridge.run(duration=1.0)

    Attributes:
        info: The device's data sheet, complete before ``start``.
    """

    info: DeviceInfo

    def start(self, period: float) -> NDArray[np.void]:
        """Brings the device to its initial state, from which runs are reproducible.

        Args:
            period: The loop's period in s, finite and > 0.

        Returns:
            The pose before the first tick, shape (1,), ``SAMPLE_DTYPE``; (2,) with a grip axis.

        Raises:
            DeviceError: The device cannot run at this period.
        """

    def read(self, sample: NDArray[np.void]) -> int:
        """Writes the newest sample, without waiting for one.

        Args:
            sample: Output, shape (1,), ``SAMPLE_DTYPE``. It belongs to the loop: write every field,
                do not read it, and keep no reference.

        Returns:
            0 for a new sample; ``TickFlag.STALE_SAMPLE`` if the sample repeats the last one.

        Raises:
            DeviceLost: The device is gone, or silent for too long (``hapticbridge.DeviceLost``).
        """

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench that is held until the next write.

        Args:
            wrench: Shape (6,): force in N, torque in N m, on the device, in the device's frame.
                Components without an axis are ignored.

        Raises:
            DeviceLost: The device is gone.
        """

    def close(self) -> None:
        """Releases the device; may be called more than once."""


def _is_ours(device: Device) -> bool:
    return type(device).__module__.startswith("hapticbridge.")


def _as_device_error(call: str, error: Exception) -> DeviceError:
    """Returns the error itself if it is a ``DeviceError``, else one that names the failed call."""
    if isinstance(error, DeviceError):
        return error
    return DeviceError(f"{call} failed with {type(error).__name__}: {error}")


@contextmanager
def telling(call: str) -> Iterator[None]:
    """Turns any error of a call into a ``DeviceError`` that names the call."""
    try:
        yield
    except Exception as error:
        raise _as_device_error(call, error) from error


def checked(device: Device) -> Device:
    """Returns a device of this package, or one with the checked calls of another package's."""
    return device if _is_ours(device) else _Checked(device)


class _Checked:
    """Device of another package: whatever it raises is a ``DeviceError`` that names the call."""

    def __init__(self, device: Device) -> None:
        self._device, self.info = device, device.info
        self._of = f"device '{device.info.name}'"

    def start(self, period: float) -> NDArray[np.void]:
        with telling(f"{self._of}: start"):
            sample = self._device.start(period)
        if not isinstance(sample, np.ndarray) or sample.dtype != SAMPLE_DTYPE or sample.ndim != 1:
            raise DeviceError(
                f"{self._of}: start returned {shown(sample)}; it must be an array of SAMPLE_DTYPE "
                "with the shape (1,), or (2,) with a grip axis"
            )
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        try:  # as telling(), without an object per tick
            flags = self._device.read(sample)
        except Exception as error:
            raise _as_device_error(f"{self._of}: read", error) from error
        if not isinstance(flags, int | np.integer):
            raise DeviceError(
                f"{self._of}: read returned {shown(flags)}; it must be 0 for a new sample, or "
                "TickFlag.STALE_SAMPLE"
            )
        return int(flags)

    def write(self, wrench: NDArray[np.float64]) -> None:
        try:
            self._device.write(wrench)
        except Exception as error:
            raise _as_device_error(f"{self._of}: write", error) from error

    def close(self) -> None:
        with telling(f"{self._of}: close"):
            self._device.close()

    @property
    def remark(self) -> str:
        with telling(f"{self._of}: remark"):
            return device_remark(self._device)


def device_remark(device: Device) -> str:
    """Returns a device's ``remark`` on lost frames and forces not given; empty without one."""
    return str(getattr(device, "remark", ""))


def device_fault(device: object) -> str:
    """Returns what keeps an object from being a device, as "lacks close"; empty for a device."""
    if isinstance(device, type):
        return "is a class, and no object of it"
    if not isinstance(getattr(device, "info", None), DeviceInfo):
        return "has no DeviceInfo as info"
    calls = ("start", "read", "write", "close")
    lacking = [call for call in calls if not callable(getattr(device, call, None))]
    return f"lacks {', '.join(lacking)}" if lacking else ""
