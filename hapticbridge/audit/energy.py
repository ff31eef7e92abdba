"""Second computation of a recording's energies, in plain NumPy over recorded poses and wrenches.

It is written apart from the kernel on purpose, with other formulas where possible (quaternion
products over whole arrays), so that one mistake does not hide another.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.motion import Array, turn_between
from hapticbridge.audit.state import AuditState
from hapticbridge.audit.structure import TOLERANCE, Deviation
from hapticbridge.audit.wrench_limits import AuditedBlock, limits_on_tool, spring_energy
from hapticbridge.kernel.parameters import RunParameters

SLACK_SHARE = 0.5
"""Share of the slack that counts with several laws per tick, without unit; equal to the assumption
of ``certificate.required_damping``."""


def dissipated_by_damping(
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
    energy = (parameters.device_damping or 0.0) * np.sum(moved**2, axis=1)
    energy += (parameters.device_rotational_damping or 0.0) * np.sum(turned**2, axis=1)
    time = np.maximum(interval, parameters.period)
    return np.asarray(np.where(is_running, energy / time, 0.0))


def transmitted_shares(ticks: NDArray[np.void], parameters: RunParameters) -> tuple[Array, Array]:
    """Returns the shares of force and torque that passed limits, ramp and fade, (n,) each."""
    scales = (parameters.force_scale, parameters.force_scale / parameters.scale)
    shares = []
    for part, scale in zip((slice(0, 3), slice(3, 6)), scales, strict=True):
        full = scale * np.linalg.norm(ticks["wrench_on_tool"][:, part], axis=1)
        sent = np.linalg.norm(ticks["wrench_on_device"][:, part], axis=1)
        share = np.divide(sent, full, out=np.ones_like(full), where=full > 0)
        shares.append(np.minimum(share, 1.0))  # injected damping may add to the wrench
    return shares[0], shares[1]


class SpringPath(NamedTuple):
    """Motion of the coupling for one kind of axis, in m or as rotation vectors in rad.

    Attributes:
        pulled: p = h_k − x_{k−1}, (n, 3).
        stretch: e = h − x, (n, 3).
        stretched: δe, the change of e in each tick, (n, 3).
        work: Work w of the coupling on the tool in each tick, (n,) in J.
        transmitted: c, the share of force or torque that reached the device, (n,).
    """

    pulled: Array
    stretch: Array
    stretched: Array
    work: Array
    transmitted: Array


def stored_in_coupling(
    parameters: RunParameters,
    gains: Array,
    paths: tuple[SpringPath, SpringPath],
    is_start: NDArray[np.bool_],
    share: Array,
    share_before: Array,
) -> tuple[Array, Array]:
    """Returns the energy stored in coupling and tool from the handle, in J of the scene.

        Σ c_k w_k + r_k V(e_k) − Σ (r_k − r_{k−1}) (V(e_k) + ½ (B/T) ‖δe_k‖²) − Σ W_k

    V is the energy of a spring whose force stops growing at the limit, ½ K e² below it. Let E be
    the energy given to the device minus its dissipation plus this result. With b >= K T/2 + B and
    no active limit, E is never above zero, for any hand and tool. This is the identity behind (6),
    with V(e) at the end on the left. An excess above zero comes from the wrench held between
    samples and is the fault of the port ``device``.

    The second sum is the energy already stretched into the spring when the force is switched on, in
    a ramp or after a jump of the device before its first tick; r_{k−1} is 0 at a start. W_k is
    ``work_of_commands``, which the caller subtracts.

    Args:
        parameters: Run parameters of a method with a coupling law and one law per tick.
        gains: K, B', K_r and B'_r in each tick, (n, 4).
        paths: Translation and rotation of the coupling.
        is_start: True where the force begins to rise, (n,).
        share: r, the share of the wrench that ramp and fade transmitted, (n,).
        share_before: r of the previous tick, (n,).

    Returns:
        The summand of each tick without W_k, and r V(e); (n,) each.

    References:
        Brown & Colgate 1997, eq. (6); here summed over time instead of frequency by frequency.
    """
    rise = np.where(is_start, share, share - share_before)
    parts, stored = np.zeros(len(share)), np.zeros(len(share))
    for column, limit, path in zip((0, 2), limits_on_tool(parameters), paths, strict=True):
        k, b = gains[:, column], gains[:, column + 1]
        spring = spring_energy(k, np.linalg.norm(path.stretch, axis=1), limit)
        present = spring + 0.5 * b / parameters.period * np.sum(path.stretched**2, axis=1)
        parts += np.where(is_start, 0.0, path.transmitted * path.work) - rise * present
        stored += share * spring
    return parts, stored


def work_of_commands(
    parameters: RunParameters,
    gains_before: Array,
    gains: Array,
    paths: tuple[SpringPath, SpringPath],
    share_before: Array,
) -> Array:
    """Returns W_k = r_{k−1} (V_k(p_k) − V_{k−1}(p_k)), the work of commands that change K, in J.

    Neither scene nor coupling released this energy. ``gains_before`` holds the gains of each
    previous tick, (n, 4); the other arguments are those of ``stored_in_coupling``.
    """
    work = np.zeros(len(share_before))
    for column, limit, path in zip((0, 2), limits_on_tool(parameters), paths, strict=True):
        k_before, k = gains_before[:, column], gains[:, column]
        if np.any(k != k_before):
            length = np.linalg.norm(path.pulled, axis=1)
            work += spring_energy(k, length, limit) - spring_energy(k_before, length, limit)
    return share_before * work


@dataclass(frozen=True, slots=True)
class EnergyBalance:
    """Energies of some ticks, computed from recorded poses and wrenches.

    Cumulative values count from the first tick of the recording.

    Attributes:
        coupling_work: Cumulative Σ f·δx + τ·δφ of the recorded wrench, (n,) in J; as recorded if
            several laws per tick are summed.
        throughput: Cumulative Σ |f·δx + τ·δφ|, (n,) in J.
        device_energy: Cumulative energy given to the device by the recorded wrenches, (n,) in J.
        device_throughput: Cumulative sum of that energy's absolute values, (n,) in J.
        environment_energy: S_k − S_start − works, with the ``coupling_work`` above, (n,) in J.
        slack: Σ ½ (K + B/T) ‖δx‖² + ½ (K_r + B_r/T) ‖δφ‖², (n,) in J.
        excess_device_energy: Energy given to the device beyond its dissipation and the energy
            released by scene and coupling, (n,) in J. Zero for an unknown damping or several laws
            per tick. With a coupling law, energy created by the environment is not included; it
            belongs to the other port.
        commanded: Energy that commands added to the effective coupling, (n,) in J.
        sums: Cumulative energies after the last of these ticks, for ``AuditState``.
    """

    coupling_work: Array
    throughput: Array
    device_energy: Array
    device_throughput: Array
    environment_energy: Array
    slack: Array
    excess_device_energy: Array
    commanded: Array
    sums: dict[str, float]

    @classmethod
    def of(cls, block: AuditedBlock, events: RunEvents, delay: int) -> EnergyBalance:
        """Computes the balance of a block; see ``energy_balances``."""
        ticks, motion, parameters = block.ticks, block.motion, events.parameters
        before, gains = block.state.sums, events.gains(ticks["tick"])
        wrench = ticks["wrench_on_tool"]
        works = (
            np.sum(wrench[:, :3] * motion.tool_step, axis=1),
            np.sum(wrench[:, 3:] * motion.tool_turn, axis=1),
        )
        work = works[0] + works[1]
        totals = {"throughput": _summed(np.abs(work), before["throughput"])}
        # with several laws per tick the mean wrench does not determine the summed work
        coupling_work = ticks["coupling_work"]
        if parameters.law_evaluations == 1:
            coupling_work = _summed(work, before["coupling_work"])
        stored = ticks["kinetic"] + ticks["potential"] - block.state.start_energy
        created = stored - coupling_work - ticks["actuator_work"] - ticks["external_work"]
        linear, angular = _slack_gains(parameters, gains)
        slack = 0.5 * linear * np.sum(motion.tool_step**2, axis=1)
        slack += 0.5 * angular * np.sum(motion.tool_turn**2, axis=1)
        totals |= {"coupling_work": coupling_work, "slack": _summed(slack, before["slack"])}
        totals |= _device_energies(block, events, delay)
        commanded, parts, held = _coupling_energies(block, events, works)
        kept = _summed(parts, before["stored_in_coupling"])
        totals["stored_in_coupling"] = kept
        released, lost = coupling_work, created  # without a law, all that the scene stores counts
        if parameters.has_law:
            # with a delay the device is elsewhere, and only the energy given so far counts
            released = kept if delay else kept + held
            # The slack covers energy created by the environment, but a ramp or a limit passes only
            # a share of the slack. Counted here, it would blame a device that bears its coupling.
            lost = np.minimum(created, 0.0)
        totals["commanded"] = _summed(commanded, before["commanded"])
        excess = np.zeros(len(ticks))
        if parameters.device_damping is not None and (
            not parameters.has_law or parameters.law_evaluations == 1
        ):
            excess = totals["delayed_device_energy"] - totals["device_dissipation"]
            excess = excess + parameters.force_scale / parameters.scale * (lost + released)
        return cls(
            coupling_work=coupling_work,
            throughput=totals["throughput"],
            device_energy=totals["device_energy"],
            device_throughput=totals["device_throughput"],
            environment_energy=created,
            slack=totals["slack"],
            excess_device_energy=excess,
            commanded=totals["commanded"],
            sums={name: float(total[-1]) for name, total in totals.items()},
        )


def _summed(values: Array, before: float) -> Array:
    """Returns cumulative sums that start from an earlier sum.

    Values are added one by one, so that sums over blocks equal those over the whole to the bit.
    """
    return np.cumsum(np.concatenate([[before], values]))[1:]


def _coupling_energies(
    block: AuditedBlock, events: RunEvents, works: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Returns the work of commands, the energy that coupling and tool keep, and r V(e), (n,) each.

    All are 0 without a coupling law. ``works`` are the coupling's in translation and rotation.
    """
    ticks, motion, parameters = block.ticks, block.motion, events.parameters
    if not parameters.has_law:
        none = np.zeros(len(ticks))
        return none, none, none
    shares, stretched = transmitted_shares(ticks, parameters), motion.stretched
    paths = (
        SpringPath(motion.pulled, motion.stretch, stretched[0], works[0], shares[0]),
        SpringPath(motion.turned, motion.twist, stretched[1], works[1], shares[1]),
    )
    before, gains = events.gains(ticks["tick"] - 1), events.gains(ticks["tick"])
    commanded = work_of_commands(parameters, before, gains, paths, block.share_before)
    parts, held = stored_in_coupling(
        parameters, gains, paths, block.is_start, block.share, block.share_before
    )
    return commanded, parts - commanded, held


def _device_energies(block: AuditedBlock, events: RunEvents, delay: int) -> dict[str, Array]:
    """Returns cumulative energies at the device port, by name, (n,) each in J."""
    ticks, parameters, before = block.ticks, events.parameters, block.state.sums
    rows = np.concatenate([block.state.row, ticks, block.following])
    sent = rows["wrench_on_device"][: len(ticks)].copy()
    sent[np.isin(ticks["tick"], events.resumed)] = 0.0
    moved, turned = _device_motion(rows, 0, len(ticks))
    late_moved, late_turned = _device_motion(rows, delay, len(ticks))
    work = np.sum(sent[:, :3] * moved, axis=1) + np.sum(sent[:, 3:] * turned, axis=1)
    late = np.sum(sent[:, :3] * late_moved, axis=1) + np.sum(sent[:, 3:] * late_turned, axis=1)
    dissipation = np.zeros(len(ticks))
    if parameters.device_damping is not None:
        parts = dissipated_by_damping(
            parameters, late_moved, late_turned, block.interval, ~block.is_first
        )
        dissipation = _summed(parts, before["device_dissipation"])
    return {
        "device_energy": _summed(work, before["device_energy"]),
        "device_throughput": _summed(np.abs(work), before["device_throughput"]),
        "delayed_device_energy": _summed(late, before["delayed_device_energy"]),
        "device_dissipation": dissipation,
    }


def _device_motion(rows: NDArray[np.void], first: int, count: int) -> tuple[Array, Array]:
    """Returns motions and rotation vectors of the device after each row from ``first`` on, (n, 3).

    The motion after the last record is unknown and counts as none.
    """
    chosen = rows[first : first + count + 1]
    moved, turned = np.zeros((count, 3)), np.zeros((count, 3))
    known = max(len(chosen) - 1, 0)
    orientation = chosen["device_quaternion"]
    moved[:known] = np.diff(chosen["device_position"], axis=0)[:known]
    turned[:known] = turn_between(orientation[:known], orientation[1:])
    return moved, turned


def _slack_gains(parameters: RunParameters, gains: Array) -> tuple[Array, Array]:
    """Returns K + B/T and K_r + B_r/T of the coupling, (n,) each.

    With n laws per tick only half of K/n + B/T counts; without a coupling law both are 0.
    """
    if not parameters.has_law:
        return np.zeros(len(gains)), np.zeros(len(gains))
    n, share = parameters.law_evaluations, 1.0 if parameters.law_evaluations == 1 else SLACK_SHARE
    linear = gains[:, 0] / n + gains[:, 1] / parameters.period
    angular = gains[:, 2] / n + gains[:, 3] / parameters.period
    return share * linear, share * angular


def energy_balances(
    blocks: Iterable[NDArray[np.void]], state: AuditState, events: RunEvents, delay: int = 0
) -> Iterator[tuple[AuditedBlock, EnergyBalance]]:
    """Yields the energy balance of a run, block by block.

    Args:
        blocks: Records without gaps; no block is empty.
        state: State before the first of them.
        events: External actions during the run.
        delay: Delay in ticks: the wrench of row k acted on the motion between rows k + delay and
            k + delay + 1.
    """
    waiting: deque[NDArray[np.void]] = deque()
    for newest in chain(blocks, [None]):
        if newest is not None:
            waiting.append(newest)
        while waiting and (newest is None or sum(map(len, waiting)) - len(waiting[0]) >= delay):
            ticks = waiting.popleft()
            following = np.concatenate([ticks[:0], *waiting])[:delay]
            block = AuditedBlock.of(ticks, following, state, events)
            balance = EnergyBalance.of(block, events, delay)
            yield block, balance
            state = block.state_after(balance.sums)


def energy_deviations(block: AuditedBlock, balance: EnergyBalance) -> Iterator[Deviation]:
    """Yields the deviations of the recorded energies."""
    ticks = block.ticks
    for name, throughput in (
        ("coupling_work", balance.throughput),
        ("device_energy", balance.device_throughput),
        ("environment_energy", balance.throughput),
    ):
        amount = np.abs(ticks[name] - getattr(balance, name))
        allowed = TOLERANCE * (1 + throughput + np.abs(ticks["potential"]))
        yield Deviation(name, amount, allowed, "J", "recorded poses and wrenches")
