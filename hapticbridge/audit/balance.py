"""A second opinion on a recording's physics: plain NumPy over the recorded poses and wrenches.

Written apart from the kernel on purpose. It uses other formulas where there are any (rotation
vectors by matrices of quaternion products over whole arrays), so that one mistake does not hide
the other. A long recording is judged block by block: ``Reached`` is what one hands to the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.device_port import (
    burnt_by_damping,
    kept_behind_a_law,
    passed_shares,
    work_of_commands,
)
from hapticbridge.audit.differences import (
    steps,
    summed,
    turn_between,
    turns,
)
from hapticbridge.audit.interventions import Interventions
from hapticbridge.audit.law import Motion, wrench_by_law
from hapticbridge.audit.reached import Reached
from hapticbridge.kernel.parameters import RunParameters

Array = NDArray[np.float64]

SLACK_SHARE = 0.5
"""Share of the slack that counts where several laws are computed in a tick, without unit: as
``certificate.needed_damping`` assumes."""


@dataclass(frozen=True, slots=True)
class Balance:
    """What the recorded poses and wrenches say by themselves.

    Cumulative is from the first tick of the recording on, however many ticks came before these.

    Attributes:
        wrench_on_tool: The coupling law at the recorded poses, (n, 6) in N and N m; the recorded
            wrench itself where the recorded poses alone do not tell it.
        wrench_on_device: What the guard should have sent for the recorded wrench, (n, 6).
        injected_damping: What the passivity controller should have added at most on an axis of
            translation and of rotation, (n, 2) in N s/m and N m s/rad.
        handle_position: Where the recorded device pose puts the handle, (n, 3) in m.
        handle_turn: By how much the recorded handle is turned from where it should be, (n,) in rad.
        coupling_work: Cumulative Σ f·δx + τ·δφ of the recorded wrench, (n,) in J; as recorded
            where it is summed over several laws a tick.
        throughput: Cumulative Σ |f·δx + τ·δφ|, (n,) in J.
        device_energy: Cumulative energy given to the device by the recorded wrenches, (n,) in J.
        device_throughput: The same with absolute values.
        environment_energy: S_k − S_start − works, with ``coupling_work`` from here, (n,) in J.
        slack: Σ ½‖δx‖²_{K+B/T} + ½‖δφ‖²_{K_r+B_r/T}, (n,) in J.
        kicked: What the device was given beyond what its damping burns and scene and coupling
            give up, (n,) in J; zero for an unknown damping, or several laws a tick. Behind a
            coupling law what the environment created is not in it: that is the other port's.
        commanded: What commands that changed the coupling gave to what is felt, (n,) in J.
        reached: What the balance of the next ticks begins with.
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
        outside: Interventions,
        late: int = 0,
        following: NDArray[np.void] | None = None,
    ) -> Balance:
        """Computes everything from records.

        Args:
            ticks: Records without gaps, ``TICK_DTYPE``, at least one.
            parameters: The run's.
            before: What the ticks before them left.
            outside: What was done to the run while it went on.
            late: After how many ticks a wrench answers a sample: what was sent in row k acted on
                the motion between rows k + late and k + late + 1.
            following: The records after these, as many as ``late``, or fewer where they end.
        """
        sums = before.sums
        numbers = ticks["tick"]
        motion = Motion.of(ticks, before.handle, before.tool, outside)
        gains = outside.laws(numbers)
        recorded = ticks["wrench_on_tool"]
        law = recorded
        if parameters.has_law and parameters.laws == 1:
            law = wrench_by_law(ticks, gains, parameters.period, motion)
        works = (
            np.sum(recorded[:, :3] * motion.tool_step, axis=1),
            np.sum(recorded[:, 3:] * motion.tool_turn, axis=1),
        )
        work = works[0] + works[1]
        # over several laws a tick the work is a sum that their mean does not tell
        coupling_work = (
            ticks["coupling_work"] if parameters.laws > 1 else summed(work, sums["coupling_work"])
        )

        sent = np.concatenate([before.sent[None], ticks["wrench_on_device"][:-1]])
        sent[np.isin(numbers, outside.resumed)] = 0.0
        device_step = steps(ticks["device_position"], before.device[:3])
        device_turn = turns(ticks["device_quaternion"], before.device[3:])
        device_work = np.sum(sent[:, :3] * device_step, axis=1)
        device_work += np.sum(sent[:, 3:] * device_turn, axis=1)
        device_energy = summed(device_work, sums["device_energy"])
        later = _later(ticks, following, late) if late else (device_step, device_turn)
        given = np.sum(sent[:, :3] * later[0], axis=1) + np.sum(sent[:, 3:] * later[1], axis=1)

        stored = ticks["kinetic"] + ticks["potential"] - before.start_energy
        created = stored - coupling_work - ticks["actuator_work"] - ticks["external_work"]
        linear, angular = _slack_gains(parameters, gains)
        slack = 0.5 * linear * np.sum(motion.tool_step**2, axis=1)
        slack += 0.5 * angular * np.sum(motion.tool_turn**2, axis=1)
        slack = summed(slack, sums["slack"])
        expected, guarded = before.guarded.after(ticks, outside, created - slack)
        seen = expected.seen
        kept, lost = coupling_work, created  # without a law, all that the scene took up
        kept_sum = np.zeros(len(ticks))
        turned = np.zeros(len(ticks))
        if parameters.has_law:
            around = outside.laws(numbers - 1), gains
            pulled = motion.pulled, motion.turned
            share_before = np.concatenate([[before.share], seen.share[:-1]])
            turned = work_of_commands(parameters, around, pulled, share_before)
            # the slack pays for what the environment creates, but a ramp or a limit lets through
            # only a share of the slack: counted here, it would blame a device that bears its law
            lost = np.minimum(created, 0.0)
            parts, held = kept_behind_a_law(
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
            kicked=_kicked(parameters, totals["given"], burnt, lost + kept),
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
    """Returns K + B/T and K_r + B_r/T of the coupling that the tool was held by, (n,) each.

    With n laws a tick only half of K/n + B/T counts; without a coupling law nothing does.
    """
    if not parameters.has_law:
        return np.zeros(len(gains)), np.zeros(len(gains))
    n, share = parameters.laws, 1.0 if parameters.laws == 1 else SLACK_SHARE
    linear = gains[:, 0] / n + gains[:, 1] / parameters.period
    angular = gains[:, 2] / n + gains[:, 3] / parameters.period
    return share * linear, share * angular


def _kicked(parameters: RunParameters, given: Array, burnt: Array, taken: Array) -> Array:
    """Returns Σ w·δp − Σ b‖δp‖²/t + what scene and coupling took up, in the device's scale."""
    if parameters.device_damping is None or (parameters.has_law and parameters.laws > 1):
        return np.zeros(len(given))
    return np.asarray(given - burnt + parameters.force_scale / parameters.scale * taken)


def _later(
    ticks: NDArray[np.void], following: NDArray[np.void] | None, late: int
) -> tuple[Array, Array]:
    """Returns the device's steps and turns ``late`` rows on; none where the records end by then."""
    rows = ticks if following is None else np.concatenate([ticks, following])
    moved = []
    for field, of in (("device_position", steps), ("device_quaternion", turns)):
        change = of(rows[field], rows[field][0])[late : late + len(ticks)]
        missing = np.zeros((len(ticks) - len(change), 3))
        moved.append(np.concatenate([change, missing]))
    return moved[0], moved[1]
