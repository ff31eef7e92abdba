"""Second computation of the guard, from records alone.

It repeats over whole arrays, block by block, what ``kernel.watch``, ``kernel.account`` and
``kernel.wrench`` do tick by tick.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.controlled import Account
from hapticbridge.audit.differences import quaternion_product, turn_between
from hapticbridge.audit.interventions import Interventions
from hapticbridge.audit.law import poses_before
from hapticbridge.audit.limited import chained
from hapticbridge.audit.watched import Seen, Watch, has_flag
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.tick import TickFlag

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Expected:
    """Expected content of some records.

    Attributes:
        position: Handle position, (n, 3) in m.
        orientation: Handle orientation, (n, 4).
        wrench: Wrench sent to the device, (n, 6).
        injected: Largest damping that the controller added on an axis of translation and of
            rotation, (n, 2) in N s/m and N m s/rad.
        seen: Result of the watch.
    """

    position: Array
    orientation: Array
    wrench: Array
    injected: Array
    seen: Seen


@dataclass(slots=True)
class Guarded:
    """State of the guard after the previous tick.

    Attributes:
        parameters: Run parameters.
        watch: State of the watch.
        handle: Handle pose (7,).
        tool: Tool pose (7,).
        origin: Device pose at the last anchoring.
        target: Handle pose at the last anchoring.
        account: State of the passivity observer.
        slewed: Wrench (6,) before ramp and fading.
    """

    parameters: RunParameters
    watch: Watch
    handle: Array
    tool: Array
    origin: Array
    target: Array
    account: Account
    slewed: Array = field(default_factory=lambda: np.zeros(6))

    @classmethod
    def at_start(
        cls, parameters: RunParameters, handle: Array, tool: Array, start_energy: float
    ) -> Guarded:
        """Returns the state before the first tick; see ``Reached.at_start``."""
        origin, target = np.array(parameters.device_origin), np.array(parameters.handle_origin)
        watch = Watch.at_start(parameters)
        account = Account(parameters, start_energy)
        return cls(parameters, watch, handle, tool, origin, target, account)

    def after(
        self, ticks: NDArray[np.void], outside: Interventions, excess: Array
    ) -> tuple[Expected, Guarded]:
        """Computes the expected content of the next records, ``TICK_DTYPE``, at least one.

        ``excess`` is the energy created by the environment beyond the slack, (n,) in J.
        """
        then = copy.copy(self)
        seen, then.watch = self.watch.after(ticks, outside)
        device = self.watch.device
        position, orientation = then._follow(ticks, outside)
        parameters = self.parameters
        axes = np.array(parameters.axes).reshape(3, 3)
        on_tool = ticks["wrench_on_tool"]
        force = -parameters.force_scale * on_tool[:, :3] @ axes
        torque = -parameters.force_scale / parameters.scale * on_tool[:, 3:] @ axes
        requested = np.concatenate([force, torque], axis=1)
        control, then.account = self.account.after(
            ticks, requested, seen, device, outside.resumed, excess
        )
        guarding = parameters.guarding
        starts = seen.first | has_flag(ticks, TickFlag.RESEATED)
        parts = (
            (slice(0, 3), parameters.force_limit, guarding.force_rise),
            (slice(3, 6), parameters.torque_limit, guarding.torque_rise),
        )
        full = np.concatenate(
            [
                chained(
                    control.wrench[:, part],
                    control.change[:, part],
                    limit,
                    rise,
                    starts,
                    self.slewed[part],
                )
                for part, limit, rise in parts
            ],
            axis=1,
        )
        then.slewed = full[-1]
        wrench = full * seen.share[:, None]
        return Expected(position, orientation, wrench, control.injected, seen), then

    def _follow(self, ticks: NDArray[np.void], outside: Interventions) -> tuple[Array, Array]:
        """Maps the recorded device poses into the scene: h = h_0 + scale · A (p − p_0).

        p_0 and h_0 are the device's and the tool's pose at the last anchoring. During a clutch the
        handle keeps its pose.
        """
        parameters, count = self.parameters, len(ticks)
        handle, tool, device = (_poses(ticks, name) for name in ("handle", "tool", "device"))
        before = poses_before(ticks, "handle", self.handle, outside)
        tool_before = poses_before(ticks, "tool", self.tool, outside)
        is_seated = has_flag(ticks, TickFlag.RESEATED)
        at = np.maximum.accumulate(np.where(is_seated, np.arange(count), -1))
        origin = np.where(at[:, None] >= 0, device[at], self.origin)
        target = np.where(at[:, None] >= 0, tool_before[at], self.target)
        axes = np.array(parameters.axes).reshape(3, 3)
        moved = (device[:, :3] - origin[:, :3]) @ axes.T
        # a rotation vector turns with the axes: log(A R Aᵀ) = A log(R)
        vector = turn_between(origin[:, 3:], device[:, 3:]) @ axes.T
        angle = np.linalg.norm(vector, axis=1, keepdims=True)
        sine = np.sinc(angle / (2 * np.pi)) / 2 * vector
        turn = np.concatenate([np.cos(angle / 2), sine], axis=1)
        position = target[:, :3] + parameters.scale * moved
        orientation = quaternion_product(turn, target[:, 3:])
        is_held = has_flag(ticks, TickFlag.CLUTCH)[:, None]
        self.handle, self.tool = handle[-1], tool[-1]
        self.origin, self.target = origin[-1], target[-1]
        return (
            np.where(is_held, before[:, :3], position),
            np.where(is_held, before[:, 3:], orientation),
        )


def _poses(ticks: NDArray[np.void], body: str) -> Array:
    return np.concatenate([ticks[f"{body}_position"], ticks[f"{body}_quaternion"]], axis=1)
