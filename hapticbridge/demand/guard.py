"""Guard of a run: limits, parameters for a device, checks before force."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import check_fields, option, unit_of
from hapticbridge.clock import Clock, RealClock, SimulatedClock
from hapticbridge.demand.certificate import assumed_damping
from hapticbridge.demand.loop_setting import IN_TIME, Lag
from hapticbridge.device import AXES, Device, DeviceInfo
from hapticbridge.device.base import JUMP_MARGIN
from hapticbridge.device.registry import DRIVERS
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.handle import stretch_at
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.parameters import (
    DAMPER,
    ENVIRONMENT,
    OFF,
    STOPPED_TWIST,
    GuardParameters,
)
from hapticbridge.kernel.tick_guard import FARTHEST
from hapticbridge.units import format_number

# Limits of the wrench and of the run

MAX_RAMP = 60.0
"""Longest ramp in s. A larger number is taken for a mistake in the unit."""

USUAL_RAMP = 0.5
"""Time in s in which the force rises at the start. A shorter one surprises the hand."""

USUAL_HOLD_FORCE, USUAL_HOLD_TORQUE = 1.0, 0.05
"""Force in N and torque in N m with which the coupling holds the tool along axes that a device
lacks. They keep a tool of 0.1 kg upright against light touches; on a wrench of 0.15 m the torque
adds 0.3 N. A larger value resists motions that the hand cannot make; a smaller one lets the tool
turn at a touch."""

USUAL_STRETCH = 0.2
"""Stretch limit in m of the device's motion; no hand at a desk goes that far from its tool. A
smaller limit stops users who pull on a stuck tool; a larger one misses a lost tool."""

USUAL_ANGLE = STOPPED_TWIST
"""Angle limit in rad. At π the coupling's torque changes sign; 160 degrees leave room for one
tick. Without a limit, or with a larger one, the handle slips before (``kernel.law.slip``)."""

USUAL_ENERGY = 0.04
"""Energy limit in J, given to the device beyond the hand's own work: 10 N over 4 mm, a nudge and no
blow. Detection takes one tick; with the work of 10 N at 1 m/s in it, the sum stays below 0.05 J.
Scenes whose motors push the hand need more."""


def _limit(default: float | None, unit: str, **values: str) -> Any:
    return option(default, unit=unit, least=0.0, is_open=True, is_finite=False, **values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of the wrench and of the run.

    Attributes:
        force: Largest force on the device in N, by default the device's own; a larger force keeps
            its direction. The tool gets no more than it either.
        torque: Largest torque on the device in N m, by default the device's own.
        hold_force: Largest force in N with which the coupling holds the tool along axes that the
            device lacks; beyond it the handle slips. The tool's own weight comes on top.
        hold_torque: Largest torque in N m with which the tool keeps its orientation where the
            device cannot turn it.
        ramp: Time in s over which the force rises at the start, and the handle begins to follow
            the device. By default 0.5 on a real device, and 0 on a simulated one, whose hand a
            sudden force does not surprise.
        stretch: Largest distance between handle and tool divided by the scale, in m; beyond it the
            run is stopped.
        angle: Largest angle between handle and tool in rad, below pi; beyond it the run is stopped.
            With a limit above 2.8, or a device that answers late, the handle slips at 2.5 before.
        energy: Largest energy in J that the hand may get beyond what it put in and what the scene's
            storage gave. The storage is that of all bodies together: what bodies lose beside the
            tool may pass from motors to the hand on top. A wrench that would pass the limit is not
            sent and the run is stopped. inf for scenes whose motors are meant to push the hand.
        reach: Largest distance in m of the device from the middle of its workspace; beyond it the
            device moves without handle and force, and the run goes on. By default the reach of its
            data sheet, else inf. A smaller limit keeps force away from its mechanical stops.

    Raises:
        DeviceError: A value is out of range.
    """

    force: float = _limit(math.inf, "N", flag="force-limit")
    torque: float = _limit(math.inf, "N m", flag="torque-limit")
    hold_force: float = _limit(USUAL_HOLD_FORCE, "N")
    hold_torque: float = _limit(USUAL_HOLD_TORQUE, "N m")
    ramp: float | None = option(None, unit="s", least=0.0, most=MAX_RAMP)
    stretch: float = _limit(USUAL_STRETCH, "m", flag="stretch-limit")
    angle: float = _limit(USUAL_ANGLE, "rad", flag="angle-limit")
    energy: float = _limit(USUAL_ENERGY, "J", flag="energy-limit")
    reach: float | None = _limit(None, "m", flag="reach-limit")

    def __post_init__(self) -> None:
        check_fields(self, DeviceError)
        if math.pi <= self.angle < math.inf:
            raise DeviceError(
                f"angle limit is {self.angle:g} rad; it must be > 0 and < pi, inf for none"
            )

    def reach_of(self, info: DeviceInfo) -> float:
        """Returns the reach in m: the requested one, else the device's own, else inf."""
        own = math.inf if info.reach is None else info.reach
        return own if self.reach is None else self.reach

    def ramp_ticks(self, info: DeviceInfo, period: float) -> int:
        """Returns the length of the ramp in ticks of ``period`` seconds; 0 without a hand."""
        usual = USUAL_RAMP if info.is_real else 0.0
        ramp = usual if self.ramp is None else self.ramp
        return 0 if info.is_prescribed else round(ramp / period)


UNLIMITED = Limits(
    force=1e30,
    torque=1e30,
    ramp=0.0,
    stretch=math.inf,
    angle=math.inf,
    energy=math.inf,
)
"""No limits, for simulations without a device; no finite force comes near."""


DEVICE_LIMITS = Limits()
"""Limits of the device's own."""


def limits_for(info: DeviceInfo, limits: Limits) -> Limits:
    """Returns the requested limits of a run, with the device's own force and torque where none are.

    Raises:
        DeviceError: A requested limit exceeds the device's. Any limit is accepted for a prescribed
            motion, which has no hand.
    """
    chosen = {}
    for name, most in (("force", info.force_limit), ("torque", info.torque_limit)):
        requested, unit = getattr(limits, name), unit_of(Limits, name)
        chosen[name] = most if requested == math.inf else requested
        if chosen[name] > most and not info.is_prescribed:
            raise DeviceError(
                f"{name} limit is {requested:g} {unit}; device '{info.name}' allows at most "
                f"{most:g} {unit}"
            )
    return replace(limits, **chosen)


# Checks before force is enabled

STILL_TIME, PATIENCE = 0.1, 5.0
"""Time in s for which a real device must be still before force is enabled, and time in s after
which waiting for it fails. A hand that reaches for a device stays longer than the first."""

STILL_DISTANCE = 1e-3
"""Largest motion in m within ``STILL_TIME``: 1 cm/s, more than a hand that holds still."""

_NO_FORCE = np.zeros(6)


def wait_until_still(
    device: Device,
    sample: NDArray[np.void],
    period: float,
    clock: Clock,
    is_over: Callable[[], object] = lambda: False,
) -> None:
    """Waits until a device with motors is still; returns at once for any other.

    Zero force is commanded in every period: a Falcon reports its position only in answer to a
    force, and a device with a watchdog must not find its host silent.

    Args:
        device: The started device.
        sample: ``SAMPLE_DTYPE``, one per hand; receives the newest sample.
        period: T in s, at which it is read.
        clock: Clock of the run. The wait happens only in real time; an injected clock also drives
            the device, which must not move before the run.
        is_over: Returns True if the run was stopped meanwhile; the wait then ends.

    Raises:
        DeviceError: The device keeps moving.
    """
    if not device.info.is_real or device.info.is_prescribed or type(clock) is not RealClock:
        return
    clock = RealClock()  # a separate one, because the run's time begins with its first tick
    clock.start(round(1e9 * period))
    anchor = np.zeros_like(sample)
    since = begun = None
    while not is_over():
        clock.wait()
        device.read(sample)
        device.write(_NO_FORCE)
        now = clock.now()
        begun = now if begun is None else begun
        moved = float(np.linalg.norm(sample["position"] - anchor["position"], axis=1).max())
        if since is None or not moved <= STILL_DISTANCE:
            anchor[:], since = sample, now
        elif now - since >= 1e9 * STILL_TIME:
            return
        if now - begun > 1e9 * PATIENCE:
            raise DeviceError(
                f"the device '{device.info.name}' has moved for {PATIENCE:g} s; hold it still, "
                "then start again: force is enabled only at rest"
            )


def refuse_implausible_pose(info: DeviceInfo, sample: NDArray[np.void]) -> None:
    """Refuses a device whose first pose lies outside its workspace.

    Raises:
        DeviceError: The message names the position and the reach.
    """
    if info.is_prescribed:
        return
    position = sample["position"][0]
    reach = FARTHEST if info.reach is None else info.reach
    distance = float(np.linalg.norm(position))
    if not distance <= reach:
        raise DeviceError(
            f"the device '{info.name}' reports {np.round(position, 4).tolist()} m, "
            f"{format_number(distance, 3)} m from the middle of its workspace; it reaches "
            f"{format_number(reach, 3)} m: home or calibrate it, and check the unit of its poses"
        )


def refuse_simulated_time(device: DeviceInfo | str, clock: Clock) -> None:
    """Refuses a simulated clock for a device bound to real time.

    Such a device has motors, or follows a live hand without end and with a delay. A device string
    is checked before the device is opened and homed: hardware that this package drives is bound to
    real time. A device of another package is judged by its data sheet, once it is open.

    Raises:
        DeviceError: The device is bound to real time and the clock is simulated.
    """
    if isinstance(device, str):
        name = device.partition(":")[0]
        is_bound = name in DRIVERS
    else:
        name = device.name
        follows = device.is_prescribed and device.delay != 0.0 and device.duration is None
        is_bound = device.is_real or follows
    if is_bound and isinstance(clock, SimulatedClock):
        raise DeviceError(
            f"the device '{name}' moves in real time, so the loop cannot run faster; leave out "
            "--fast (in code: the SimulatedClock, or is_simulated)"
        )


def refuse_stretched_start(
    state: NDArray[np.void], sample: NDArray[np.void], limits: Limits, grip: str = ""
) -> None:
    """Refuses a start at which the coupling would already exceed the force limit.

    ``grip`` names the hand of several.

    Raises:
        DeviceError: The message names the handle's distance from the grip, and the grip's position.
    """
    pose = state["pose"][0]
    distance = direct(stretch_at, state[0], sample)(state[0], sample)
    force = float(state["coupling"]["stiffness"][0]) * distance
    if force > limits.force:
        hand = f"hand at '{grip}': " if grip else ""
        raise DeviceError(
            f"{hand}the device's absolute pose puts the handle {format_number(1e3 * distance, 3)} "
            f"mm from the grip, {format_number(force, 3)} N at the start; the limit is "
            f"{limits.force:g} N: start nearer to {np.round(pose['tool_position'], 4).tolist()} m "
            "or use relative poses"
        )


CONTROLLERS = {"damper": DAMPER, "environment": ENVIRONMENT, "off": OFF}
"""Passivity controllers by name."""

ENERGY_CREDIT = 0.05
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

IDLE_FORCE, IDLE_TORQUE = 0.1, 0.005
"""Force in N and torque in N m, beyond the tool's weight, to which the coupling relaxes while the
hand lets go. With more, the force that comes back when the hand takes hold would surprise it."""

DELAY_MARGINS = 2.4e-3, 1.3e-3
"""Excess in s over the device's delay that is a finding: without a stated delay, and with one
(``kernel.swing_watch`` has what honest hands reach)."""

SWING_ENERGY, RUNAWAY_SPEED = 8e-3, 0.1
"""Energy in J and speed in m/s above which the watch suspects a late or reversed force
(``kernel.swing_watch`` has the reasons)."""

FASTEST_TURN = 300.0
"""Largest plausible angular velocity in rad/s. A hand turns a stylus at 30; half a turn within a
tick of 1 kHz is 3000."""


def button_mask(button: int | None) -> int:
    """Returns the bit of a button; 0 for None."""
    return 0 if button is None else 1 << button


def _twist_damping(info: DeviceInfo, period: float) -> float:
    """Returns ``GuardParameters.twist_damping`` of a device with a hand."""
    if not info.turns or info.loop_period is not None:
        return math.inf
    is_in_time = Lag.of(info, period) == IN_TIME
    return (info.rotational_damping or 0.0) if is_in_time else 0.0


def guard_parameters_for(
    info: DeviceInfo,
    limits: Limits,
    period: float,
    *,
    needed: tuple[float, float] = (0.0, 0.0),
    scale: float = 1.0,
    controller: str | None = None,
) -> GuardParameters:
    """Returns the guard's parameters for a run without buttons and with relative poses.

    A device with prescribed motion has no hand; it gets limits only.

    Args:
        info: The device. Unknown damping is replaced by ``certificate.assumed_damping``; with
            unknown mass the clip is b alone.
        limits: Limits of the run.
        period: T in s.
        needed: Damping in N s/m and N m s/rad that the coupling needs
            (``loop_setting.LoopSetting.needs``). A device that has it counts with all its
            dissipation, so its energy account stays balanced and the controller idle.
        scale: Handle motion per device motion.
        controller: One of ``CONTROLLERS``. None selects ``damper`` for a device with less damping
            than the coupling needs, else ``environment``. For a device with enough damping only the
            environment is watched: the combined account could trigger when a spring, wound beyond
            the torque limit, unwinds. A device with a loop of its own takes no damping: off.
    """
    common = GuardParameters(
        fade_ticks=max(round(FADE / period), 1),
        stretch=limits.stretch * scale,
        angle=limits.angle,
        reach=limits.reach_of(info),
        motors=sum(1 << i for i, axis in enumerate(AXES) if axis in info.axes),
        hold_force=limits.hold_force,
        hold_torque=limits.hold_torque,
        idle_force=IDLE_FORCE,
        idle_torque=IDLE_TORQUE,
    )
    if info.is_prescribed:
        return common
    linear, angular = assumed_damping(info)
    credit = [
        own if own >= required else UNCERTIFIED_CREDIT * own
        for own, required in zip((linear, angular), needed, strict=True)
    ]
    # a hand that moves about an axis without motor is not paid, so its damping counts for nothing
    credit = [0.0 if sensed else own for own, sensed in zip(credit, info.senses, strict=True)]
    is_borne = linear >= needed[0] and angular >= needed[1]
    if info.loop_period is not None:
        controller = "off"
    own = period if info.rate is None else max(1.0 / info.rate, period)
    return replace(
        common,
        controller=CONTROLLERS[controller or ("environment" if is_borne else "damper")],
        assumed_damping=credit[0],
        assumed_rotational_damping=credit[1],
        max_damping=min(linear, math.inf if info.mass is None else info.mass / period),
        max_rotational_damping=min(
            angular,
            math.inf if info.rotational_inertia is None else info.rotational_inertia / period,
        ),
        energy_credit_limit=ENERGY_CREDIT,
        resolution=info.resolution or 0.0,
        has_hand=True,
        stale_ticks=math.ceil(STALE_PERIODS * own / period),
        speed=JUMP_MARGIN * info.speed_limit if info.speed_limit > 0 else math.inf,
        turn_speed=FASTEST_TURN,
        full_speed=info.speed_limit,
        energy=limits.energy,
        swing_energy=SWING_ENERGY,
        runaway_speed=RUNAWAY_SPEED,
        twist_damping=_twist_damping(info, period),
        stated_delay=0.0 if info.loop_period else info.delay or 0.0,
        delay_margin=DELAY_MARGINS[info.delay is not None],
    )
