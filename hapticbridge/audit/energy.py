"""Second computation of a recording's energies, in plain NumPy over recorded poses and wrenches.

It is written apart from the kernel on purpose, with other formulas where possible (quaternion
products over whole arrays), so that one mistake does not hide another. Long recordings are judged
block by block; ``Reached`` carries the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.events import RunEvents
from hapticbridge.audit.guard import Guarded, limits_on_tool, spring_energy
from hapticbridge.audit.motion import Motion, steps, summed, turn_between, turns, wrench_by_law
from hapticbridge.kernel.parameters import RunParameters

# Energy balance of the device port, from recorded poses and wrenches.


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


def stored_in_coupling(
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
    V_{k−1}(p_k)), p = h_k − x_{k−1}, is the work of a command that changes K (``kernel.coupling``);
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
    """Returns W_k of ``stored_in_coupling``, the work of commands on the springs, (n,) in J.

    Arguments are those of ``stored_in_coupling``; ``share_before`` has one value per tick.
    """
    work = np.zeros(len(share_before))
    for column, limit, p in zip((0, 2), limits_on_tool(parameters), pulled, strict=True):
        k_before, k = gains[0][:, column], gains[1][:, column]
        if np.any(k != k_before):
            length = np.linalg.norm(p, axis=1)
            work += spring_energy(k, length, limit) - spring_energy(k_before, length, limit)
    return share_before * work


# Audit state carried from one block of records to the next.

SUMS = (
    "coupling_work",
    "throughput",
    "device_energy",
    "device_throughput",
    "slack",
    "given",
    "burnt",
    "kept",
    "commanded",
)
"""Names of the cumulative energies."""


@dataclass(frozen=True, slots=True)
class Reached:
    """State of the balance after the previous tick.

    Attributes:
        handle: Handle pose (7,).
        tool: Tool pose (7,).
        device: Device pose (7,).
        sent: Wrench sent to the device, (6,).
        start_energy: Kinetic, potential and elastic energy before the first tick, in J.
        share: Share of the wrench that ramp and fading transmitted.
        guarded: State of the guard.
        sums: Cumulative energies in J.
    """

    handle: Array
    tool: Array
    device: Array
    sent: Array
    start_energy: float
    share: float
    sums: dict[str, float]
    guarded: Guarded

    @classmethod
    def at_start(
        cls, parameters: RunParameters, handle: Array, tool: Array, start_energy: float
    ) -> Reached:
        """Returns the state before the first tick.

        ``start_energy`` is kinetic plus potential energy, in J.
        """
        device = np.array(parameters.device_start)
        guarded = Guarded.at_start(parameters, handle, tool, start_energy)
        sums = dict.fromkeys(SUMS, 0.0)
        return cls(handle, tool, device, np.zeros(6), start_energy, 0.0, sums, guarded)


Array = NDArray[np.float64]

SLACK_SHARE = 0.5
"""Share of the slack that counts with several laws per tick, without unit; equal to the assumption
of ``certificate.required_damping``."""


@dataclass(frozen=True, slots=True)
class EnergyBalance:
    """Quantities computed from recorded poses and wrenches.

    Cumulative values count from the first tick of the recording.

    Attributes:
        wrench_on_tool: Wrench of the coupling law at the recorded poses, (n, 6) in N and N m; the
            recorded wrench if poses alone do not determine it.
        wrench_on_device: Wrench that the guard should have sent for the recorded one, (n, 6).
        injected_damping: Largest damping that the passivity controller should have added on an axis
            of translation and of rotation, (n, 2) in N s/m and N m s/rad.
        handle_position: Handle position computed from the recorded device pose, (n, 3) in m.
        handle_turn: Angle between recorded and computed handle orientation, (n,) in rad.
        coupling_work: Cumulative Σ f·δx + τ·δφ of the recorded wrench, (n,) in J; as recorded if
            several laws per tick are summed.
        throughput: Cumulative Σ |f·δx + τ·δφ|, (n,) in J.
        device_energy: Cumulative energy given to the device by the recorded wrenches, (n,) in J.
        device_throughput: Cumulative sum of that energy's absolute values, (n,) in J.
        environment_energy: S_k − S_start − works, with the ``coupling_work`` above, (n,) in J.
        slack: Σ ½‖δx‖²_{K+B/T} + ½‖δφ‖²_{K_r+B_r/T}, (n,) in J.
        kicked: Energy given to the device beyond its dissipation and the energy released by scene
            and coupling, (n,) in J. Zero for an unknown damping or several laws per tick. With a
            coupling law, energy created by the environment is not included; it belongs to the other
            port.
        commanded: Energy that commands added to the effective coupling, (n,) in J.
        reached: State at the end of these ticks.
    """

    wrench_on_tool: Array
    wrench_on_device: Array
    injected_damping: Array
    handle_position: Array
    handle_turn: Array
    coupling_work: Array
    throughput: Array
    device_energy: Array
    device_throughput: Array
    environment_energy: Array
    slack: Array
    kicked: Array
    commanded: Array

    reached: Reached

    @classmethod
    def of(
        cls,
        ticks: NDArray[np.void],
        parameters: RunParameters,
        before: Reached,
        outside: RunEvents,
        late: int = 0,
        following: NDArray[np.void] | None = None,
    ) -> EnergyBalance:
        """Computes the balance of consecutive records.

        Args:
            ticks: Records without gaps, ``TICK_DTYPE``, at least one.
            parameters: Run parameters.
            before: State before these ticks.
            outside: External actions during the run.
            late: Delay in ticks: the wrench of row k acted on the motion between rows k + late and
                k + late + 1.
            following: The next ``late`` records, or fewer at the end.
        """
        sums = before.sums
        numbers = ticks["tick"]
        motion = Motion.of(ticks, before.handle, before.tool, outside)
        gains = outside.laws(numbers)
        recorded = ticks["wrench_on_tool"]
        law = recorded
        if parameters.has_law and parameters.law_evaluations == 1:
            law = wrench_by_law(ticks, gains, parameters.period, motion)
        works = (
            np.sum(recorded[:, :3] * motion.tool_step, axis=1),
            np.sum(recorded[:, 3:] * motion.tool_turn, axis=1),
        )
        work = works[0] + works[1]
        # with several laws per tick the mean wrench does not determine the summed work
        coupling_work = (
            ticks["coupling_work"]
            if parameters.law_evaluations > 1
            else summed(work, sums["coupling_work"])
        )

        sent = np.concatenate([before.sent[None], ticks["wrench_on_device"][:-1]])
        sent[np.isin(numbers, outside.resumed)] = 0.0
        device_step = steps(ticks["device_position"], before.device[:3])
        device_turn = turns(ticks["device_quaternion"], before.device[3:])
        device_work = np.sum(sent[:, :3] * device_step, axis=1)
        device_work += np.sum(sent[:, 3:] * device_turn, axis=1)
        device_energy = summed(device_work, sums["device_energy"])
        later = _delayed_steps(ticks, following, late) if late else (device_step, device_turn)
        given = np.sum(sent[:, :3] * later[0], axis=1) + np.sum(sent[:, 3:] * later[1], axis=1)

        stored = ticks["kinetic"] + ticks["potential"] - before.start_energy
        created = stored - coupling_work - ticks["actuator_work"] - ticks["external_work"]
        linear, angular = _slack_gains(parameters, gains)
        slack = 0.5 * linear * np.sum(motion.tool_step**2, axis=1)
        slack += 0.5 * angular * np.sum(motion.tool_turn**2, axis=1)
        slack = summed(slack, sums["slack"])
        expected, guarded = before.guarded.after(ticks, outside, created - slack)
        seen = expected.seen
        kept, lost = coupling_work, created  # without a law, all energy stored in the scene
        kept_sum = np.zeros(len(ticks))
        turned = np.zeros(len(ticks))
        if parameters.has_law:
            around = outside.laws(numbers - 1), gains
            pulled = motion.pulled, motion.turned
            share_before = np.concatenate([[before.share], seen.share[:-1]])
            turned = work_of_commands(parameters, around, pulled, share_before)
            # The slack covers energy created by the environment, but a ramp or a limit passes only
            # a share of the slack. Counted here, it would blame a device that bears its coupling.
            lost = np.minimum(created, 0.0)
            parts, held = stored_in_coupling(
                parameters,
                gains=around,
                pulled=pulled,
                stretch=(motion.stretch, motion.twist),
                stretched=motion.stretched,
                work=works,
                passed=passed_shares(ticks, parameters),
                since_start=seen.since_start,
                share=seen.share,
                share_before=before.share,
                has_end=not late,
            )
            kept_sum = summed(parts, sums["kept"])
            kept = kept_sum + held
        burnt = np.zeros(len(ticks))
        if parameters.device_damping is not None:
            parts = burnt_by_damping(parameters, *later, seen.interval, ~seen.first)
            burnt = summed(parts, sums["burnt"])
        totals = {
            "coupling_work": coupling_work,
            "throughput": summed(np.abs(work), sums["throughput"]),
            "device_energy": device_energy,
            "device_throughput": summed(np.abs(device_work), sums["device_throughput"]),
            "slack": slack,
            "given": summed(given, sums["given"]),
            "burnt": burnt,
            "kept": kept_sum,
            "commanded": summed(turned, sums["commanded"]),
        }
        last = ticks[-1]
        return cls(
            wrench_on_tool=law,
            wrench_on_device=expected.wrench,
            injected_damping=expected.injected,
            handle_position=expected.position,
            handle_turn=np.linalg.norm(
                turn_between(expected.orientation, ticks["handle_quaternion"]), axis=1
            ),
            coupling_work=coupling_work,
            throughput=totals["throughput"],
            device_energy=device_energy,
            device_throughput=totals["device_throughput"],
            environment_energy=created,
            slack=totals["slack"],
            kicked=_unpaid_energy(parameters, totals["given"], burnt, lost + kept),
            commanded=totals["commanded"],
            reached=Reached(
                handle=np.concatenate([last["handle_position"], last["handle_quaternion"]]),
                tool=np.concatenate([last["tool_position"], last["tool_quaternion"]]),
                device=np.concatenate([last["device_position"], last["device_quaternion"]]),
                sent=last["wrench_on_device"].copy(),
                start_energy=before.start_energy,
                share=float(seen.share[-1]),
                guarded=guarded,
                sums={name: float(total[-1]) for name, total in totals.items()},
            ),
        )


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


def _unpaid_energy(parameters: RunParameters, given: Array, burnt: Array, taken: Array) -> Array:
    """Returns Σ w·δp − Σ b‖δp‖²/t + energy stored in scene and coupling, in the device's scale."""
    if parameters.device_damping is None or (parameters.has_law and parameters.law_evaluations > 1):
        return np.zeros(len(given))
    return np.asarray(given - burnt + parameters.force_scale / parameters.scale * taken)


def _delayed_steps(
    ticks: NDArray[np.void], following: NDArray[np.void] | None, late: int
) -> tuple[Array, Array]:
    """Returns the device's steps and turns ``late`` rows later; zeros after the last record."""
    rows = ticks if following is None else np.concatenate([ticks, following])
    moved = []
    for field, of in (("device_position", steps), ("device_quaternion", turns)):
        change = of(rows[field], rows[field][0])[late : late + len(ticks)]
        missing = np.zeros((len(ticks) - len(change), 3))
        moved.append(np.concatenate([change, missing]))
    return moved[0], moved[1]
