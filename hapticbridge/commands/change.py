"""Events of commands: recorded, and repeated by a re-simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import mujoco

from hapticbridge.coupling import Coupling
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel.codes import CLUTCHED, FORCE_OFF
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.state import Binding
from hapticbridge.provenance import restore_state
from hapticbridge.rendering import Method

CHANGES = ("coupling", "switch", "reset")
"""Names of the events that commands cause."""

TUNING_TIME = 0.5
"""Duration in s of any change of the coupling. From 2000 to 2400 N/m at 10 N the spring gains 4 mJ,
8 mW; from 200 to 2400 N/m 0.23 J, which the guard's energy limit stops. A shorter change feels like
a blow, a longer one like a lagging slider."""


def tuning_ticks(period: float) -> int:
    """Returns the duration of a change of the coupling in ticks of ``period`` seconds."""
    return max(round(TUNING_TIME / period), 1)


def coupling_in(event: Mapping[str, Any], parameters: RunParameters) -> Coupling:
    """Returns the coupling of an event ``coupling``.

    Raises:
        RecordingError: It has none, the run has no coupling law, or its duration is wrong.
    """
    tick = event.get("tick")
    try:
        coupling = Coupling(**{field.name: event.get(field.name) for field in fields(Coupling)})  # type: ignore[arg-type] # what is none is refused there
    except HapticBridgeError as error:
        raise RecordingError(f"event 'coupling' at tick {tick!r} is damaged: {error}") from None
    if not parameters.has_law:
        raise RecordingError(f"event 'coupling' at tick {tick!r}: the run has no coupling law")
    if event.get("ticks") != tuning_ticks(parameters.period):
        raise RecordingError(
            f"event 'coupling' at tick {tick!r} changes within {event.get('ticks')!r} ticks; it "
            f"takes {tuning_ticks(parameters.period)}"
        )
    return coupling


def bits_in(event: Mapping[str, Any]) -> int:
    """Returns the bits of a record's ``buttons`` for an event ``switch``.

    Raises:
        RecordingError: The event is damaged.
    """
    force, clutch = event.get("force"), event.get("clutch")
    if not isinstance(force, bool) or not isinstance(clutch, bool):
        raise RecordingError(
            f"event 'switch' at tick {event.get('tick')!r} is damaged: force is {force!r}, clutch "
            f"{clutch!r}; they must be true or false"
        )
    return (0 if force else FORCE_OFF) | (CLUTCHED if clutch else 0)


class Repeater:
    """Applies events of commands to a live or simulated run.

    The loop applies the event that it records, so live run and re-simulation share one path.
    ``start`` is the scene's state at the start (``provenance.start_state``), as bytes.
    """

    def __init__(
        self,
        binding: Binding,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        method: Method,
        parameters: RunParameters,
        start: bytes,
    ) -> None:
        self._binding, self._model, self._data = binding, model, data
        self._method, self._parameters, self._start = method, parameters, start

    def apply(self, event: Mapping[str, Any]) -> None:
        """Applies an event of ``CHANGES`` before the tick that it names.

        Raises:
            RecordingError: The event is damaged.
        """
        kind, parameters = event.get("event"), self._parameters
        if kind == "coupling":
            coupling = coupling_in(event, parameters)
            gains = self._method.gains(coupling, parameters.period / parameters.substeps)
            goal = replace(parameters, coupling=coupling)
            self._binding.tune(goal, gains, tuning_ticks(parameters.period))
        elif kind == "switch":
            self._binding.command(bits_in(event))
        elif kind == "reset":
            if not self._method.has_coupling:
                raise RecordingError(f"event 'reset': method '{self._method.name}' has no reset")
            restore_state(self._model, self._data, self._start)
            self._binding.take_reset()
