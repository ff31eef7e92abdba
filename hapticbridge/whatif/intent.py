"""Where a recorded hand wanted to be.

A recorded hand cannot be known, only what it did. Two things can be made of the force that it must
have applied, f = m a + b v − w (m and b the device's, w the wrench that it was sent). Applied again
as it was, as a function of time, it is the force of a hand without stiffness and damping: a
millinewton too much at the start, and it drifts away without end. So it is taken for that of a
hand as in ``device.Hand``, a measured arm or the one that the scene asks for, which pulls with
spring and damper towards where its owner wants to be. Where that is, p, follows from the motion,

    b_h p' + k_h p = (m + m_h) a + (b + b_h) v + k_h x − w + f_c sign(v),

so that the hand would have moved as recorded. What is assumed is how it gives way to other forces
than the recorded ones. p is smoothed: a person's intent is slow, and the second derivative of
rounded positions is noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.device import DeviceInfo, Hand
from hapticbridge.device.lateness import delay_ticks

Array = NDArray[np.float64]

INTENT = 8e-3
"""Standard deviation in s of the Gaussian that smooths what the hand wants: it halves what moves at
23 Hz, beyond what an arm does on purpose. Longer loses fast strokes, shorter keeps noise."""


def intended(
    info: DeviceInfo,
    hand: Hand,
    ticks: NDArray[np.void],
    period: float,
    start: tuple[float, ...],
    *,
    is_moving: bool = False,
) -> Array:
    """Returns where the hand wanted to be, as a ``Motion.table`` counted from the start.

    Rotation follows the same law with rotation vectors from the start's orientation in the place of
    positions: exact about one axis, and good as long as angles stay well below π.

    Args:
        info: The device.
        hand: Who is taken to have held it.
        ticks: The recorded rows.
        period: Of the recorded loop, in s.
        start: Device pose (7,) before the first tick.
        is_moving: Whether it moves at the start already, as in a recording begun in mid-run.
    """
    origin = Rotation.from_quat(np.array(start[3:]), scalar_first=True)
    turned = Rotation.from_quat(ticks["device_quaternion"], scalar_first=True) * origin.inv()
    wrench = _held(ticks["wrench_on_device"], delay_ticks(info, period) or 0)
    wanted = [
        _wanted(
            moved,
            force,
            period,
            (m + m_h, b + b_h, b_h, k_h, friction),
            is_moving=is_moving,
        )
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


def _held(wrench: Array, delay: int) -> Array:
    """Returns the mean of the wrenches that acted before and after each sample."""
    acting = np.concatenate([np.zeros((delay + 1, 6)), wrench])
    return np.asarray(0.5 * (acting[: len(wrench)] + acting[1 : len(wrench) + 1]))


def _wanted(
    moved: Array,
    force: Array,
    period: float,
    law: tuple[float, float, float, float, float],
    *,
    is_moving: bool,
) -> Array:
    """Solves b_h p' + k_h p = M a + β v + k_h x − w + f_c sign(v) for p, by the bilinear rule.

    It is stable, and at half the rate, where central differences are noise, it answers nothing.
    """
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415 - with scipy.signal 0.6 s
    from scipy.signal import lfilter  # noqa: PLC0415

    inertia, damping, hand_damping, stiffness, friction = law
    # one that moves already moved on as it does: had it stood still, the start were a blow
    before = 2 * moved[:1] - moved[1:2] if is_moving else moved[:1]
    padded = np.concatenate([before, moved, moved[-1:]])
    velocity = (padded[2:] - padded[:-2]) / (2 * period)
    acceleration = (padded[2:] - 2 * moved + padded[:-2]) / period**2
    pull = inertia * acceleration + damping * velocity + stiffness * moved - force
    pull += friction * np.sign(velocity)
    if hand_damping == 0.0:  # one that only weighs something wants nothing
        wanted = pull / stiffness if stiffness else moved
    else:
        pole = 2 * hand_damping / period + stiffness
        # the filter starts as if what is wanted had always moved as the device does at the start
        resting = pull[:1] - hand_damping * velocity[:1] if is_moving else pull[:1]
        first = resting / stiffness if stiffness else moved[:1]
        rest = first - pull[:1] / pole
        wanted, _ = lfilter([1.0, 1.0], [pole, 2 * stiffness - pole], pull, axis=0, zi=rest)
    return np.asarray(gaussian_filter1d(wanted, INTENT / period, axis=0, mode="nearest"))
