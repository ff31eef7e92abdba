"""Second computation of a recording's energies, in plain NumPy over recorded poses and wrenches.

It is written apart from the kernel on purpose, with other formulas where possible (quaternion
products over whole arrays), so that one mistake does not hide another.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import AuditState, RunEvents
from hapticbridge.audit.motion import Array, Motion, turn_between
from hapticbridge.audit.pulse import PulseBalance
from hapticbridge.audit.spring import Spring, springs
from hapticbridge.audit.structure import TOLERANCE, Deviation
from hapticbridge.audit.wrench_limits import (
    AuditedBlock,
    axes_with_motor,
    whole_wrench,
)
from hapticbridge.kernel.parameters import RunParameters

SLACK_SHARE = 0.5
"""Share of the slack that counts with several laws per tick, without unit; equal to the assumption
of ``loop_setting.required_damping``."""


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


def stored_in_springs(
    parameters: RunParameters, gains: Array, stretched: tuple[Array, Array]
) -> Array:
    """Returns V(e) + V(φ), the energy that the coupling's springs hold, (n,) in J of the scene.

    With the work w_k on the tool and the energy E_d given to the device beyond its dissipation,

        E_d + (s/scale) [Σ w_k + V(e_k) − V(e_start)] <= 0

    for every hand and tool if b >= K T/2 + B': the identity behind (6), with V(e) at the end on the
    left. At the start the springs may hold the tool's weight. V is the energy of a spring whose
    force stops growing at the force level. It holds at any lever r, because the handle moves by r
    times the device's motion where the device gets r times the force. An excess above zero is the
    fault of the port ``device``.

    Args:
        parameters: Run parameters.
        gains: K, B', K_r and B'_r, (n, 4).
        stretched: e in m and φ in rad, (n, 3) each.

    References:
        Brown & Colgate 1997, eq. (6); here summed over time instead of frequency by frequency.
    """
    linear, angular = springs(gains, parameters)
    return linear.energy(stretched[0]) + angular.energy(stretched[1])


def _springs_at_start(parameters: RunParameters, gains: Array, motion: Motion) -> Array:
    """Returns the springs' energy before each tick's motion, (n,) in J; for the first tick.

    Before it the tool turns little, so that φ and the turns of handle and tool add.
    """
    stretch = motion.stretch + motion.tool_step - motion.handle_step
    twist = motion.twist + motion.tool_turn - motion.handle_turn
    return stored_in_springs(parameters, gains, (stretch, twist))


def shown_work(block: AuditedBlock, events: RunEvents) -> Array:
    """Returns P, the coupling's work on a tool that is shown between a scene's steps, (n,) in J.

        P = V(h − y_{k−1}) − V(h − y_k) + f_d·δy + the same for torques

    V is the energy of the spring up to the force level, f_d the wrench beyond the spring's own.
    Behind a delay, and before another program, a spring gives ‖Δf‖²/2K less, with Δf the change of
    its own force by δy, and no more than f·δy.
    """
    ticks, motion, parameters = block.ticks, block.motion, events.parameters
    gains, wrench = events.gains(ticks["tick"]), ticks["wrench_on_tool"]
    twist_before = turn_between(motion.tool_before[:, 3:], ticks["handle_quaternion"])
    work, is_late = np.zeros(len(ticks)), block.is_posted or parameters.device_delay > 0.0
    linear, angular = springs(gains, parameters)
    for spring, part, before, after, step in (
        (linear, slice(0, 3), motion.stretch + motion.tool_step, motion.stretch, motion.tool_step),
        (angular, slice(3, 6), twist_before, motion.twist, motion.tool_turn),
    ):
        given = spring.energy(before) - spring.energy(after)
        given += np.sum((wrench[:, part] - spring.force(after)) * step, axis=1)
        if is_late:
            change = np.sum((spring.force(after) - spring.force(before)) ** 2, axis=1)
            given -= 0.5 * np.divide(
                change, spring.stiffness, out=np.zeros_like(change), where=spring.stiffness > 0
            )
            given = np.minimum(given, np.sum(wrench[:, part] * step, axis=1))
        work += given
    return work


def _discarded(block: AuditedBlock, work: Array) -> Array:
    """Returns the energy in J that the cap of the tank discarded in each tick, (n,).

    D_{k−1} + P_k − D_k. In a tick with a new result the cap does not act.
    """
    before = block.state.row
    last = np.concatenate([before["scene_tank"], block.ticks["scene_tank"][:-1]])
    is_new = np.diff(block.ticks["scene_step"], prepend=before["scene_step"]) != 0
    return np.where(is_new, 0.0, last + work - block.ticks["scene_tank"])


def _shown_deviations(block: AuditedBlock, balance: EnergyBalance) -> Iterator[Deviation]:
    """Yields where a shown tool moved without being paid for, or the scene stepped too often."""
    ticks, before = block.ticks, block.state
    tank = ticks["scene_tank"]
    work = np.diff(balance.coupling_work, prepend=before.sums["coupling_work"])
    allowed = TOLERANCE * (1 + balance.throughput + np.abs(tank))
    unpaid = np.minimum(tank - work, 0.0) - tank
    yield Deviation("scene_tank", unpaid, allowed, "J", "the shown tool's motion")
    last = np.concatenate([before.row["scene_tank"], tank[:-1]])
    steps = ticks["scene_step"]
    is_new = np.diff(steps, prepend=before.row["scene_step"])
    raised = np.where(is_new == 0, tank - last - work, 0.0)
    yield Deviation("scene_tank", raised, allowed, "J", "the shown tool's motion")
    due = ticks["tick"] / block.scene_ticks
    if block.is_posted:  # another program shows its tool at any rate
        due = ticks["tick"] + 1
        off = np.abs(ticks["potential"] - tank)
        yield Deviation("potential", off, 0.0, "J", "what another program may still give")
    too_many = np.maximum(np.abs(is_new - 0.5) - 0.5, steps - due)
    yield Deviation("scene_step", too_many, 0.0, "", "the ticks that it takes")


@dataclass(frozen=True, slots=True)
class EnergyBalance:
    """Energies of some ticks, computed from recorded poses and wrenches.

    Cumulative values count from the first tick of the recording.

    Attributes:
        coupling_work: Cumulative Σ f·δx + τ·δφ of the recorded wrench, (n,) in J; as recorded if
            several laws per tick are summed. For a shown tool Σ P (``shown_work``).
        throughput: Cumulative Σ |f·δx + τ·δφ|, (n,) in J.
        device_energy: Cumulative energy given to the device by the recorded wrenches, (n,) in J.
        device_throughput: Cumulative sum of that energy's absolute values, (n,) in J.
        environment_energy: S_k − S_start − works, with the ``coupling_work`` above, (n,) in J.
        slack: Σ ½ (K + B'/T) ‖δx‖² + ½ (K_r + B'_r/T) ‖δφ‖² below the force level, (n,) in J.
        excess_device_energy: Energy given to the device beyond its dissipation, what steps of the
            encoder may have added, the energy released by scene and coupling since the start, the
            unfelt work (``unfelt_work``) and that of pulses, (n,) in J. Zero for an unknown damping
            or several laws per tick. With a coupling law, energy created by the environment is not
            included; it belongs to the other port.
        net_energy: Energy given to the hand beyond what the device's damping burned, less what the
            scene's storage had given before the tick (``released``) and what steps of the encoder
            may have added, (n,) in J; zero without a hand. It is what the guard's energy limit
            bounds, with the damping that the guard takes.
        hidden_energy: The most in J that steps of the encoder may have hidden or added until the
            last tick (``passivity_controller.observe_energy``).
        gross_energy: Energy given to the hand beyond what the device's damping burned and beyond
            the unfelt work, (n,) in J; zero without a hand.
        unpaid_energy: Energy given to the hand beyond what may have paid for it before the tick,
            (n,) in J (``hand_energy.HandEnergy``); zero without a hand.
        coupling_account: q (W_c + V − V_0) of ``kernel.timing`` after each tick, (n,) in J.
        springs: Energy in J that the coupling's springs held at the start and after each reset.
        input_work: Cumulative work of the scene's inputs without that of resets, (n,) in J.
        released: Energy in J that the scene's storage has given to the hand after the last tick.
        contact_tank: Energy that may pay for the depenetration of rigid contacts, (n,) in J; zero
            with the contacts of the scene.
        pulses: Energies of the pulses of blows.
        sums: Cumulative energies after the last of these ticks, for ``AuditState``.
    """

    coupling_work: Array
    throughput: Array
    device_energy: Array
    device_throughput: Array
    environment_energy: Array
    slack: Array
    excess_device_energy: Array
    net_energy: Array
    hidden_energy: float
    gross_energy: Array
    unpaid_energy: Array
    coupling_account: Array
    springs: float
    input_work: Array
    released: float
    contact_tank: Array
    pulses: PulseBalance
    sums: dict[str, float]

    @classmethod
    def from_block(
        cls, block: AuditedBlock, events: RunEvents, delay: int, others_work: Array | float = 0.0
    ) -> EnergyBalance:
        """Computes the balance of a block; see ``energy_balances``.

        ``others_work`` is the cumulative work of other hands' couplings on the scene, (n,) in J.
        """
        ticks, motion, parameters = block.ticks, block.motion, events.parameters
        before, gains = block.state.sums, events.gains(ticks["tick"])
        wrench = ticks["wrench_on_tool"]
        work = np.sum(wrench[:, :3] * motion.tool_step, axis=1)
        work += np.sum(wrench[:, 3:] * motion.tool_turn, axis=1)
        totals = {"throughput": _summed(np.abs(work), before["throughput"])}
        # with several laws per tick the mean wrench does not determine the summed work
        coupling_work = ticks["coupling_work"]
        if parameters.scene_ticks:
            work = shown_work(block, events)
        if parameters.law_evaluations == 1:
            coupling_work = _summed(work, before["coupling_work"])
        stored = ticks["kinetic"] + ticks["potential"] - block.state.start_energy
        created = stored - coupling_work - ticks["actuator_work"] - ticks["external_work"]
        created = created - others_work
        discarded: Array = np.zeros(1)
        if parameters.scene_ticks:
            discarded = _summed(_discarded(block, work), before["discarded"])
        if parameters.scene_ticks and not block.is_posted:
            # lent to the scene: what it took and the hand has not given
            created = created - np.maximum(-(ticks["scene_tank"] + discarded), 0.0)
        linear, angular = _slack_gains(parameters, gains)
        spring, torsion = springs(gains, parameters)
        evaluations = parameters.law_evaluations
        slack = _slack(linear, motion.tool_step, wrench[:, :3], spring, evaluations)
        slack += _slack(angular, motion.tool_turn, wrench[:, 3:], torsion, evaluations)
        totals |= {"coupling_work": coupling_work, "slack": _summed(slack, before["slack"])}
        totals["discarded"] = discarded
        totals |= _device_energies(block, events, delay)
        in_springs: Array | float = 0.0  # with a delay the device is elsewhere
        is_reset = events.is_reset(ticks["tick"])
        has_start = (ticks["tick"] == 0) | is_reset
        at_start = _springs_at_start(parameters, gains, motion) * has_start
        totals["start_springs"] = _summed(at_start, before["start_springs"])
        if parameters.has_law and not delay:
            in_springs = stored_in_springs(parameters, gains, (motion.stretch, motion.twist))
            in_springs = in_springs - totals["start_springs"]
        excess = _device_excess(parameters, totals, created, in_springs)
        pulses = PulseBalance.of(block, events, created)
        totals |= pulses.sums
        spent = created + pulses.taken
        totals |= {"created": created, "taken": np.maximum(spent, 0.0) + coupling_work}
        totals |= {"motors": ticks["actuator_work"], "external": ticks["external_work"]}
        totals |= _released(totals, before, stored - others_work, is_reset)
        ratio = parameters.energy_ratio
        net, unpaid = _hand_energies(parameters, totals, before, is_reset)
        held = stored_in_springs(parameters, gains, (motion.stretch, motion.twist))
        held = held - totals["start_springs"]
        # D_k = min(cap, D_{k-1} - E_k) is the lowest cap + Σ E so far, or 0, minus Σ E; what
        # pulses take counts as E
        ceiling = np.minimum(
            np.minimum.accumulate(parameters.tank_cap + spent), before["tank_ceiling"]
        )
        totals["tank_ceiling"] = ceiling
        return cls(
            coupling_work=coupling_work,
            throughput=totals["throughput"],
            device_energy=totals["device_energy"],
            device_throughput=totals["device_throughput"],
            environment_energy=created,
            slack=totals["slack"],
            excess_device_energy=excess,
            net_energy=net * parameters.guarding.has_hand,
            hidden_energy=float(totals["hidden_energy"][-1]) * parameters.guarding.has_hand,
            gross_energy=(totals["hand_energy"] - totals["unfelt_work"])
            * parameters.guarding.has_hand,
            unpaid_energy=(unpaid - pulses.paid(before, parameters)) * parameters.guarding.has_hand,
            coupling_account=ratio * (coupling_work + held),
            springs=float(totals["start_springs"][-1]),
            input_work=totals["inputs"],
            released=float(totals["released"][-1]),
            contact_tank=(ceiling - spent) * (parameters.is_rigid and not parameters.scene_ticks),
            pulses=pulses,
            sums={name: float(total[-1]) for name, total in totals.items()},
        )


def _device_excess(
    parameters: RunParameters, totals: dict[str, Array], created: Array, in_springs: Array | float
) -> Array:
    """Returns ``EnergyBalance.excess_device_energy``, (n,) in J."""
    if parameters.device_damping is None or (parameters.has_law and parameters.law_evaluations > 1):
        return np.zeros(len(created))
    # with a law, energy that the environment created belongs to the other port
    lost = np.minimum(created, 0.0) if parameters.has_law else created
    released = totals["coupling_work"] + in_springs
    excess = totals["delayed_device_energy"] - totals["device_dissipation"]
    excess = excess - totals["unfelt_work"] - totals["hidden_energy"]
    return np.asarray(excess + parameters.energy_ratio * (lost + released))


def _hand_energies(
    parameters: RunParameters,
    totals: dict[str, Array],
    before: dict[str, float],
    is_reset: NDArray[np.bool_],
) -> tuple[Array, Array]:
    """Returns ``EnergyBalance.net_energy`` and ``unpaid_energy`` of a hand, (n,) each in J.

    Both hold at the tick's sample, so the scene counts as it was after the last step. Storage that
    a reset has put back in stays lost. A device with a loop of its own may have what the scene
    released at any time before.
    """
    ratio = parameters.energy_ratio
    stored, taken = (
        np.concatenate([[before[name]], totals[name][:-1]]) for name in ("released", "taken")
    )
    totals["forgotten"] = _summed(np.where(is_reset, stored, 0.0), before["forgotten"])
    net = totals["guarded_energy"] - ratio * (np.where(is_reset, 0.0, stored) + totals["forgotten"])
    released = np.maximum(totals["start_springs"] - taken, 0.0)
    most = np.maximum(np.maximum.accumulate(released), before["most_released"])
    totals["most_released"] = most
    if parameters.is_apart:
        released = most
    return net, totals["hand_energy"] - totals["unfelt_work"] - ratio * released


def _released(
    totals: dict[str, Array], before: dict[str, float], stored: Array, is_reset: NDArray[np.bool_]
) -> dict[str, Array]:
    """Returns R of ``passivity_controller.observe_release`` after each tick, and its parts.

    Args:
        totals: W_c ``coupling_work``, Σ E ``created`` and the works ``motors`` and ``external``
            after each tick, in J.
        before: Their values before the first of these ticks, with m, W_c at the last reset, and the
            inputs' work.
        stored: S − S_0 without the work of other hands, (n,) in J.
        is_reset: True for a tick that begins with a reset, whose works m leaves out.
    """
    names = "coupling_work", "created", "motors", "external"
    work, *others = (np.concatenate([[before[name]], totals[name]]) for name in names)
    created, motors, external = (np.where(is_reset, 0.0, np.diff(each)) for each in others)
    steps = motors + external + np.minimum(created, 0.0)
    pushed, at_reset = np.empty(len(steps)), np.empty(len(steps))
    last, base = before["pushed"], before["work_at_reset"]
    edges = np.unique([0, *np.flatnonzero(is_reset), len(steps)])
    for first, end in pairwise(edges):
        if is_reset[first]:
            last, base = 0.0, work[first]
        sums = np.cumsum(np.concatenate([[last], steps[first:end]]))
        # m = max(m + δ, 0) is the sum above its lowest value, or above 0
        pushed[first:end] = (sums - np.minimum(np.minimum.accumulate(sums), 0.0))[1:]
        last, at_reset[first:end] = pushed[end - 1], base
    returned = at_reset - work[1:] - pushed
    released = np.maximum(np.minimum(returned, -stored), 0.0)
    inputs = _summed(external, before["inputs"])
    return {"released": released, "pushed": pushed, "work_at_reset": at_reset, "inputs": inputs}


def _summed(values: Array, before: float) -> Array:
    """Returns cumulative sums that start from an earlier sum.

    Values are added one by one, so that sums over blocks equal those over the whole to the bit.
    """
    return np.cumsum(np.concatenate([[before], values]))[1:]


def _device_energies(block: AuditedBlock, events: RunEvents, delay: int) -> dict[str, Array]:
    """Returns cumulative energies at the device port, by name, (n,) each in J."""
    ticks, parameters, before = block.ticks, events.parameters, block.state.sums
    rows = np.concatenate([block.state.row, ticks, block.following])
    sent = rows["wrench_on_device"][: len(ticks)].copy()
    sent[np.isin(ticks["tick"], events.resumed)] = 0.0
    spread = np.zeros_like(sent)
    if parameters.is_apart:  # by the trapezoidal rule, but none in a silence or pause
        longest = (parameters.guarding.stale_ticks + 1) * parameters.period
        is_unknown = (block.interval > longest) | block.is_first
        share = np.where(is_unknown, 0.0, 0.5)[:, None]
        spread = share * np.abs(sent - ticks["wrench_on_device"])
        sent = share * (sent + ticks["wrench_on_device"])
    moved, turned = _device_motion(rows, 0, len(ticks))
    late_moved, late_turned = _device_motion(rows, delay, len(ticks))
    work = np.sum(sent[:, :3] * moved, axis=1) + np.sum(sent[:, 3:] * turned, axis=1)
    whole = whole_wrench(rows[: len(ticks)], parameters)
    whole[np.isin(ticks["tick"], events.resumed)] = 0.0
    gains = events.gains(ticks["tick"])
    unfelt = unfelt_work(parameters, gains, whole, rows["lever"][: len(ticks)], (moved, turned))
    pulses = np.where(
        np.isin(ticks["tick"], events.resumed)[:, None], 0.0, rows["pulse"][: len(ticks)]
    )
    late = np.sum((sent[:, :3] - pulses) * late_moved, axis=1)
    late += np.sum(sent[:, 3:] * late_turned, axis=1)
    dissipation, guarding = np.zeros(len(ticks)), parameters.guarding
    if parameters.device_damping is not None:
        parts = dissipated_by_damping(
            parameters, late_moved, late_turned, block.interval, ~block.is_first
        )
        dissipation = _summed(parts, before["device_dissipation"])
    assumed = replace(
        parameters,
        device_damping=guarding.assumed_damping,
        device_rotational_damping=guarding.assumed_rotational_damping,
    )
    burned = dissipated_by_damping(assumed, moved, turned, block.interval, ~block.is_first)
    least = np.maximum(np.abs(moved) - guarding.resolution, 0.0)
    shown = dissipated_by_damping(assumed, least, turned, block.interval, ~block.is_first)
    # Σ w·ε with errors of half a step, by summation by parts
    forces = np.vstack([[before[f"sent_{axis}"] for axis in "xyz"], sent[:, :3]])
    changes = np.abs(np.diff(forces, axis=0)) + np.diff(np.abs(forces), axis=0)
    hidden = 0.5 * guarding.resolution * np.sum(changes, axis=1)
    unknown = np.sum(spread * np.abs(np.concatenate([moved, turned], axis=1)), axis=1)
    return {
        "hand_energy": _summed(work - burned - unknown, before["hand_energy"]),
        "guarded_energy": _summed(work - shown - hidden - unknown, before["guarded_energy"]),
        "hidden_energy": _summed(hidden, before["hidden_energy"]),
        **{f"sent_{axis}": sent[:, i] for i, axis in enumerate("xyz")},
        "device_energy": _summed(work, before["device_energy"]),
        "device_throughput": _summed(np.abs(work), before["device_throughput"]),
        "delayed_device_energy": _summed(late, before["delayed_device_energy"]),
        "device_dissipation": dissipation,
        "unfelt_work": _summed(unfelt, before["unfelt_work"]),
    }


def unfelt_work(
    parameters: RunParameters,
    gains: Array,
    whole: Array,
    lever: Array,
    motion: tuple[Array, Array],
) -> Array:
    """Returns the work that the hand saves along axes that are sensed without a motor.

        W_u = −w_u·δp + q r² (K/2 + B'/T) ‖δp_u‖²

    w_u is the wrench that a motor would have been sent, δp_u the motion along those axes, r the
    lever, q the ratio of the stiffness at the device to that in the scene. The second part is what
    the damping that the coupling needs would burn. Like the work of a scene's own motors, this work
    is a port of its own: the hand may get it back along the other axes.

    Args:
        parameters: Run parameters.
        gains: K, B', K_r and B'_r, (n, 4).
        whole: Wrench that six motors would have been sent, (n, 6) in N and N m.
        lever: r, (n,).
        motion: δp of each tick, (n, 3) in m, and its rotation vectors, (n, 3) in rad.

    Returns:
        Work of each tick, (n,) in J; zero for axes that do not move.
    """
    lacking = 1.0 - axes_with_motor(parameters)
    ratios = parameters.force_scale * parameters.scale, parameters.energy_ratio
    work = np.zeros(len(whole))
    for first, ratio, step in zip((0, 3), ratios, motion, strict=True):
        column = 2 * first // 3
        unfelt = step * lacking[first : first + 3]
        burned = 0.5 * gains[:, column] + gains[:, column + 1] / parameters.period
        work -= np.sum(whole[:, first : first + 3] * unfelt, axis=1)
        work += ratio * lever**2 * burned * np.sum(unfelt**2, axis=1)
    return work


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
    """Returns K + B'/T and K_r + B'_r/T of the law, (n,) each.

    With n laws per tick only half of K/n + B'/T counts. Without a coupling law both are 0, also
    where the work on a shown tool is exact.
    """
    if not parameters.has_law or parameters.scene_ticks:
        return np.zeros(len(gains)), np.zeros(len(gains))
    n, share = parameters.law_evaluations, 1.0 if parameters.law_evaluations == 1 else SLACK_SHARE
    linear = gains[:, 0] / n + gains[:, 1] / parameters.period
    angular = gains[:, 2] / n + gains[:, 3] / parameters.period
    return share * linear, share * angular


def _slack(gain: Array, motion: Array, wrench: Array, spring: Spring, evaluations: int) -> Array:
    """Returns ½ g ‖δx‖², (n,) in J, and 0 where the law is not straight between u + g δx and u.

    Args:
        gain: g of each tick, (n,); with several evaluations per tick, half of that of one.
        motion: δx of the tool, (n, 3) in m or rad.
        wrench: Limited u on the tool, (n, 3) in N or N m.
        spring: The spring of the law.
        evaluations: Evaluations of the law per tick.
    """
    square = np.sum(motion**2, axis=1)
    change = gain * np.sqrt(square) * (1.0 if evaluations == 1 else 1.0 / SLACK_SHARE)
    is_straight = spring.is_straight(np.sqrt(np.sum(wrench**2, axis=1)), change)
    return np.asarray(np.where(is_straight, 0.5 * gain * square, 0.0))


def energy_balances(
    blocks: Iterable[NDArray[np.void]],
    state: AuditState,
    events: RunEvents,
    delay: int = 0,
    others: Iterator[Array] | None = None,
) -> Iterator[tuple[AuditedBlock, EnergyBalance]]:
    """Yields the energy balance of a run, block by block.

    Args:
        blocks: Records without gaps; no block is empty.
        state: State before the first of them.
        events: External actions during the run.
        delay: Delay in ticks: the wrench of row k acted on the motion between rows k + delay and
            k + delay + 1.
        others: Cumulative work of other hands' couplings on the scene by block, (n,) in J; None
            without other hands.
    """
    waiting: deque[NDArray[np.void]] = deque()
    for newest in chain(blocks, [None]):
        if newest is not None:
            waiting.append(newest)
        while waiting and (newest is None or sum(map(len, waiting)) - len(waiting[0]) >= delay):
            ticks = waiting.popleft()
            following = np.concatenate([ticks[:0], *waiting])[:delay]
            block = AuditedBlock.from_records(ticks, following, state, events)
            others_work = 0.0 if others is None else next(others)
            balance = EnergyBalance.from_block(block, events, delay, others_work)
            yield block, balance
            state = block.state_after(balance.sums)


def energy_deviations(block: AuditedBlock, balance: EnergyBalance) -> Iterator[Deviation]:
    """Yields the deviations of the recorded energies."""
    ticks = block.ticks
    for name, throughput in (
        ("coupling_work", balance.throughput),
        ("device_energy", balance.device_throughput),
        ("environment_energy", balance.throughput),
        ("contact_tank", balance.throughput),
    ):
        amount = np.abs(ticks[name] - getattr(balance, name))
        size = throughput + np.abs(ticks["potential"]) + np.abs(balance.environment_energy)
        allowed = TOLERANCE * (1 + size)
        yield Deviation(name, amount, allowed, "J", "recorded poses and wrenches")
    yield from balance.pulses.deviations(block)
    if block.scene_ticks:
        yield from _shown_deviations(block, balance)
        return
    for name in ("scene_tank", "scene_step"):
        yield Deviation(name, np.abs(ticks[name]), 0.0, "", "a scene that steps in every tick")
