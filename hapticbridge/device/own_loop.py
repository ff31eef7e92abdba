"""Loop of a device's own, on its board, that follows the tool which the host shows.

    host, at 1 kHz or slower                      board, every T_b = 0.05 to 0.25 ms
    SHOWN: y, its velocity, surfaces, W    ──▶    moves its tool toward y, as far as a tank pays
                                                  reads h, computes K (h − y), pushes
    the scene's coupling pulls at its tool ◀──    STATE: h, the force, Σ P, D

The link is outside the board's loop, so its delay costs no stiffness: the condition on the device
is b >= K (T_b/2 + 3t/2) + B', with t from reading a position to its force. ``rawhid.md`` has the
board's side of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, runtime_checkable

from hapticbridge.device.base import Device

SURFACES = 3
"""Surfaces near the tool that a loop on a board takes with a pose."""


_NONE = (0.0, 0.0, 0.0)


class LoopState(NamedTuple):
    """State of the device while its own loop follows a shown tool.

    Attributes:
        status, sequence, buttons, time_us, echo: As of ``State``; the echo is that of the newest
            shown tool.
        position, velocity, force: Handle in m and m/s and the force on it in N, in the device's
            frame; of a device that only turns in rad, rad/s and N m.
        passed: Σ P, what the coupling has given to the shown tool, in J.
        tank: D, what the shown tool may still give, in J.
        rotation, angular_velocity, torque: Rotation vector of the handle in rad, its angular
            velocity in rad/s and the torque on it in N m, of a loop that renders rotation; else 0.
    """

    status: int
    sequence: int
    buttons: int
    time_us: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    force: tuple[float, ...]
    passed: float
    tank: float
    echo: int
    rotation: tuple[float, ...] = _NONE
    angular_velocity: tuple[float, ...] = _NONE
    torque: tuple[float, ...] = _NONE

    @property
    def numbers(self) -> tuple[float, ...]:
        """Position, rotation, velocity and angular velocity, as ``State`` has them."""
        return (*self.position, *self.rotation, *self.velocity, *self.angular_velocity)

    @property
    def is_finite(self) -> bool:
        """True if all numbers are finite."""
        return all(map(math.isfinite, (*self.numbers, *self.force, *self.torque, self.tank)))


class LoopReport(NamedTuple):
    """Counters of the device's own loop.

    Attributes:
        sequence: That of the newest state.
        changes: Σ |w_k − w_{k−1}| over periods and axes in N.
        work: W of the newest shown tool in J.
        held_back: Periods in which the tank was too low for the tool's motion.
        ticks: Periods so far.
        missed: Periods that the timer has missed.
        share: Share of the gains in force, 0 to 1.
        temperature: Temperature of the motors in °C; None if unknown.
        temperature_limit: Temperature in °C at which they are switched off; None if unknown.
        tool: Position of the shown tool in m.
    """

    sequence: int
    changes: float
    work: float
    held_back: int
    ticks: int
    missed: int
    share: float
    temperature: float | None
    temperature_limit: float | None
    tool: tuple[float, ...]


class ShownTool(NamedTuple):
    """Tool as it is shown to a loop on the board, in the device's frame.

    Attributes:
        position: Its position in m.
        velocity: Its velocity in m/s; None if it is not known.
        work: W, all that the scene has taken so far, in J.
        surfaces: At most ``SURFACES`` surfaces near it: normal and gap in m.
        is_placed: True if it was put there, and the force begins anew.
        is_enabled: False ends the force.
        rotation, angular_velocity: Its rotation vector in rad, of at most half a turn, and its
            angular velocity in rad/s, for a loop that renders rotation; else not used.
    """

    position: tuple[float, ...]
    velocity: tuple[float, ...] | None = None
    work: float = 0.0
    surfaces: tuple[tuple[tuple[float, ...], float], ...] = ()
    is_placed: bool = False
    is_enabled: bool = True
    rotation: tuple[float, ...] = _NONE
    angular_velocity: tuple[float, ...] = _NONE


class BoardSetting(NamedTuple):
    """Coupling and times that a loop on the board has to render.

    Attributes:
        stiffness: K in N/m, in the device's frame.
        damping: B' in N s/m.
        level: Force level F in N.
        passing: Energy in J that may be under way between two shown tools.
        fade: Time in s in which the force rises and fades, and gains change.
        credit: E in J, what the tool may give beyond what it got.
        rotational_stiffness, rotational_damping, torque_level: K_r in N m/rad, B'_r in N m s/rad
            and the torque level in N m of a loop that renders rotation; else not used.
    """

    stiffness: float
    damping: float
    level: float
    passing: float
    fade: float
    credit: float = 0.0
    rotational_stiffness: float = 0.0
    rotational_damping: float = 0.0
    torque_level: float = 0.0


@runtime_checkable
class LoopDevice(Device, Protocol):
    """Device with a loop of its own, whose data sheet has ``loop_period``.

    It follows ``write`` until the first ``show``, and again from the next ``write`` on.

    Attributes:
        is_posed: True if the loop renders rotation about up to three axes beside lines.
        place: Newest position in m, or angles in rad of a device that only turns.
        loop_state: Its newest state in the loop; None before the first.
        loop_report: Newest counters of its loop; None before the first.
    """

    is_posed: bool
    place: tuple[float, ...]
    loop_state: LoopState | None
    loop_report: LoopReport | None

    def set_loop(self, setting: BoardSetting) -> None:
        """Sets the coupling that the loop renders; it moves there within ``fade``."""

    def show(self, shown: ShownTool) -> int:
        """Shows the tool; without another one the force fades. Returns what its echo will be."""
