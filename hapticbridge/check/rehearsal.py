"""Rehearsal of a scene under a motion."""

from __future__ import annotations

import time
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.errors import SceneError
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.simulation import simulate
from hapticbridge.kernel.state import Binding
from hapticbridge.ledger import Ledger
from hapticbridge.pose import IDENTITY_POSE
from hapticbridge.rendering import default_method, prepare
from hapticbridge.scene import Scene
from hapticbridge.tick import TICK_DTYPE

_UNLIMITED = 1e30
"""Force limit in N and torque limit in N m without effect, because the full force is compared."""


@dataclass(frozen=True, slots=True, eq=False)
class Rehearsal:
    """Result of a scene under a motion.

    Attributes:
        records: One per tick, ``TICK_DTYPE``; ``wrench_on_tool`` is the wrench that the hand would
            feel.
        environment: ``strict``, ``within slack`` or ``active``.
        slack_share: Largest share of the slack that was used, without unit.
        fault: Tick and port of the first fault, or None.
        warnings: Number of MuJoCo's warnings.
        seconds: Processor time of the run in s: MuJoCo's step and the bridge's arithmetic.
    """

    records: NDArray[np.void]
    environment: str
    slack_share: float
    fault: tuple[int, str] | None
    warnings: int
    seconds: float


def rehearse(
    scene: Scene,
    samples: NDArray[np.void],
    coupling: Coupling,
    period: float,
    substeps: int = 1,
) -> Rehearsal:
    """Runs the scene from its start as the bridge would, one tick per sample.

    The hand does not yield: the handle follows the motion at any force. Two versions of a scene can
    therefore be compared tick by tick.

    Args:
        scene: Changed in place: reset, with the coupling's gains and the time step set.
        samples: Poses relative to the first, ``SAMPLE_DTYPE``, from ``samples_of``.
        coupling: Requested K and B.
        period: T in s.
        substeps: MuJoCo steps per tick.

    Raises:
        SceneError: A value is out of range, or a result is not finite; the message names the tick.
    """
    parameters = rehearsal_parameters(scene, coupling, period, substeps)
    binding = Binding(scene.model, scene.data, parameters)
    rows = np.zeros(samples.size, TICK_DTYPE)
    start = time.thread_time()
    done = simulate(binding.state, samples, binding.row, rows)
    seconds = time.thread_time() - start
    if done < samples.size:
        raise not_finite(scene, done, samples.size)
    ledger = Ledger.of(binding.state)
    return Rehearsal(
        records=rows,
        environment=ledger.environment,
        slack_share=ledger.slack_share,
        fault=ledger.fault,
        warnings=sum(int(warning.number) for warning in scene.data.warning),
        seconds=seconds,
    )


def not_finite(scene: Scene, tick: int, ticks: int) -> SceneError:
    """Returns the error for a motion that became not finite at a tick."""
    return SceneError(
        f"scene '{scene.name}' is not finite after tick {tick} of {ticks} of the motion"
    )


def rehearsal_parameters(
    scene: Scene, coupling: Coupling, period: float, substeps: int = 1
) -> RunParameters:
    """Resets a scene for the default method, and returns the parameters for ``Binding``.

    Raises:
        SceneError: A value is out of range.
    """
    method = default_method(substeps)
    prepare(scene, coupling, period, substeps, method, warns=False)
    # an error inside the C function would end the process; the first step in Python raises instead
    mujoco.mj_step(scene.model, scene.data)
    scene.reset()
    return RunParameters(
        grip=scene.grip,
        period=period,
        substeps=substeps,
        coupling=method.used(coupling, period / substeps),
        force_limit=_UNLIMITED,
        torque_limit=_UNLIMITED,
        ramp_ticks=0,
        device_origin=IDENTITY_POSE,
        handle_origin=scene.grip_pose(),
        device_start=IDENTITY_POSE,
        scheme=method.scheme,
    )
