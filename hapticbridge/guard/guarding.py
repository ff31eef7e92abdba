"""What the guard does in a run with a given device: the numbers that the kernel takes."""

from __future__ import annotations

import math
from dataclasses import replace

from hapticbridge.certificate import assumed_damping
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import DeviceError, choices
from hapticbridge.guard.limits import Limits
from hapticbridge.kernel.guarding import DAMPER, ENVIRONMENT, MOST_BUTTONS, OFF, Guarding

CONTROLLERS = {"damper": DAMPER, "environment": ENVIRONMENT, "off": OFF}
"""Passivity controllers by name."""

SURPLUS = 0.05
"""In J: what earlier dissipation may pay for. A default coupling holds 0.021 J at 10 N, contacts
behind it about as much; what they give back must not be taken for activity. A larger one lets a
larger kick pass before the controller acts."""

UNCERTIFIED_CREDIT = 0.5
"""Share of its damping that a device is taken to burn where it has less than the coupling needs,
without unit. With all of it a swing is kept from growing and does not end; with half of it the
other half ends it. With none of it the controller would brake free motion."""

STALE_PERIODS = 10
"""Periods of the device without a new sample after which the wrench fades. Fewer make a device that
loses single samples rattle, more hold the force of a pose that is long gone."""

FADE = 0.02
"""In s: how long the wrench takes to fade. Shorter is felt as a blow, longer pushes blindly."""

LONGEST_STALL, STALL_PERIODS = 0.05, 5
"""A loop that stood still for longer than 50 ms, or five periods where they are longer, knows no
more where the hand is: 20 mm away at 0.4 m/s."""

RAMP_ENERGY = 0.01
"""In J: what the coupling may hold while the wrench rises at full pace, 7 N at 2400 N/m; and what a
start may give to the hand at most in the time of its ramp. A quarter of the energy limit, so that
no start alone ends a run; less makes the force of a heavy tool rise slowly."""

JUMP_MARGIN = 2.0
"""How much faster than its data sheet says a device may seem to move: a sample that is read late
and the next one in time show up to two periods of motion in one."""

FASTEST_TURN = 300.0
"""In rad/s. A hand turns a stylus at 30; a half turn within a tick of 1 kHz is 3000."""


def button_mask(button: int | None, what: str) -> int:
    """Returns the bit of a button; 0 for None.

    Args:
        button: Its number, from 0.
        what: What it is for, for the message.

    Raises:
        DeviceError: It is out of range.
    """
    if button is None:
        return 0
    if isinstance(button, bool) or not isinstance(button, int) or not 0 <= button < MOST_BUTTONS:
        raise DeviceError(f"{what} button is {button!r}; it must be 0 to {MOST_BUTTONS - 1}")
    return 1 << button


def guarding_for(
    info: DeviceInfo,
    limits: Limits,
    period: float,
    *,
    needed: tuple[float, float] = (0.0, 0.0),
    scale: float = 1.0,
    controller: str | None = None,
    clutch: int | None = None,
    dead_man: int | None = None,
    is_absolute: bool = False,
) -> Guarding:
    """Returns what the guard does in a run.

    A device whose motion is prescribed feels nothing: for it only limits, slew and buttons count.

    Args:
        info: The device. Where its damping is unknown, the account takes what the default coupling
            takes (``certificate.assumed_damping``); where its mass is, the clip is b alone.
        limits: Of the run.
        period: T in s.
        needed: Damping in N s/m and N m s/rad that the coupling needs
            (``certificate.device_conditions``). A device that has it is taken to burn all that its
            damping can: its account stays balanced, and the controller idle.
        scale: Handle motion per device motion.
        controller: One of ``CONTROLLERS``; None: ``damper`` where the device has less damping than
            the coupling needs, else ``environment``. A device that has it needs none for what it
            does itself, and a spring that was turned far beyond the torque limit gives back more
            than the surplus covers: there the account of both ports would blame an honest run.
        clutch: Button that lets the device move without the handle.
        dead_man: Button that must be held for any force.
        is_absolute: Whether the device's pose is one in the scene; it is then not re-seated before
            the first tick.

    Raises:
        DeviceError: The controller's name or a button is not valid.
    """
    if controller is not None and controller not in CONTROLLERS:
        raise DeviceError(f"unknown controller {controller!r}; there are {choices(CONTROLLERS)}")
    buttons = button_mask(clutch, "clutch"), button_mask(dead_man, "dead-man")
    if buttons[0] and buttons[0] == buttons[1]:
        raise DeviceError(f"clutch and dead-man are both button {clutch}; they exclude each other")
    force_rise, torque_rise = limits.rises(period)
    common = Guarding(
        force_rise=force_rise,
        torque_rise=torque_rise,
        fade_ticks=max(round(FADE / period), 1),
        clutch=buttons[0],
        dead_man=buttons[1],
        stretch=limits.stretch * scale,
        angle=limits.angle,
        reach=limits.reach_of(info),
    )
    if info.is_prescribed:
        return common
    linear, angular = assumed_damping(info)
    credit = [
        own if own >= asked else UNCERTIFIED_CREDIT * own
        for own, asked in zip((linear, angular), needed, strict=True)
    ]
    is_borne = linear >= needed[0] and angular >= needed[1]
    own = period if info.rate is None else max(1.0 / info.rate, period)
    return replace(
        common,
        controller=CONTROLLERS[controller or ("environment" if is_borne else "damper")],
        credit=credit[0],
        rotational_credit=credit[1],
        most_damping=min(linear, math.inf if info.mass is None else info.mass / period),
        most_rotational_damping=min(
            angular,
            math.inf if info.rotational_inertia is None else info.rotational_inertia / period,
        ),
        surplus=SURPLUS,
        stale_ticks=math.ceil(STALE_PERIODS * own / period),
        longest_stall=max(LONGEST_STALL, STALL_PERIODS * period),
        reseats=not is_absolute,
        speed=JUMP_MARGIN * info.speed_limit if info.speed_limit > 0 else math.inf,
        turn_speed=FASTEST_TURN,
        energy=limits.energy,
        ramp_energy=RAMP_ENERGY,
    )
