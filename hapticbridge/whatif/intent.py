"""Intended motion of a recorded hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.device import DeviceInfo, Hand
from hapticbridge.device.lateness import delay_ticks

Array = NDArray[np.float64]

INTENT = 8e-3
"""Standard deviation in s of the Gaussian that smooths the hand's intended motion. It halves motion
at 23 Hz, faster than an arm moves on purpose. A longer one loses fast strokes, a shorter one keeps
noise."""


def intended(
    info: DeviceInfo,
    hand: Hand,
    ticks: NDArray[np.void],
    period: float,
    start: tuple[float, ...],
) -> Array:
    """Returns the hand's intended motion p, as a ``Motion.table`` relative to the start.

    A recording shows the motion of a hand, not its intent. The hand must have applied f = m a + b v
    − w, with the device's m and b and the wrench w sent to it. Replayed as a function of time, f is
    a hand without stiffness and damping: a millinewton too much makes it drift away without end.
    The hand is therefore modelled as ``device.Hand``, a measured arm or the scene's own, which
    pulls with spring and damper towards p:

        b_h p' + k_h p = (m + m_h) a + (b + b_h) v + k_h x − w + f_c sign(v)

    This p reproduces the recorded motion; the response to other forces is an assumption of the
    model. p is smoothed, because a person's intent is slow and the second derivative of rounded
    positions is noise.

    Rotation follows the same law with rotation vectors from the start's orientation. It is exact
    about one axis, and a good approximation for angles well below π. ``start`` is the device pose
    (7,) before the first tick.
    """
    origin = Rotation.from_quat(np.array(start[3:]), scalar_first=True)
    turned = Rotation.from_quat(ticks["device_quaternion"], scalar_first=True) * origin.inv()
    wrench = _mean_wrench(ticks["wrench_on_device"], delay_ticks(info, period) or 0)
    wanted = [
        _solve_intent(moved, force, period, (m + m_h, b + b_h, b_h, k_h, friction))
        for moved, force, m, m_h, b, b_h, k_h, friction in (
            (
                ticks["device_position"] - np.array(start[:3]),
                wrench[:, :3],
                info.mass or 0.0,
                hand.mass,
                info.damping or 0.0,
                hand.damping,
                hand.stiffness,
                info.friction or 0.0,
            ),
            (
                turned.as_rotvec(),
                wrench[:, 3:] * float(info.turns),
                info.rotational_inertia or 1e-4,
                hand.rotational_inertia,
                info.rotational_damping or 0.0,
                hand.rotational_damping,
                hand.rotational_stiffness,
                0.0,
            ),
        )
    ]
    table = np.column_stack(
        [
            period * np.arange(len(ticks)),
            wanted[0],
            Rotation.from_rotvec(wanted[1]).as_quat(canonical=True, scalar_first=True),
        ]
    )
    return np.ascontiguousarray(table)


def _mean_wrench(wrench: Array, delay: int) -> Array:
    """Averages the wrenches that acted before and after each sample."""
    acting = np.concatenate([np.zeros((delay + 1, 6)), wrench])
    return np.asarray(0.5 * (acting[: len(wrench)] + acting[1 : len(wrench) + 1]))


def _solve_intent(
    moved: Array,
    force: Array,
    period: float,
    law: tuple[float, float, float, float, float],
) -> Array:
    """Solves b_h p' + k_h p = M a + β v + k_h x − w + f_c sign(v) for p, by the bilinear rule.

    The rule is stable, and it suppresses the noise of central differences at half the rate.
    """
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415 - with scipy.signal 0.6 s
    from scipy.signal import lfilter  # noqa: PLC0415

    inertia, damping, hand_damping, stiffness, friction = law
    padded = np.concatenate([moved[:1], moved, moved[-1:]])
    velocity = (padded[2:] - padded[:-2]) / (2 * period)
    acceleration = (padded[2:] - 2 * moved + padded[:-2]) / period**2
    pull = inertia * acceleration + damping * velocity + stiffness * moved - force
    pull += friction * np.sign(velocity)
    if hand_damping == 0.0:  # a hand with mass alone has no intent
        wanted = pull / stiffness if stiffness else moved
    else:
        pole = 2 * hand_damping / period + stiffness
        # the filter starts from a constant intended position
        first = pull[:1] / stiffness if stiffness else moved[:1]
        rest = first - pull[:1] / pole
        wanted, _ = lfilter([1.0, 1.0], [pole, 2 * stiffness - pole], pull, axis=0, zi=rest)
    return np.asarray(gaussian_filter1d(wanted, INTENT / period, axis=0, mode="nearest"))
