"""External actions during a run, from its events.

This is the second reading of the events: ``commands.change`` applies them one by one to the kernel;
here they become arrays over ticks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import required_axis_damping
from hapticbridge.commands.execution import bits_in, coupling_in, tuning_ticks
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import RecordingError
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.rendering import Method

Array = NDArray[np.float64]

_REACHES = 2**62


@dataclass(frozen=True, slots=True)
class RunEvents:
    """Pauses, resets, switches and couplings of a run.

    Attributes:
        parameters: Run parameters at the start.
        home: Pose (7,) of tool and handle after a reset.
        resumed: Ticks at which the run resumed after a pause without force.
        resets: Ticks before which the scene was reset.
        couplings: Couplings of the law (K and B') in order, the initial one first.
    """

    parameters: RunParameters
    home: Array
    resumed: Array = field(default_factory=lambda: np.zeros(0))
    resets: Array = field(default_factory=lambda: np.zeros(0))
    couplings: tuple[Coupling, ...] = ()
    _began: Array = field(default_factory=lambda: np.zeros(0))
    _switched: tuple[Array, NDArray[np.int64]] = field(
        default_factory=lambda: (np.zeros(0), np.zeros(0, np.int64))
    )

    @classmethod
    def of(
        cls, events: Iterable[Mapping[str, Any]], parameters: RunParameters, home: Array
    ) -> RunEvents:
        """Reads the events of a recording.

        ``home`` is the tool pose (7,) before the first tick.

        Raises:
            RecordingError: An event is damaged.
        """
        by_name: dict[str, list[Mapping[str, Any]]] = {
            name: [] for name in ("resume", "reset", "coupling", "switch")
        }
        for event in events:
            if event.get("event") in by_name:
                by_name[str(event["event"])].append(event)
        ticks = {name: np.array([_tick(e) for e in of], float) for name, of in by_name.items()}
        return cls(
            parameters=parameters,
            home=home,
            resumed=ticks["resume"],
            resets=ticks["reset"],
            couplings=(
                parameters.coupling,
                *(coupling_in(event, parameters) for event in by_name["coupling"]),
            ),
            _began=ticks["coupling"],
            _switched=(
                ticks["switch"],
                np.array([bits_in(e) for e in by_name["switch"]], np.int64),
            ),
        )

    def laws(self, numbers: NDArray[np.int64]) -> Array:
        """Returns K, B', K_r, B'_r in some ticks, (n, 4)."""
        goals = np.array([_gains(c) for c in (self.parameters.coupling, *self.couplings[1:])])
        length = tuning_ticks(self.parameters.period)
        value, gone = np.tile(goals[0], (len(numbers), 1)), goals[0]
        for index, (begin, goal) in enumerate(zip(self._began, goals[1:], strict=True)):
            later = self._began[index + 1] if index + 1 < len(self._began) else _REACHES
            share = np.clip((numbers - begin + 1.0) / length, 0.0, 1.0)[:, None]
            value = np.where(share > 0, gone + share * (goal - gone), value)
            gone = gone + min(max((later - begin) / length, 0.0), 1.0) * (goal - gone)
        return value

    def buttons(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Returns the bits of ``buttons`` that commands set in some ticks."""
        at, bits = self._switched
        last = np.searchsorted(at, numbers, side="right") - 1
        return np.concatenate([[0], bits])[last + 1]

    def is_reset(self, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Returns True for each tick that began with a reset."""
        return np.isin(numbers, self.resets)

    def sentences(self, given: float | None = None) -> tuple[str, ...]:
        """Describes changes of the coupling; empty without any.

        ``given`` is the energy that they added to the effective coupling, in J; None if not yet
        known.
        """
        count = len(self.couplings) - 1
        if count < 1:
            return ()
        began, last = self.couplings[0], self.couplings[-1]
        turning = (
            ""
            if last.rotational_stiffness == began.rotational_stiffness
            else (f", K_r = {last.rotational_stiffness:g} N m/rad")
        )
        return (
            f"so it began; commands changed the coupling {count} times, last to K = "
            f"{last.stiffness:g} N/m{turning}, B' = {last.damping:g} N s/m used"
            + ("" if given is None else f", which gave the coupling {given:.3g} J"),
        )

    def worst(self, info: DeviceInfo, method: Method) -> RunParameters:
        """Returns the run's parameters with the most demanding coupling, per kind of axis.

        The required damping is convex in the coupling, so no intermediate coupling needs more.
        """
        parameters = self.parameters
        if len(self.couplings) < 2:
            return parameters
        needs = [
            required_axis_damping(
                info,
                coupling,
                parameters.period,
                parameters.scale,
                parameters.force_scale,
                parameters.law_evaluations,
                method,
            )
            for coupling in self.couplings
        ]
        linear, angular = (
            self.couplings[int(np.argmax([need[axis] for need in needs]))] for axis in (0, 1)
        )
        coupling = replace(
            linear,
            rotational_stiffness=angular.rotational_stiffness,
            rotational_damping=angular.rotational_damping,
        )
        return replace(parameters, coupling=coupling)


def _tick(event: Mapping[str, Any]) -> int:
    tick = event.get("tick")
    if not isinstance(tick, int) or isinstance(tick, bool) or not 0 <= tick < _REACHES:
        raise RecordingError(
            f"event '{event.get('event')}' has tick {tick!r}; it must be a whole number >= 0"
        )
    return tick


def _gains(coupling: Coupling) -> tuple[float, ...]:
    return (
        coupling.stiffness,
        coupling.damping,
        coupling.rotational_stiffness,
        coupling.rotational_damping,
    )
