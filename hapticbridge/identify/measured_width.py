"""Measured and predicted Z-width of a device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hapticbridge.clock import Clock
from hapticbridge.device import Device
from hapticbridge.identify.wall import MeasuredLimit, measure_limit
from hapticbridge.passivity import ZWidth
from hapticbridge.passivity.z_width import WITHOUT_HAND

SHARES = (0.0, 0.15, 0.3, 0.5, 0.75)
"""Trial dampings as shares of the largest damping that is passive for any hand, without unit."""

FIRST_SHARE, MOST_SHARE = 0.2, 6.0
"""Start and end of each search as shares of the predicted stiffness at B = 0, without unit. A free
device bears up to three times the stiffness that is safe for any hand."""

FORCE_SHARE = 0.5
"""Share of the device's force limit that walls and pushes may use, without unit."""


@dataclass(frozen=True, slots=True)
class MeasuredWidth:
    """Stiffness limits measured on a device, beside the predicted ones.

    Attributes:
        limits: One limit per damping, ascending.
        predicted: Smallest predicted K in N/m over all lines of theory at each damping.
        unheld: Predicted K in N/m of the device without a hand; None if its mass is unknown.
    """

    limits: tuple[MeasuredLimit, ...]
    predicted: tuple[float, ...]
    unheld: tuple[float, ...] | None


def measure_width(
    device: Device,
    clock: Clock,
    z: ZWidth,
    *,
    axis: str = "x",
    force_share: float = FORCE_SHARE,
    progress: Callable[[int, int, str], None] | None = None,
) -> MeasuredWidth:
    """Finds the stiffest wall at several dampings; starts the device and leaves it open.

    Args:
        device: Device that is not started.
        clock: Clock that is not started.
        z: Predicted Z-width of the device at the trial rate.
        axis: One of x, y, z that the device has.
        force_share: Share of the device's force limit that may be used.
        progress: Called with the completed count, the total count and a description of the trial.

    Raises:
        IdentificationError: The pose is not finite.
        DeviceError: The device failed.

    References:
        Colgate & Brown 1994, *Factors affecting the Z-width of a haptic display*.
    """
    device.start(z.period)
    clock.start(round(z.period * 1e9))
    largest = next(line for line in z.lines if line.is_required).largest_damping
    dampings = [share * largest for share in SHARES]
    limits = []
    for k, damping in enumerate(dampings):

        def report(stiffness: float, k: int = k, damping: float = damping) -> None:
            if progress is not None:
                progress(k, len(dampings), f"B = {damping:.3g}, K = {stiffness:.4g}")

        limits.append(
            measure_limit(
                device,
                clock,
                damping=damping,
                period=z.period,
                force=force_share * device.info.force_limit,
                axis=axis,
                first_stiffness=FIRST_SHARE * float(z.limit[0]),
                most_stiffness=MOST_SHARE * float(z.limit[0]),
                progress=report,
            )
        )
    unheld = [line for line in z.lines if line.name == WITHOUT_HAND]
    return MeasuredWidth(
        limits=tuple(limits),
        predicted=tuple(float(np.interp(b, z.damping, z.limit)) for b in dampings),
        unheld=tuple(float(np.interp(b, z.damping, unheld[0].stiffness)) for b in dampings)
        if unheld
        else None,
    )


def measured_points(measured: MeasuredWidth) -> list[tuple[float, float, float]]:
    """Returns (B, K, half-width of K) of every limit found."""
    return [
        (limit.damping, limit.stiffness, 0.5 * (limit.not_borne - limit.borne))
        for limit in measured.limits
        if limit.not_borne is not None
    ]
