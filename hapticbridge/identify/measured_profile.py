"""Measured values of a device as a profile."""

from __future__ import annotations

from hapticbridge.device.profile import Profile, Quantity
from hapticbridge.identify.estimate import Estimate
from hapticbridge.identify.identification import UNHELD, Identification

_FIELDS = {
    "mass": ("mass", False),
    "damping": ("damping", False),
    "friction": ("friction", False),
    "rotational_inertia": ("mass", True),
    "rotational_damping": ("damping", True),
}


def measured_profile(
    result: Identification,
    *,
    device: str,
    serial: str,
    date: str,
    duration: float,
    workspace: tuple[float, float, float] | None = None,
) -> Profile:
    """Returns a profile of the unit with the most cautious values of each kind of axis.

    Args:
        result: Result of ``identify``.
        device: Name of the driver.
        serial: Serial number of the unit; may be empty.
        date: Date of the measurement, as written into the file.
        duration: Time per axis in s, as written into the file.
        workspace: Workspace in m, for a device whose metres are stated by the user. The measured
            values hold only together with it.
    """
    info = result.info
    source = f"identified on {date}: {duration:g} s per axis ({', '.join(result.fits)}); {UNHELD}"
    quantities: dict[str, Quantity] = {}
    for name, (field, turns) in _FIELDS.items():
        found = result.of_all(field, turns=turns)
        if found is not None:
            quantities[name] = _quantity(found, source)
    if result.resolution is not None:
        quantities["resolution"] = Quantity(result.resolution, source)
    late = [
        found
        for turns in (False, True)
        if (found := result.of_all("delay", turns=turns, most=True)) is not None
    ]
    quantities["delay"] = _quantity(max(late, key=lambda delay: delay.most), source)
    for name in ("force_limit", "torque_limit", "speed_limit"):
        quantities[name] = Quantity(float(getattr(info, name)), "from the driver, not measured")
    if info.reach is not None:
        quantities["reach"] = Quantity(info.reach, "as known before, not measured")
    if workspace is not None:
        quantities["workspace"] = Quantity(workspace, "stated or assumed when it was identified")
    return Profile(
        name=f"{info.name} {serial}".strip(),
        device=device,
        serial=serial,
        axes=info.axes,
        about="",
        quantities=quantities,
        models=(info.name,),
    )


def _quantity(found: Estimate, source: str) -> Quantity:
    # friction and delay are not negative, but a measurement of zero may be
    value = max(found.value, 0.0)
    return Quantity(value, source, (min(max(found.least, 0.0), value), max(found.most, value)))
