"""What a page draws and judges by: a run's records, and the energies that they give."""

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
    """A run that can be drawn: n ticks, and per tick what each port has given and may give.

    Attributes:
        recording: As it was read, with n >= 1 ticks.
        parameters: The run's.
        worst: The same with the coupling that asks most of the device, where commands changed it.
        info: The device.
        method: How the tool was rendered.
        time: When each tick was due, in s of the clock that the events tell, (n,).
        created: What the environment has created so far, (n,) in J.
        allowed: Its slack: what it may have created so far, (n,) in J.
        kicked: What the device was given beyond what is paid for, (n,) in J; zero throughout where
            that cannot be told (``Balance.kicked``).
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
        """The records, ``TICK_DTYPE``, (n,)."""
        return self.recording.ticks

    @property
    def events(self) -> list[dict[str, Any]]:
        """What happened."""
        return self.recording.events

    @property
    def asked(self) -> Coupling:
        """The least coupling that a user asks for to get ``worst``.

        Where the law's B' is 0 a method has taken off all the damping that was asked for, which
        may have been anything up to what is felt: then it counts as 0.
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
        """How long after its deadline each tick began, (n,) in s."""
        return np.asarray(1e-9 * (self.ticks["wake_ns"] - self.ticks["deadline_ns"]))

    def judged(self, report: AuditReport) -> tuple[Array, Array]:
        """Returns what the port at fault has given, and what it may have given, (n,) in J each.

        Args:
            report: The audit's verdict on the run, ``active``.
        """
        if report.port == "device":
            return self.kicked, np.zeros_like(self.kicked)
        # asked for strictly, the slack does not count
        is_slack_used_up = report.environment == "active"
        return self.created, self.allowed if is_slack_used_up else np.zeros_like(self.allowed)

    @classmethod
    def of(cls, recording: Recording) -> Evidence | None:
        """Returns what can be drawn of a recording; None for a damaged one, or one without ticks.

        Args:
            recording: As it was read; it need not have passed an audit.
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
    """Yields the balance block by block: of a long run one takes many times the records' room."""
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
