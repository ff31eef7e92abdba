"""Guard parameters of a run on a given device."""

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
"""Energy credit in J that earlier dissipation may provide. A default coupling stores 0.021 J at 10
N and contacts behind it about as much; their release must not count as activity. A larger credit
lets a larger kick pass before the controller acts."""

UNCERTIFIED_CREDIT = 0.5
"""Share of its damping that a device is assumed to dissipate with, if that is less than the
coupling needs; without unit. With all of it a swing stops growing but does not end; with half, the
other half ends it. With none the controller would brake free motion."""

STALE_PERIODS = 10
"""Number of the device's periods without a new sample after which the wrench fades. A smaller
number makes a device that loses single samples rattle; a larger one holds the force of an old pose
longer."""

FADE = 0.02
"""Duration in s of the fading of the wrench. A shorter one feels like a blow, a longer one pushes
without knowledge of the hand."""

LONGEST_STALL, STALL_PERIODS = 0.05, 5
"""Longest stall of the loop: 50 ms, or five periods if these are longer. Afterwards the hand's
position is unknown: at 0.4 m/s it has moved 20 mm."""

RAMP_ENERGY = 0.01
"""Energy in J that the coupling may store while the wrench rises at full pace: 7 N at 2400 N/m. A
start may give as much to the hand during its ramp. It is a quarter of the energy limit, so that a
start alone never ends a run. A smaller value slows the rise with a heavy tool."""

JUMP_MARGIN = 2.0
"""Factor on the data sheet's speed limit, without unit. A late sample followed by a punctual one
shows up to two periods of motion in one."""

FASTEST_TURN = 300.0
"""Largest plausible angular velocity in rad/s. A hand turns a stylus at 30; half a turn within a
tick of 1 kHz is 3000."""


def button_mask(button: int | None, what: str) -> int:
    """Returns the bit of a button; 0 for None.

    ``what`` names the button's purpose for the message.

    Raises:
        DeviceError: The number is out of range.
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
    """Returns the guard's parameters for a run.

    A device with prescribed motion has no hand; it gets limits, slew and buttons only.

    Args:
        info: The device. Unknown damping is replaced by ``certificate.assumed_damping``; with
            unknown mass the clip is b alone.
        limits: Limits of the run.
        period: T in s.
        needed: Damping in N s/m and N m s/rad that the coupling needs
            (``certificate.device_conditions``). A device that has it counts with all its
            dissipation, so its energy account stays balanced and the controller idle.
        scale: Handle motion per device motion.
        controller: One of ``CONTROLLERS``. None selects ``damper`` for a device with less damping
            than the coupling needs, else ``environment``. With enough damping the device port needs
            no controller. A spring turned far beyond the torque limit returns more than the credit
            covers, and an account of both ports would then blame a passive run.
        clutch: Button that lets the device move without the handle.
        dead_man: Button that must be held for any force.
        is_absolute: True if the device's pose is a pose in the scene; it is then not re-anchored
            before the first tick.

    Raises:
        DeviceError: The controller's name or a button is not valid.
    """
    if controller is not None and controller not in CONTROLLERS:
        raise DeviceError(f"unknown controller {controller!r}; choices: {choices(CONTROLLERS)}")
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
        own if own >= required else UNCERTIFIED_CREDIT * own
        for own, required in zip((linear, angular), needed, strict=True)
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
