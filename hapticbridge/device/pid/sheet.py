"""What is known, stated and assumed of a force-feedback stick: its scales and its data sheet."""

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
"""Full scale in N that is assumed where nobody says it: more than an ordinary stick has, so that
what is asked for comes out weaker. A stronger one exists; only a force gauge tells."""

ASSUMED_TRAVEL = 0.1
"""In m from stop to stop, likewise: a grip some 12 cm above its pivot that turns by 24° to each
side."""

CHANGES = ("mass", "damping", "friction")
"""Numbers of the data sheet that the user may know."""

_AXES = ("x", "y")


@dataclass(frozen=True, slots=True, eq=False)
class Scale:
    """What a stick's counts are in metres and newtons.

    Attributes:
        newtons: Force at full scale in N, > 0.
        travel: From stop to stop of each axis in m, > 0.
        signs: Of the force per axis, shape (2,), -1 where the firmware turns it round.
    """

    newtons: float
    travel: float
    signs: NDArray[np.float64]


def scale_of(
    options: Mapping[str, object], serial: str, model: str, tell: Tell
) -> tuple[Scale, dict[str, object]]:
    """Returns the scale, and what else of the options is for the data sheet.

    What the user says goes first, then the profile of the unit or its model (``force_limit``:
    newtons at full scale; ``workspace``: travel), then an assumption, of which the user is told.
    What a profile was measured with must not be changed: its b would be in other units than the
    force.

    Args:
        options: As given to ``open_device``.
        serial: The unit's.
        model: What the stick calls itself; the profile of another model is not taken.
        tell: Takes the sentence.

    Raises:
        DeviceError: A number is out of range, contradicts the profile, or states what nobody can
            know without the scale.
    """
    measured = _measured_with(options.get("profile"), serial, model)
    for name, value in measured.items():
        asked = options.get(name, value)
        if value is not None and asked != value:
            raise DeviceError(
                f"{name} = {asked!r}: the profile of this stick was measured with {value:g}, and "
                f"its damping holds for that alone; leave out {name}=, or add profile=none"
            )
    stated = {name: options.get(name, value) for name, value in measured.items()}
    changes = {name: options[name] for name in CHANGES if name in options}
    missing = [f"{name}=" for name, value in stated.items() if value is None]
    if changes and missing:
        raise DeviceError(
            f"{next(iter(changes))} is in newtons and metres, of which a stick knows nothing: say "
            f"{' and '.join(missing)} too"
        )
    if missing:
        tell(
            f"nobody says how strong or how wide this stick is: full scale is taken for "
            f"{ASSUMED_NEWTONS:g} N and its travel for {1e3 * ASSUMED_TRAVEL:g} mm where not "
            f"stated; {' and '.join(missing)} state it"
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
    """Returns the scale that a profile's numbers are in; None where it does not say."""
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
    """Makes a data sheet.

    Its rate is that of a force on both axes, two reports: the loop's period counts as no shorter in
    b >= KT/2 + B. Its delay is unknown, because no firmware says its own.

    Args:
        name: What the device is called.
        serial: Its serial number.
        scale: Newtons and metres.
        step: Least change of deflection per axis, of -1 to 1.
        intervals: Time per report from and to the device, in s; None where unknown.
        known: Of ``CHANGES``.

    Raises:
        DeviceError: A number is out of range.
    """
    asked, told = intervals
    period = None if told is None else max(asked or 0.0, len(_AXES) * told)
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
