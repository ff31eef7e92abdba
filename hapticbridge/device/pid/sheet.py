"""Scale and data sheet of a force-feedback stick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.data_sheet import (
    USUAL_SPEED_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_number,
)
from hapticbridge.device.plugged import Tell
from hapticbridge.device.profile_search import profile_named, profile_of
from hapticbridge.errors import DeviceError

ASSUMED_NEWTONS = 10.0
"""Assumed force at full scale in N: more than that of an ordinary stick, so that forces come out
weaker than commanded. Stronger sticks exist; only a force gauge shows the true value."""

ASSUMED_TRAVEL = 0.1
"""Assumed travel from stop to stop in m: a grip some 12 cm above its pivot that turns by 24° to
each side."""

CHANGES = ("mass", "damping", "friction")
"""Numbers of the data sheet that the user may state."""

_AXES = ("x", "y")


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """Scale of a stick's counts in metres and newtons.

    Attributes:
        newtons: Force at full scale in N, > 0.
        travel: Travel of each axis from stop to stop in m, > 0.
        signs: Sign of the force per axis, shape (2,); -1 if the firmware reverses it.
    """

    newtons: float
    travel: float
    signs: NDArray[np.float64]


def scale_of(
    options: Mapping[str, object], serial: str, model: str, tell: Tell
) -> tuple[Scale, dict[str, object]]:
    """Returns the scale, and the options for the data sheet.

    The user's options take precedence over the profile of the unit or its model (``force_limit``:
    newtons at full scale; ``workspace``: travel). Without either, a value is assumed and reported.
    The scale of a measured profile cannot be changed, because its b would then have other units
    than the force.

    Args:
        options: Options of ``open_device``.
        serial: Serial number of the unit.
        model: Name that the stick reports; the profile of another model is not used.
        tell: Receives the message about an assumed scale.

    Raises:
        DeviceError: A number is out of range, contradicts the profile, or is stated without the
            scale on which it depends.
    """
    measured = _measured_with(options.get("profile"), serial, model)
    for name, value in measured.items():
        requested = options.get(name, value)
        if value is not None and requested != value:
            raise DeviceError(
                f"{name} = {requested!r}: the profile of this stick was measured with {value:g}, "
                f"and its damping holds for that only; leave out {name}=, or add profile=none"
            )
    stated = {name: options.get(name, value) for name, value in measured.items()}
    changes = {name: options[name] for name in CHANGES if name in options}
    missing = [f"{name}=" for name, value in stated.items() if value is None]
    if changes and missing:
        raise DeviceError(
            f"{next(iter(changes))} is in newtons and metres, and a stick has no scale for them: "
            f"state {' and '.join(missing)} too"
        )
    if missing:
        tell(
            f"the strength or the travel of this stick is unknown: {ASSUMED_NEWTONS:g} N at full "
            f"scale and a travel of {1e3 * ASSUMED_TRAVEL:g} mm are assumed unless stated; "
            f"{' and '.join(missing)} state it"
        )
    newtons, travel = (
        checked_number(name, assumed if value is None else value, unit, is_positive=True)
        for (name, value), assumed, unit in zip(
            stated.items(), (ASSUMED_NEWTONS, ASSUMED_TRAVEL), ("N", "m"), strict=True
        )
    )
    reverse = options.get("reverse", "")
    if reverse not in ("", "x", "y", "xy"):
        raise DeviceError(f"reverse = {reverse!r}: must be 'x', 'y' or 'xy', the axes to reverse")
    signs = np.array([-1.0 if axis in str(reverse) else 1.0 for axis in _AXES])
    return Scale(newtons, travel, signs), changes


def _measured_with(named: object, serial: str, model: str) -> dict[str, float | None]:
    """Returns the scale of a profile's numbers; None for an unknown part."""
    profile = profile_of("pid", serial, model) if named is None else None
    if named not in (None, "none"):
        profile = profile_named(str(named))
    known = {} if profile is None else {k: q.value for k, q in profile.quantities.items()}
    newtons, workspace = known.get("force_limit"), known.get("workspace")
    return {
        "newtons": newtons if isinstance(newtons, float) else None,
        "travel": workspace[0] if isinstance(workspace, tuple) else None,
    }


def data_sheet(
    name: str,
    serial: str,
    scale: Scale,
    step: tuple[float, ...],
    intervals: tuple[float | None, float | None],
    known: dict[str, Any],
) -> DeviceInfo:
    """Returns the data sheet of a stick.

    Its rate is that of a force on both axes, two reports. In b >= KT/2 + B the loop's period counts
    as no shorter than that. Its delay is unknown, because no firmware reports it.

    Args:
        name: Name of the device.
        serial: Its serial number.
        scale: Newtons and metres.
        step: Smallest change of deflection per axis, of -1 to 1.
        intervals: Time per report from and to the device, in s; None if unknown.
        known: Numbers of ``CHANGES``.

    Raises:
        DeviceError: A number is out of range.
    """
    read_interval, write_interval = intervals
    period = (
        None if write_interval is None else max(read_interval or 0.0, len(_AXES) * write_interval)
    )
    values: dict[str, Any] = dict.fromkeys(CHANGES) | known
    return DeviceInfo(
        name=name,
        serial=serial,
        axes=_AXES,
        rotational_inertia=None,
        rotational_damping=None,
        resolution=0.5 * scale.travel * max(step),
        force_limit=scale.newtons,
        torque_limit=USUAL_TORQUE_LIMIT,
        speed_limit=USUAL_SPEED_LIMIT,
        rate=None if period is None else 1.0 / period,
        delay=None,
        is_prescribed=False,
        is_real=True,
        duration=None,
        **values,
    )
