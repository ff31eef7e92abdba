"""Energy balance of the device port, from recorded poses and wrenches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.limited import limits_on_tool, spring_energy
from hapticbridge.kernel.parameters import RunParameters

Array = NDArray[np.float64]


def burnt_by_damping(
    parameters: RunParameters,
    moved: Array,
    turned: Array,
    interval: Array,
    is_running: NDArray[np.bool_],
) -> Array:
    """Returns b‖δp‖²/t of each tick, the least dissipation of the device's damping, (n,) in J.

    t is the time between two samples, at least T. A damper that moves by δp within t dissipates no
    less than at constant speed; a missed deadline makes t longer. Dry friction is not counted,
    because encoder steps do not show how far the device slid.

    Args:
        parameters: Run parameters with known damping.
        moved: δp of each tick, (n, 3) in m.
        turned: Rotation vectors of each tick, (n, 3) in rad.
        interval: t as recorded, (n,) in s.
        is_running: True for ticks of known duration. A jump before the first tick or in a pause
            took an unknown time and dissipates nothing here.
    """
    burnt = (parameters.device_damping or 0.0) * np.sum(moved**2, axis=1)
    burnt += (parameters.device_rotational_damping or 0.0) * np.sum(turned**2, axis=1)
    time = np.maximum(interval, parameters.period)
    return np.asarray(np.where(is_running, burnt / time, 0.0))


def passed_shares(ticks: NDArray[np.void], parameters: RunParameters) -> tuple[Array, Array]:
    """Returns the shares of force and torque that the guard transmitted, (n,) each."""
    scales = (parameters.force_scale, parameters.force_scale / parameters.scale)
    shares = []
    for part, scale in zip((slice(0, 3), slice(3, 6)), scales, strict=True):
        full = scale * np.linalg.norm(ticks["wrench_on_tool"][:, part], axis=1)
        sent = np.linalg.norm(ticks["wrench_on_device"][:, part], axis=1)
        passed = np.divide(sent, full, out=np.ones_like(full), where=full > 0)
        shares.append(np.minimum(passed, 1.0))  # injected damping may add to the wrench
    return shares[0], shares[1]


def kept_behind_a_law(
    parameters: RunParameters,
    *,
    gains: tuple[Array, Array],
    pulled: tuple[Array, Array],
    stretch: tuple[Array, Array],
    stretched: tuple[Array, Array],
    work: tuple[Array, Array],
    passed: tuple[Array, Array],
    since_start: Array,
    share: Array,
    share_before: float = 0.0,
    has_end: bool = True,
) -> tuple[Array, Array]:
    """Returns the energy stored in coupling and tool from the handle, in J of the scene.

        Σ c_k w_k + r_k V(e_k) − Σ max(0, r_k − r_{k−1}) (V(e_k) + ½‖δe_k‖²_{B/T}) − Σ W_k

    V is the energy of a spring whose force stops growing at the limit, ½ K e² below it. Let E be
    the energy given to the device minus its dissipation plus this result. With b >= K T/2 + B and
    no active limit, E is never above zero, for any hand and tool. This is the identity behind (6),
    with V(e) at the end on the left. What exceeds zero comes from the wrench held between samples
    and is the fault of the port ``device``.

    The second sum is the energy already stretched into the spring when the force is switched on, in
    a ramp or after a jump of the device before its first tick. W_k = r_{k−1} (V_k(p_k) −
    V_{k−1}(p_k)), p = h_k − x_{k−1}, is the work of a command that changes K (``kernel.tuning``);
    neither scene nor coupling released it.

    Args:
        parameters: Run parameters of a method with a coupling law and one law per tick.
        gains: K, B', K_r and B'_r in the tick before each and in each, (n, 4) each.
        pulled: p in m and as rotation vectors, (n, 3) each.
        stretch: e in m and as rotation vectors, (n, 3) each.
        stretched: Change of e in each tick.
        work: Work w of force and of torque on the tool in each tick, (n,) each in J.
        passed: c, the share of force and of torque that the guard transmitted, (n,) each.
        since_start: Ticks since the force began to rise, (n,).
        share: r, the share of the wrench transmitted by ramp and fading, (n,).
        share_before: r of the tick before the first of these.
        has_end: True counts r_k V(e_k), which a device at e_k could still receive. With an old
            sample the device is elsewhere, and only the energy given so far counts.

    Returns:
        The summand of each tick, and r V(e); (n,) each.

    References:
        Brown & Colgate 1997, eq. (6); here summed over time instead of frequency by frequency.
    """
    before = np.concatenate([[share_before], share[:-1]])
    rise = np.where(since_start == 0, share, np.diff(share, prepend=share_before))
    summed, held = np.zeros(len(share)), np.zeros(len(share))
    for column, limit, e, de, w, c in zip(
        (0, 2), limits_on_tool(parameters), stretch, stretched, work, passed, strict=True
    ):
        k, b = gains[1][:, column], gains[1][:, column + 1]
        spring = spring_energy(k, np.linalg.norm(e, axis=1), limit)
        found = spring + 0.5 * b / parameters.period * np.sum(de**2, axis=1)
        taken = np.where(since_start > 0, c * w, 0.0)
        summed += taken - rise * found
        if has_end:
            held += share * spring
    return summed - work_of_commands(parameters, gains, pulled, before), held


def work_of_commands(
    parameters: RunParameters,
    gains: tuple[Array, Array],
    pulled: tuple[Array, Array],
    share_before: Array,
) -> Array:
    """Returns W_k of ``kept_behind_a_law``, the work of commands on the springs, (n,) in J.

    Arguments are those of ``kept_behind_a_law``; ``share_before`` has one value per tick.
    """
    work = np.zeros(len(share_before))
    for column, limit, p in zip((0, 2), limits_on_tool(parameters), pulled, strict=True):
        k_before, k = gains[0][:, column], gains[1][:, column]
        if np.any(k != k_before):
            length = np.linalg.norm(p, axis=1)
            work += spring_energy(k, length, limit) - spring_energy(k_before, length, limit)
    return share_before * work
