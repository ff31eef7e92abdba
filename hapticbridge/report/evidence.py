"""Records and energies of a run, prepared for plots and rules."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.balance import Balance
from hapticbridge.audit.interventions import Interventions
from hapticbridge.audit.reached import Reached
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.device.lateness import delay_ticks
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.provenance import MODEL_ATTACHMENT, STARTS, meta_start, parameters_of
from hapticbridge.recording import Recording, due_times
from hapticbridge.recording.reader import BLOCK
from hapticbridge.rendering import Method, method_named
from hapticbridge.report.curves import DRAWABLE

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Evidence:
    """A run of n ticks that can be drawn.

    Attributes:
        recording: The recording, with n >= 1 ticks.
        parameters: Run parameters.
        worst: Run parameters with the most demanding coupling that commands selected.
        info: The device.
        method: The rendering method.
        time: Due time of each tick in s on the clock of the events, (n,).
        created: Energy that the environment has created so far, (n,) in J.
        allowed: Slack: energy that the environment may have created so far, (n,) in J.
        kicked: Unpaid energy given to the device so far, (n,) in J; zeros if it cannot be computed
            (``Balance.kicked``).
        model: The compiled scene; None if the file lacks it or this MuJoCo cannot load it.
    """

    recording: Recording
    parameters: RunParameters
    worst: RunParameters
    info: DeviceInfo
    method: Method
    time: Array
    created: Array
    allowed: Array
    kicked: Array
    model: mujoco.MjModel | None

    @property
    def ticks(self) -> NDArray[np.void]:
        """Records, ``TICK_DTYPE``, (n,)."""
        return self.recording.ticks

    @property
    def events(self) -> list[dict[str, Any]]:
        """Recorded events."""
        return self.recording.events

    @property
    def asked(self) -> Coupling:
        """Smallest requested coupling that leads to ``worst``.

        If the law's B' is 0, the method removed all requested damping, which may have had any value
        up to the effective one. It then counts as 0.
        """
        used, step = self.worst.coupling, self.worst.period / self.worst.substeps
        asked = self.method.rendered(used, step)
        return replace(
            asked,
            damping=asked.damping if used.damping else 0.0,
            rotational_damping=asked.rotational_damping if used.rotational_damping else 0.0,
        )

    @property
    def lateness(self) -> Array:
        """Delay of each tick's start after its deadline, (n,) in s."""
        return np.asarray(1e-9 * (self.ticks["wake_ns"] - self.ticks["deadline_ns"]))

    def judged(self, report: AuditReport) -> tuple[Array, Array]:
        """Returns the energy of the port at fault and its bound, (n,) in J each.

        The verdict must be ``active``.
        """
        if report.port == "device":
            return self.kicked, np.zeros_like(self.kicked)
        # a strict audit grants no slack
        is_slack_used_up = report.environment == "active"
        return self.created, self.allowed if is_slack_used_up else np.zeros_like(self.allowed)

    @classmethod
    def of(cls, recording: Recording) -> Evidence | None:
        """Computes the evidence of a recording; None if it is damaged or has no ticks.

        The recording need not have passed an audit.
        """
        ticks = recording.ticks
        fields = (name for name in ticks.dtype.names or () if ticks.dtype[name].base.kind == "f")
        if not len(ticks) or not all((np.abs(ticks[name]) < DRAWABLE).all() for name in fields):
            return None
        try:
            parameters = parameters_of(recording.meta)
            info = DeviceInfo.from_json(recording.meta.get("device", ""))
            method = method_named(recording.meta.get("method", ""))
            linear, rotational = info.burning_damping
            parameters = replace(
                parameters, device_damping=linear, device_rotational_damping=rotational
            )
            home = np.array(meta_start(recording.meta, "tool_start"))
            outside = Interventions.of(recording.events, parameters, home)
            worst = outside.worst(info, method)
            energies = np.concatenate(
                [
                    (each.environment_energy, each.slack, each.kicked)
                    for each in _balances(recording, parameters, info, outside)
                ],
                axis=1,
            )
        except HapticBridgeError:
            return None
        return cls(
            recording=recording,
            parameters=parameters,
            worst=worst,
            info=info,
            method=method,
            time=due_times(ticks, parameters.period),
            created=energies[0],
            allowed=energies[1],
            kicked=energies[2],
            model=_model(recording),
        )


def _balances(
    recording: Recording, parameters: RunParameters, info: DeviceInfo, outside: Interventions
) -> Iterator[Balance]:
    """Yields the energy balance by blocks; the whole run at once would need much more memory."""
    starts = {name: np.array(meta_start(recording.meta, name)) for name in STARTS}
    ticks, late = recording.ticks, delay_ticks(info, parameters.period) or 0
    energy = float(starts["start_kinetic"][0] + starts["start_potential"][0])
    reached = Reached.at_start(parameters, starts["handle_start"], starts["tool_start"], energy)
    for begin in range(0, len(ticks), BLOCK):
        end = begin + BLOCK
        following = ticks[end : end + late]
        balance = Balance.of(ticks[begin:end], parameters, reached, outside, late, following)
        reached = balance.reached
        yield balance


def _model(recording: Recording) -> mujoco.MjModel | None:
    content = recording.attachments.get(MODEL_ATTACHMENT)
    if content is None:
        return None
    try:
        return mujoco.MjModel.from_binary_path(MODEL_ATTACHMENT, assets={MODEL_ATTACHMENT: content})
    except ValueError:
        return None
