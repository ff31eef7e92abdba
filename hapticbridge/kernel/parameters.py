"""Parameters of a run: all numbers besides scene and device motion that its results depend on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.arguments import Rule, check_fields, checked_value, option, rule, shown
from hapticbridge.coupling import Coupling
from hapticbridge.dataclass_json import from_json, to_json
from hapticbridge.errors import HapticBridgeError, choices
from hapticbridge.kernel.codes import Grip, Scheme, SchemeProperties
from hapticbridge.kernel.pose import IDENTITY_POSE

OFF, DAMPER, ENVIRONMENT = 0, 1, 3
"""Passivity controllers, numbered as in recordings: none; damping against the motion with a tank
behind it, for the energy debt of both ports; damping for the debt of the environment's port alone.
The number 2 belonged to a controller that was removed."""

MAX_BUTTONS = 32
"""Largest count of buttons in a mask. No handle has more."""

ALL_MOTORS = 63
"""Mask of six axes with a motor."""


def _threshold(unit: str) -> Any:
    return option(math.inf, unit=unit, least=0.0, is_open=True, is_finite=False)


def _mask(default: int = 0) -> Any:
    return option(default, least=0, most=2**MAX_BUTTONS - 1)


SHORTEST_DECAY, LONGEST_DECAY = 1e-4, 1.0
"""Time constants in s that a pulse may have. A shorter one ends within a tick of any loop, a longer
one is no pulse but a push."""

FASTEST = 10.0
"""Largest speed in m/s of a device whose guard has no limit of speed. No arm is faster; a larger
value makes pulses weaker where no damping is spare."""

SENT = 64
"""Ticks of which what was sent is kept; a device is at most 50 samples late."""

LARGEST_TWIST, STOPPED_TWIST = 2.5, 2.8
"""Twist in rad from which the handle slips that a hand holds behind a late device, or in a run that
is not stopped at the second. They leave 0.64 and 0.34 rad for the turns of one tick to half a turn,
where the torque reverses. Larger ones leave less. A hand that turns farther slips as if it had not
come across."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardParameters:
    """Limits and thresholds of the guard within a tick; all are off by default.

    The names are those of the metadata ``guard`` of a recording.

    Attributes:
        controller: ``OFF``, ``DAMPER`` or ``ENVIRONMENT``.
        assumed_damping: Damping in N s/m that the passivity observer assumes the device to have.
        assumed_rotational_damping: Damping in N m s/rad that it assumes in rotation.
        max_damping: Largest damping in N s/m that the controller adds on an axis.
        max_rotational_damping: Largest damping in N m s/rad that it adds on an axis.
        energy_credit_limit: Largest energy in J that earlier dissipation may pay for.
        resolution: Step in m of the positions that the device reports; 0 if exact or unknown.
        stale_ticks: Ticks in a row without a new sample after which the wrench fades; 0 for never.
        fade_ticks: Ticks in which the wrench fades to zero.
        has_hand: True if a hand holds the device. The handle then does not follow what the device
            did before a start, when no force was on it, and slips for late samples.
        clutch: Mask of buttons; while one is held, the device moves without the handle.
        dead_man: Mask of buttons of which one must be held; 0 for none.
        speed: Speed of the device in m/s above which the run is stopped.
        turn_speed: Angular speed of the device in rad/s above which the run is stopped.
        stretch: Length of the coupling in m above which the run is stopped.
        angle: Angle between handle and tool in rad above which the run is stopped.
        energy: Energy in J given to the device beyond the hand's above which the run is stopped.
        reach: Distance in m from the origin of the device's frame beyond which the device moves
            without the handle and without force.
        full_speed: Largest speed in m/s in the data sheet, at which the energy limit still holds;
            0 if unknown.
        motors: Mask of the device's axes with a motor, in the order x, y, z, rx, ry, rz.
        hold_force: Largest force in N along axes without motor; beyond it the handle slips.
        hold_torque: Largest torque in N m about axes without motor.
        idle_force: Force in N to which the coupling relaxes while the hand is let go.
        idle_torque: Torque in N m to which it relaxes then.
        swing_energy: Energy in J that a late force would give within 0.3 s, at a limit of 10 N or
            0.5 N m, above which the watch suspects the device (``kernel.swing_watch``).
        runaway_speed: Speed in m/s gained against a limit of 10 N above which it does.
        twist_damping: Damping in N m s/rad that pays for a torque across the motion
            (``kernel.law.torque_across``); 0 if the device's is unknown or it answers late, inf if
            no torque acts on a hand.
        stated_delay: Delay in s that the device states; 0 without a statement.
        delay_margin: Time in s by which a delay must exceed the stated one to be a finding.

    Raises:
        HapticBridgeError: A value is out of range.
    """

    controller: int = option(OFF, least=0, most=3)
    assumed_damping: float = option(0.0, unit="N s/m", least=0.0)
    assumed_rotational_damping: float = option(0.0, unit="N m s/rad", least=0.0)
    max_damping: float = option(0.0, unit="N s/m", least=0.0)
    max_rotational_damping: float = option(0.0, unit="N m s/rad", least=0.0)
    energy_credit_limit: float = option(0.0, unit="J", least=0.0)
    resolution: float = option(0.0, unit="m", least=0.0)
    stale_ticks: int = _mask()
    fade_ticks: int = option(1, least=1, most=2**MAX_BUTTONS - 1)
    has_hand: bool = False
    clutch: int = _mask()
    dead_man: int = _mask()
    speed: float = _threshold("m/s")
    turn_speed: float = _threshold("rad/s")
    stretch: float = _threshold("m")
    angle: float = _threshold("rad")
    energy: float = _threshold("J")
    reach: float = _threshold("m")
    full_speed: float = option(0.0, unit="m/s", least=0.0)
    motors: int = _mask(ALL_MOTORS)
    hold_force: float = _threshold("N")
    hold_torque: float = _threshold("N m")
    idle_force: float = _threshold("N")
    idle_torque: float = _threshold("N m")
    swing_energy: float = _threshold("J")
    runaway_speed: float = _threshold("m/s")
    twist_damping: float = option(math.inf, unit="N m s/rad", least=0.0, is_finite=False)
    stated_delay: float = option(0.0, unit="s", least=0.0)
    delay_margin: float = _threshold("s")

    def __post_init__(self) -> None:
        check_fields(self, of="guard: ")
        if self.controller not in (OFF, DAMPER, ENVIRONMENT):
            raise HapticBridgeError(f"controller is {self.controller!r}; it must be 0, 1 or 3")

    def to_json(self) -> str:
        """Returns the text for a recording's metadata."""
        return to_json(self)

    @classmethod
    def from_json(cls, text: str) -> GuardParameters:
        """Reads a text that ``to_json`` wrote.

        Raises:
            RecordingError: The text does not name a guard, or a value is out of range.
        """
        return from_json(cls, text, "metadata 'guard'")


def _words(name: str) -> str:
    return name.replace("_", " ")


UNGUARDED = GuardParameters()
"""Guard parameters of runs without a device."""


MAX_SUBSTEPS = 100
"""Largest number of MuJoCo steps per tick. More do not fit into the period of a haptic loop."""


SUBSTEPS = rule(least=1, most=MAX_SUBSTEPS)
"""Valid numbers of MuJoCo steps per tick, as the metadata of a field."""


ROUNDING = 1e-9
"""Excess over a whole number of ticks that counts as rounding, in ticks."""


def whole_ticks(delay: float, period: float) -> int:
    """Returns the whole ticks in which a delay in s ends; ticks of ``period`` in s."""
    return max(0, math.ceil(delay / period - ROUNDING))


def checked_substeps(substeps: int, error: type[HapticBridgeError] = HapticBridgeError) -> int:
    """Returns a number of MuJoCo steps per tick, 1 to ``MAX_SUBSTEPS``.

    Raises:
        HapticBridgeError: It is out of range; the class is ``error``.
    """
    return int(checked_value("substeps", substeps, (int,), SUBSTEPS["rule"], error))


def refuse_substeps(scheme: int, substeps: int) -> None:
    """Refuses several MuJoCo steps per tick for a scheme that allows one.

    Raises:
        HapticBridgeError: The message gives the reason.
    """
    reason = Scheme(scheme).properties.one_substep
    if substeps != 1 and reason:
        raise HapticBridgeError(f"substeps is {substeps!r}; {reason}, so it must be 1")


SLOW_SCHEMES = (Scheme.IMPLICIT, Scheme.MIDPOINT)
"""Schemes of a scene that may be slower than the loop: MuJoCo solves the coupling in its step."""

MAX_SCENE_TICKS = 1000
"""Largest number of ticks per step of a slower scene. At 1 kHz that is one step per second; a
slower one shows nothing that a hand could meet."""


def refuse_scene_ticks(scheme: int, ticks: int) -> None:
    """Refuses a number of ticks per step of a slower scene, or a scheme that cannot have one.

    Raises:
        HapticBridgeError: The number is neither 0 nor 2 to ``MAX_SCENE_TICKS``, or the scheme is
            not solved within MuJoCo's step.
    """
    if ticks == 0:
        return
    if not isinstance(ticks, int) or not 2 <= ticks <= MAX_SCENE_TICKS:
        raise HapticBridgeError(
            f"the scene steps once in {ticks!r} ticks; it must be 2 to {MAX_SCENE_TICKS}, or in "
            "every one"
        )
    if scheme not in SLOW_SCHEMES:
        names = choices(each.name for each in SLOW_SCHEMES)
        raise HapticBridgeError(f"a scene slower than the loop needs one of the schemes {names}")


SAME_AXES = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
"""Row-major rotation from the device's axes to those of the scene if they are equal."""

TANK_STRETCH = 1e-3
"""Stretch c in m of the coupling whose energy is the cap of the tank of rigid contacts. Dissipation
of a long time then pays for no more than the hand stores in the coupling within a millimetre. A
larger value frees a jammed tool sooner, and lets it be pushed out harder."""


def _positive(unit: str) -> dict[str, Rule]:
    return rule(unit=unit, least=0.0, is_open=True)


class StepTimes:
    """Times of a scene that is stepped behind a loop, for a class with these fields.

    Attributes:
        period: T in s.
        substeps: MuJoCo steps per tick, or between two results of a slower scene.
        scene_ticks: Ticks between two results of a slower scene; 0 if it steps in every tick.
        credit: Energy in J that another program's scene may give to the hand; 0 for a scene of the
            bridge.
    """

    __slots__ = ()
    period: float
    substeps: int
    scene_ticks: int
    credit: float = 0.0

    @property
    def scene_period(self) -> float:
        """Time in s between two results of the scene."""
        return max(self.scene_ticks, 1) * self.period

    @property
    def timestep(self) -> float:
        """MuJoCo's h in s; T for a scene of another program, to which the law is the coupling."""
        return (self.period if self.credit else self.scene_period) / self.substeps


SEVERAL_HANDS = "several hands hold the scene; pulses need one hand"
"""Reason to refuse pulses."""


def no_pulses(share: float, reason: str) -> HapticBridgeError:
    """Returns the refusal of pulses with a share of the blows' energy, for a reason."""
    return HapticBridgeError(f"impact-pulses is {share:g}, but {reason}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunParameters(StepTimes):
    """All numbers besides scene and device motion that the results of a run depend on.

    Attributes:
        grip: Name of the site on the tool.
        period: T in s.
        substeps: MuJoCo steps per tick, >= 1.
        coupling: K and B' of the law (``methods.Method.law_coupling``), not the effective
            coupling.
        scale: Handle motion per device motion, without unit.
        force_scale: Force on the device per force on the tool, without unit. Power is equal on both
            sides if it equals ``scale``; torques are scaled by force_scale / scale.
        axes: Row-major rotation from the device's frame to the scene's.
        force_limit: Largest force norm on the device in N.
        torque_limit: Largest torque norm on the device in N m.
        ramp_ticks: Ticks over which the wrench on the device rises to its full value.
        device_origin: Device pose (x, y, z, qw, qx, qy, qz) that maps to ``handle_origin``.
        handle_origin: Handle pose of the same form, in the scene.
        device_start: Device pose of the same form before the first tick.
        scheme: Path of the wrench to the tool.
        effective: Effective coupling as measured, for a weld; None if it follows from ``coupling``.
            The device condition uses it.
        contact_stiffness: K_c in N/m per contact of a tool without mass; 0 for other methods.
        device_damping: b of the device in N s/m; None for a prescribed motion, or if a damping is
            unknown. Its dissipation is compared with the energy delivered.
        device_rotational_damping: Rotational damping in N m s/rad; None without rotation, or if
            ``device_damping`` is.
        guarding: Limits and thresholds of the guard.
        is_rigid: True if contacts are rigid (``kernel.rigid_contact``), False for those of the
            scene.
        scene_ticks: Ticks per ``substeps`` of a scene that is slower than the loop
            (``kernel.shown_tool``); 0 for a scene that steps in every tick.
        credit: Energy in J that a scene of another program may give to the hand beyond what the
            hand put in; 0 for a scene of the bridge.
        is_beside: True for a slower scene's own loop (``of_scene``).
        loop_period: T_b in s of the device's own loop, which renders the coupling to the tool that
            it is shown (``device.own_loop``); 0 for a device that applies the bridge's wrench.
        impact_pulses: Share of a blow's energy that may pay for a pulse on the device, 0 to 1
            (``kernel.impact_pulse``).
        pulse_frequency: f in Hz of the pulses.
        pulse_decay: τ in s of the pulses.
        pulse_damping: b_s in N s/m, the damping of the device on which pulses count, beyond what
            the coupling needs.
        pulse_lag: Time in s within which a pulse may act beyond the stated delay: a tick of a real
            device, whose force is computed while the tick passes; 0 of a simulated one.

    Raises:
        HapticBridgeError: A value is out of range.
    """

    grip: str
    period: float = field(metadata=_positive("s"))
    substeps: int = field(metadata=SUBSTEPS)
    coupling: Coupling
    scale: float = field(default=1.0, metadata=_positive(""))
    force_scale: float = field(default=1.0, metadata=_positive(""))
    axes: tuple[float, ...] = SAME_AXES
    force_limit: float = field(metadata=_positive("N"))
    torque_limit: float = field(metadata=_positive("N m"))
    ramp_ticks: int = field(metadata=rule(least=0))
    device_origin: tuple[float, ...]
    handle_origin: tuple[float, ...]
    device_start: tuple[float, ...]
    scheme: int = Scheme.IMPLICIT
    effective: Coupling | None = None
    contact_stiffness: float = option(0.0, unit="N/m", least=0.0)
    device_damping: float | None = None
    device_rotational_damping: float | None = None
    guarding: GuardParameters = UNGUARDED
    is_rigid: bool = False
    scene_ticks: int = 0
    credit: float = option(0.0, unit="J", least=0.0)
    is_beside: bool = False
    loop_period: float = option(0.0, unit="s", least=0.0)
    impact_pulses: float = option(0.0, least=0.0, most=1.0)
    pulse_frequency: float = option(0.0, unit="Hz", least=0.0)
    pulse_decay: float = option(0.01, unit="s", least=SHORTEST_DECAY, most=LONGEST_DECAY)
    pulse_damping: float = option(0.0, unit="N s/m", least=0.0)
    pulse_lag: float = option(0.0, unit="s", least=0.0)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.scheme not in list(Scheme):
            raise HapticBridgeError(
                f"scheme is {self.scheme!r}; it must be 0 to {max(Scheme).value}"
            )
        if (self.contact_stiffness > 0) == self.properties.has_tool_mass:
            raise HapticBridgeError(
                f"contact stiffness is {self.contact_stiffness!r} N/m; it must be > 0 for a tool "
                "without mass, and 0 for another"
            )
        refuse_substeps(self.scheme, self.substeps)
        refuse_scene_ticks(self.scheme, self.scene_ticks)
        if self.credit > 0.0 and not self.scene_ticks:
            raise HapticBridgeError(
                f"credit is {self.credit!r} J for a scene that steps in every tick; it must be 0"
            )
        if self.impact_pulses > 0.0:
            self._check_pulses()
        for name in ("device_origin", "handle_origin", "device_start"):
            pose = getattr(self, name)
            if len(pose) != 7 or not all(math.isfinite(value) for value in pose):
                raise HapticBridgeError(f"{_words(name)} is {pose!r}; it must be 7 finite numbers")
            if abs(math.hypot(*pose[3:]) - 1) > 1e-9:
                raise HapticBridgeError(
                    f"{_words(name)} is {pose!r}; its quaternion must have norm 1"
                )
        rotation = np.asarray(self.axes, dtype=np.float64)
        if rotation.shape != (9,) or not (
            np.allclose(rotation.reshape(3, 3) @ rotation.reshape(3, 3).T, np.eye(3), atol=1e-12)
            and np.linalg.det(rotation.reshape(3, 3)) > 0
        ):
            raise _no_rotation(self.axes)

    def _check_pulses(self) -> None:
        for is_so, reason in (
            (not self.is_rigid, "contacts are the scene's own; pulses need rigid ones"),
            (not self.has_law, "the method has none; pulses need a coupling law"),
            (self.is_joint, "the hand holds a joint; pulses need a site or a body"),
            (self.scene_ticks, "the scene steps in some ticks alone; pulses need all"),
            (self.is_apart, "the device has a loop of its own; pulses need the bridge's"),
        ):
            if is_so:
                raise no_pulses(self.impact_pulses, reason)

    @property
    def is_joint(self) -> bool:
        """True if the hand holds a joint, which has no handle in the scene."""
        return Grip.from_text(self.grip).is_joint

    @property
    def device_delay(self) -> float:
        """Delay t_d in s that the device states, in whole ticks, rounded up."""
        return whole_ticks(self.guarding.stated_delay, self.period) * self.period

    @property
    def pulse_speed(self) -> float:
        """Largest speed in m/s of the device on which pulses count."""
        return min(self.guarding.speed, FASTEST)

    @property
    def pulse_ticks(self) -> int:
        """Ticks d after its own in which a pulse may still act, at most as many as are kept."""
        return min(whole_ticks(self.guarding.stated_delay + self.pulse_lag, self.period), SENT - 2)

    @property
    def energy_ratio(self) -> float:
        """Energy at the hand per energy in the scene, q = force_scale / scale."""
        return self.force_scale / self.scale

    @property
    def tank_at_start(self) -> float:
        """Energy in J in front of another program's scene; unlike ``credit``, at the tool."""
        return self.credit * self.scale / self.force_scale

    @property
    def levels_on_tool(self) -> tuple[float, float]:
        """Force level F in N and F_r in N m on the tool, from the limits on the device."""
        return (
            self.force_limit / self.force_scale,
            self.torque_limit * self.scale / self.force_scale,
        )

    @property
    def tank_cap(self) -> float:
        """Largest energy in J that may pay for the depenetration of rigid contacts, ½ K c²."""
        return 0.5 * self.coupling.stiffness * TANK_STRETCH**2

    @property
    def of_scene(self) -> RunParameters:
        """Parameters of a slower scene's own loop; its device is the handle."""
        force_limit, torque_limit = self.levels_on_tool
        return replace(
            self,
            period=self.scene_period,
            scene_ticks=0,
            credit=0.0,
            is_beside=True,
            scale=1.0,
            force_scale=1.0,
            axes=SAME_AXES,
            force_limit=force_limit,
            torque_limit=torque_limit,
            ramp_ticks=0,
            device_origin=IDENTITY_POSE,
            handle_origin=IDENTITY_POSE,
            device_start=IDENTITY_POSE,
            device_damping=None,
            device_rotational_damping=None,
            guarding=UNGUARDED,
        )

    @property
    def properties(self) -> SchemeProperties:
        """Properties of the scheme."""
        return Scheme(self.scheme).properties

    @property
    def holds_wrench(self) -> bool:
        """True if the wrench is applied as a force during the next tick."""
        return self.properties.holds_wrench

    @property
    def law_evaluations(self) -> int:
        """Evaluations of the tool's wrench per tick."""
        return 1 if self.scene_ticks else self.properties.law_evaluations(self.substeps)

    @property
    def is_apart(self) -> bool:
        """True if a loop of the device's own gives the wrench on it."""
        return self.loop_period > 0.0

    @property
    def has_law(self) -> bool:
        """True if the coupling law gives the wrench."""
        return self.properties.has_law


_ROUNDING = 4 * np.finfo(np.float64).eps
"""Largest deviation of the polar factor from a rotation by rounding; no unit."""


def rotation_numbers(matrix: ArrayLike) -> tuple[float, ...]:
    """Returns the 9 numbers, row by row, of the rotation nearest to a matrix.

    Axes are written with few digits (0.707107). The polar factor makes them a rotation to the last
    digit, so that positions, orientations and forces turn by equal angles.

    Args:
        matrix: 3 × 3, or 9 numbers; orthogonal to 1e-5 and right-handed.

    Raises:
        HapticBridgeError: The matrix is no rotation.
    """
    try:
        numbers = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.size == 9 and np.all(np.isfinite(numbers)):
        square = numbers.reshape(3, 3)
        off = np.abs(square @ square.T - np.eye(3)).max()
        if off < 1e-5 and np.linalg.det(square) > 0:
            if off < _ROUNDING:  # a second time would change the last digits of a recorded one
                return tuple(square.ravel().tolist())
            left, _, right = np.linalg.svd(square)
            return tuple((left @ right).ravel().tolist())
    raise _no_rotation(matrix)


def _no_rotation(axes: object) -> HapticBridgeError:
    return HapticBridgeError(
        f"axes is {shown(axes)}; it must be the 9 numbers of a right-handed rotation "
        "matrix, row by row"
    )
