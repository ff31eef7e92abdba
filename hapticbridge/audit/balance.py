"""Second computation of a recording's energies, in plain NumPy over recorded poses and wrenches.

It is written apart from the kernel on purpose, with other formulas where possible (quaternion
products over whole arrays), so that one mistake does not hide another. Long recordings are judged
block by block; ``Reached`` carries the state.
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
"""Share of the slack that counts with several laws per tick, without unit; equal to the assumption
of ``certificate.needed_damping``."""


@dataclass(frozen=True, slots=True)
class Balance:
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
        outside: Interventions,
        late: int = 0,
        following: NDArray[np.void] | None = None,
    ) -> Balance:
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
        if parameters.has_law and parameters.laws == 1:
            law = wrench_by_law(ticks, gains, parameters.period, motion)
        works = (
            np.sum(recorded[:, :3] * motion.tool_step, axis=1),
            np.sum(recorded[:, 3:] * motion.tool_turn, axis=1),
        )
        work = works[0] + works[1]
        # with several laws per tick the mean wrench does not determine the summed work
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
    n, share = parameters.laws, 1.0 if parameters.laws == 1 else SLACK_SHARE
    linear = gains[:, 0] / n + gains[:, 1] / parameters.period
    angular = gains[:, 2] / n + gains[:, 3] / parameters.period
    return share * linear, share * angular


def _unpaid_energy(parameters: RunParameters, given: Array, burnt: Array, taken: Array) -> Array:
    """Returns Σ w·δp − Σ b‖δp‖²/t + energy stored in scene and coupling, in the device's scale."""
    if parameters.device_damping is None or (parameters.has_law and parameters.laws > 1):
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
