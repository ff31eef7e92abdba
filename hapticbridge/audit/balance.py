"""A second opinion on a recording's physics: plain NumPy over the recorded poses and wrenches.

Written apart from the kernel on purpose. It uses other formulas where there are any (rotation
vectors by matrices of quaternion products over whole arrays), so that one mistake does not hide
the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.device_port import (
    burnt_by_damping,
    kept_behind_a_law,
    passed_shares,
)
from hapticbridge.audit.guarded import (
    expected_handle,
    expected_wrench,
    is_first,
    since_news,
    since_start,
    wrench_sent_before,
    wrench_share,
)
from hapticbridge.audit.turns import product_conjugate, rotate, steps, turn_between, turns
from hapticbridge.kernel.state import RunParameters
from hapticbridge.tick import TickFlag

Array = NDArray[np.float64]

SLACK_SHARE = 0.5
"""Share of the slack that counts where several laws are computed in a tick, without unit: as
``certificate.needed_damping`` assumes."""


@dataclass(frozen=True, slots=True)
class Balance:
    """What the recorded poses and wrenches say by themselves.

    Attributes:
        wrench_on_tool: The coupling law at the recorded poses, (n, 6) in N and N m; the recorded
            wrench itself where the recorded poses alone do not tell it.
        wrench_on_device: What the guard should have sent for the recorded wrench, (n, 6).
        injected_damping: What the passivity controller should have added, (n,) in N s/m.
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

    @classmethod
    def of(
        cls,
        ticks: NDArray[np.void],
        parameters: RunParameters,
        handle_start: Array,
        tool_start: Array,
        start_energy: float,
        resumed: Array,
        late: int = 0,
    ) -> Balance:
        """Computes everything from records.

        Args:
            ticks: Records without gaps, ``TICK_DTYPE``.
            parameters: The run's.
            handle_start: Handle pose (7,) before the first tick.
            tool_start: Tool pose (7,) before the first tick.
            start_energy: Kinetic plus potential energy before the first tick, in J.
            resumed: Ticks at which the run went on after a pause without force.
            late: After how many ticks a wrench answers a sample: what was sent in row k acted on
                the motion between rows k + late and k + late + 1.
        """
        coupling, period = parameters.coupling, parameters.period
        handle_step = steps(ticks["handle_position"], handle_start[:3])
        tool_step = steps(ticks["tool_position"], tool_start[:3])
        handle_turn = turns(ticks["handle_quaternion"], handle_start[3:])
        tool_turn = turns(ticks["tool_quaternion"], tool_start[3:])
        stretch = ticks["handle_position"] - ticks["tool_position"]
        twist = turn_between(ticks["tool_quaternion"], ticks["handle_quaternion"])
        force = coupling.stiffness * stretch + coupling.damping / period * (handle_step - tool_step)
        torque = coupling.rotational_stiffness * twist + coupling.rotational_damping / period * (
            handle_turn - tool_turn
        )

        is_midpoint = (ticks["flags"] & int(TickFlag.MIDPOINT)) != 0
        if np.any(is_midpoint):
            # the turn that takes the tool from the tick before to this one carries what was then
            carried = product_conjugate(ticks["tool_quaternion"], tool_start[3:])
            before = turn_between(tool_start[3:], handle_start[3:])
            spring = 0.5 * (twist + rotate(carried, np.vstack([before[None], twist[:-1]])))
            midway = 0.5 * (handle_turn + rotate(carried, handle_turn)) - tool_turn
            rate = coupling.rotational_damping / period + 0.5 * coupling.rotational_stiffness
            midpoint = coupling.rotational_stiffness * spring + rate * midway
            torque = np.where(is_midpoint[:, None], midpoint, torque)

        recorded = ticks["wrench_on_tool"]
        law = np.concatenate([force, torque], axis=1)
        if not parameters.has_law or parameters.laws > 1:
            law = recorded
        works = (
            np.sum(recorded[:, :3] * tool_step, axis=1),
            np.sum(recorded[:, 3:] * tool_turn, axis=1),
        )
        work = works[0] + works[1]
        # over several laws a tick the work is a sum that their mean does not tell
        coupling_work = ticks["coupling_work"] if parameters.laws > 1 else np.cumsum(work)

        device_start = np.array(parameters.device_start)
        sent = wrench_sent_before(ticks, resumed)
        device_step = steps(ticks["device_position"], device_start[:3])
        device_turn = turns(ticks["device_quaternion"], device_start[3:])
        device_work = np.sum(sent[:, :3] * device_step, axis=1)
        device_work += np.sum(sent[:, 3:] * device_turn, axis=1)
        given = device_work
        if late:
            given = np.sum(sent[:, :3] * _later(device_step, late), axis=1)
            given += np.sum(sent[:, 3:] * _later(device_turn, late), axis=1)

        position, orientation = expected_handle(ticks, parameters, handle_start, tool_start)
        on_device, injected = expected_wrench(ticks, parameters, resumed)
        stored = ticks["kinetic"] + ticks["potential"] - start_energy
        created = stored - coupling_work - ticks["actuator_work"] - ticks["external_work"]
        kept, lost = coupling_work, created  # without a law, all that the scene took up
        if parameters.has_law:
            # the slack pays for what the environment creates, but a ramp or a limit lets through
            # only a share of the slack: counted here, it would blame a device that bears its law
            lost = np.minimum(created, 0.0)
            kept = kept_behind_a_law(
                parameters,
                stretch=(stretch, twist),
                stretched=(handle_step - tool_step, handle_turn - tool_turn),
                work=works,
                passed=passed_shares(ticks, parameters),
                since_start=since_start(ticks, resumed),
                share=wrench_share(ticks, parameters, resumed),
                has_end=not late,
            )
        linear, angular = _slack_gains(parameters)
        slack = 0.5 * linear * np.sum(tool_step**2, axis=1)
        slack += 0.5 * angular * np.sum(tool_turn**2, axis=1)
        return cls(
            wrench_on_tool=law,
            wrench_on_device=on_device,
            injected_damping=injected,
            handle_position=position,
            handle_turn=np.linalg.norm(
                turn_between(orientation, ticks["handle_quaternion"]), axis=1
            ),
            coupling_work=coupling_work,
            throughput=np.cumsum(np.abs(work)),
            device_energy=np.cumsum(device_work),
            device_throughput=np.cumsum(np.abs(device_work)),
            environment_energy=created,
            slack=np.cumsum(slack),
            kicked=_kicked(ticks, parameters, np.cumsum(given), lost + kept, resumed, late),
        )


def _slack_gains(parameters: RunParameters) -> tuple[float, float]:
    """Returns K + B/T and K_r + B_r/T of the coupling that the tool was held by.

    With n laws a tick only half of K/n + B/T counts; without a coupling law nothing does.
    """
    coupling = parameters.coupling
    if not parameters.has_law:
        return 0.0, 0.0
    n, share = parameters.laws, 1.0 if parameters.laws == 1 else SLACK_SHARE
    linear = coupling.stiffness / n + coupling.damping / parameters.period
    angular = coupling.rotational_stiffness / n + coupling.rotational_damping / parameters.period
    return share * linear, share * angular


def _kicked(
    ticks: NDArray[np.void],
    parameters: RunParameters,
    given: Array,
    taken: Array,
    resumed: Array,
    late: int,
) -> Array:
    """Returns Σ w·δp − Σ b‖δp‖²/t + what scene and coupling took up, in the device's scale."""
    if parameters.device_damping is None or (parameters.has_law and parameters.laws > 1):
        return np.zeros(len(ticks))
    start = np.array(parameters.device_start)
    burnt = burnt_by_damping(
        parameters,
        _later(steps(ticks["device_position"], start[:3]), late),
        _later(turns(ticks["device_quaternion"], start[3:]), late),
        since_news(ticks, parameters),
        ~is_first(ticks, resumed),
    )
    return np.asarray(given - burnt + parameters.force_scale / parameters.scale * taken)


def _later(moved: Array, late: int) -> Array:
    """Returns each row's motion ``late`` rows on; none where the recording has ended by then."""
    return np.concatenate([moved[late:], np.zeros_like(moved[:late])]) if late else moved
