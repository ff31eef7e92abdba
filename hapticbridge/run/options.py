"""Options of a bridge, and the setup of a run that they resolve to.

``BridgeOptions`` holds the user's choices. ``RunSetup.resolve`` completes them for a scene and a
device, and refuses what they cannot do. The live loop and the studies share
``RunSetup.parameters``, so a method on a device is computed equally in both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, cast

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.arguments import check_fields, is_number, option, shown
from hapticbridge.clock import LOWEST_RATE, RATE, Clock, RealClock, period_of
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.guard import (
    DEVICE_LIMITS,
    UNLIMITED,
    Limits,
    button_mask,
    guard_parameters_for,
    limits_for,
    refuse_simulated_time,
)
from hapticbridge.demand.loop_setting import LoopSetting, assumed_lag, pulling_loop
from hapticbridge.demand.methods import (
    SCENE,
    Contact,
    Method,
    default_method,
    method_named,
    require_hazard_consent,
    resolve_contact_stiffness,
)
from hapticbridge.demand.pulse import PULSES, USUAL_PULSE, Tap, pulse_of
from hapticbridge.device import AXES, Device, DeviceInfo, device_for
from hapticbridge.device.base import calling_on_error, device_fault
from hapticbridge.device.own_loop import LoopDevice
from hapticbridge.device.simulated.dynamics import DEFAULT_HAND
from hapticbridge.errors import (
    DeviceError,
    HapticBridgeError,
    RecordingError,
    SceneError,
)
from hapticbridge.kernel.codes import moving_geoms
from hapticbridge.kernel.parameters import (
    MAX_BUTTONS,
    MAX_SCENE_TICKS,
    ROUNDING,
    SAME_AXES,
    SEVERAL_HANDS,
    SUBSTEPS,
    UNGUARDED,
    GuardParameters,
    RunParameters,
    StepTimes,
    no_pulses,
    refuse_substeps,
    rotation_numbers,
)
from hapticbridge.kernel.pose import IDENTITY_POSE
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.shown_tool import tool_geoms
from hapticbridge.realtime import busy_step_time, scene_ticks_for, wants_real_time
from hapticbridge.run.commands import CouplingLimits
from hapticbridge.scene import Scene, custom_text
from hapticbridge.scene.contacts import meeting_pairs
from hapticbridge.scene.physics import geom_inertia, site_inertia
from hapticbridge.scene.rehearsal import (
    HOLDING_STEPS,
    TIPPED,
    along,
    holding_wrench,
    start_handle,
    static_load,
    toppling_force,
    wrench_sizes,
)
from hapticbridge.theory.transfer import MAX_DELAY
from hapticbridge.units import format_count, format_number, format_si

OWN_PULL = 0.9
"""Share of a pull that is left at a tool whose weight is carried, above which the pull is not of
the tool; no unit. A body that falls on it leaves about all; with a smaller value a tool whose own
weight gives a part of the pull would not be carried."""

# Options of a user


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Map from the device's frame to the scene's.

        h = h_0 + scale · A (p − p_0),   R_h = A R_p R_p0ᵀ Aᵀ R_h0,   w = −force_scale · Aᵀ f

    p is the device's position in m, h the handle's, f the force on the tool and w the force on the
    device in N. p_0 is the device's start and h_0 the grip's; with absolute poses both are zero.

    Attributes:
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool. By default equal to the scale, which
            keeps power equal on both sides.
        axes: Rotation from the device's axes to the scene's: 9 numbers, row by row.
        absolute: Take the device's poses as poses in the scene instead of relative to its start.

    Raises:
        HapticBridgeError: A scale is out of range, or the axes are not a right-handed rotation.
    """

    scale: float = option(1.0, least=0.0, is_open=True)
    force_scale: float | None = option(None, least=0.0, is_open=True)
    axes: Annotated[ArrayLike, tuple[float, ...]] = SAME_AXES
    absolute: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "axes", rotation_numbers(self.axes))

    @property
    def scales(self) -> tuple[float, float]:
        """Scales of motion and of force."""
        return self.scale, self.scale if self.force_scale is None else self.force_scale

    @property
    def energy_ratio(self) -> float:
        """Energy at the device per energy in the scene, q = force_scale / scale."""
        scale, force_scale = self.scales
        return force_scale / scale

    @property
    def rotation(self) -> tuple[float, ...]:
        """The nine numbers of the rotation nearest to the given axes, row by row."""
        return cast(tuple[float, ...], self.axes)


SAME_FRAME = Workspace()
"""Workspace with equal axes and scales; the device starts at the grip."""


USUAL_RATE = 1000.0
"""Ticks per second if neither the user nor a slower device names a rate. Walls of a lower rate are
softer; a higher one leaves less time for the scene."""


AUTO: Literal["auto"] = "auto"
"""Rate of the scene that is chosen by what its step takes."""


def _button() -> Any:
    return option(None, least=0, most=MAX_BUTTONS - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeOptions:
    """Options of a bridge; the defaults suit a device with known damping.

    Attributes:
        rate: Ticks per second. By default 1000, or as many as a slower device has new samples, if
            its delay is known too; at that rate it bears a stiffer coupling. With substeps or a
            scene rate of your own it is 1000.
        substeps: MuJoCo steps per tick; with more than one, the mean of their wrenches is sent, and
            the device needs another damping. For a slower scene they are the steps between two of
            its results. By default one; 'hapticbridge run' takes as many as keep the file's own
            time step if it is shorter and the scene alone would move noticeably differently.
        scene_rate: Results of the scene per second. Below the rate the scene steps in a thread of
            its own, and the tool is shown between its results, passively; its period is then the
            nearest one of whole ticks. 'auto' steps it in every tick if it can keep the rate on a
            real clock, measured at its start, else as often as it can.
        method: Rendering method: 'lossless', the default; 'implicit', the default with substeps;
            'compensated'; or one that exists to be compared, such as 'explicit', 'weld' or
            'direct' (a tool without mass). The run says what it does; an unknown name lists all.
        contact: Contacts. 'rigid', the default: strictly passive, sharp, with Coulomb friction in
            an elliptic cone. 'scene': MuJoCo's contacts with the settings of the MJCF, as methods
            for comparison have them.
        contact_stiffness: Stiffness per contact of method 'direct'; by default that of the
            coupling.
        i_know: Accept a method that may kick on a real device. A method with a guarantee never
            needs it.
        workspace: Map from the device's frame to the scene's.
        limits: Limits of the wrench and of the run.
        controller: Passivity controller, damping added against energy that came from nowhere.
            'damper' acts when the hand got more than it put in, 'environment' when the scene has
            created more than the coupling's slack, 'off' never. By default 'environment', or
            'damper' if the device condition fails.
        clutch: Button of the device, from 0. While it is held the device moves without handle and
            force.
        dead_man: Button of the device, from 0, that must be held for any force.
        mark: Button of the device, from 0. Each press writes an event 'mark' into the recording;
            'hapticbridge export --from S --to S' cuts a recording.
        probe: Push a device with small forces along each axis, for about a second before the run,
            and refuse it if it moves another way: a reversed axis pulls the hand into walls. The
            delay that is found counts if it is longer than the stated one. By default done for a
            real device.
        tool_weight: Weight of the tool in the hand, unless the device cannot hold it. With
            --no-tool-weight, or False, the bridge carries it.
        impact_pulses: Share of the energy that a blow of the tool burns, 0 to 1, which may pay for
            a short pulse of force on the device: a tap then feels crisp. It needs rigid contact.
            Damping of the device beyond what the coupling needs makes it stronger.
        pulse: Pulse of a blow, with --impact-pulses: 'steel', 'wood' or 'rubber', or HZ,MS for its
            frequency in Hz and the time in ms in which it falls to 37 %. 'scene', the default,
            takes the one that the scene's custom text 'pulse' names, or 'wood'.
        realtime: Request real-time priority and locked memory for the loop, and print what the
            system refuses (see 'hapticbridge doctor'). By default requested for a real device.
        pipelined: Compute ahead, after the wrench was sent, what needs no new sample. The numbers
            are equal to the bit, the wrench is sent sooner, and the whole tick takes 5 % longer.
            Between two ticks the scene's data then hold the contacts of the new positions, without
            forces. By default done on a real clock.
        live: Show the state of the run on standard error, from the recorder's process.

    Raises:
        HapticBridgeError: A value is out of range; the message names the valid ones.
    """

    rate: float | None = option(None, unit=RATE.unit, least=RATE.least, most=RATE.most)
    substeps: int | None = field(default=None, metadata=SUBSTEPS)
    scene_rate: float | Literal["auto"] = option(AUTO, unit="Hz")
    method: str | None = None
    contact: Contact | None = None
    contact_stiffness: float | None = option(None, unit="N/m")
    i_know: bool = False
    workspace: Workspace = SAME_FRAME
    limits: Limits = DEVICE_LIMITS
    controller: Literal["damper", "environment", "off"] | None = None
    clutch: int | None = _button()
    dead_man: int | None = _button()
    mark: int | None = _button()
    probe: bool | None = None
    tool_weight: bool = True
    impact_pulses: float = option(0.0, least=0.0, most=1.0)
    pulse: str = option(SCENE)
    realtime: bool | None = None
    pipelined: bool | None = None
    live: bool = option(False, no_flag="a run of the command line shows it on a terminal")

    def __post_init__(self) -> None:
        check_fields(self)
        if self.scene_ticks:
            self.rendering_method.refuse_slow()
        refuse_substeps(self.rendering_method.scheme, self.substeps or 1)
        if self.pulse != SCENE:
            if not self.impact_pulses:
                raise HapticBridgeError(
                    f"pulse is {shown(self.pulse)}, but impact-pulses is 0, so that no blow gives "
                    "one; add --impact-pulses 1, or leave out --pulse"
                )
            pulse_of(self.pulse, self.loop_rate)
        if self.clutch is not None and self.clutch == self.dead_man:
            raise DeviceError(
                f"clutch and dead-man are both button {self.clutch}; they exclude each other"
            )

    @property
    def loop_rate(self) -> float:
        """The chosen ticks per second, or ``USUAL_RATE``."""
        return USUAL_RATE if self.rate is None else self.rate

    def for_devices(self, infos: Sequence[DeviceInfo]) -> BridgeOptions:
        """Returns the options with the rate chosen, for the devices of all hands.

        A loop at the device's rate has one tick per sample, T_d, and K is up to 2 b/T_d. A faster
        one has n, and K is up to b/(T_d √(n − 1)) (``theory.bounds.minimum_damping``). With a
        delay it is less in both, and still more in the first.
        """
        rate = self.loop_rate
        is_open = self.rate is None and self.substeps is None and self.scene_rate == AUTO
        stated = [
            info.rate
            for info in infos
            if info.rate and info.delay is not None and not info.is_prescribed
        ]
        if is_open and self.rendering_method.has_law and len(stated) == len(infos):
            own = max(LOWEST_RATE, *stated)
            rate = own if own < rate * (1.0 - ROUNDING) else rate
        return replace(self, rate=rate)

    def for_scene(self, model: mujoco.MjModel) -> BridgeOptions:
        """Returns the options with the pulse that the scene names, if blows give pulses."""
        if self.pulse != SCENE or not self.impact_pulses:
            return self
        own = custom_text(model, "pulse")
        source = "the scene's custom text 'pulse'" if own else "the usual pulse"
        pulse_of(own or USUAL_PULSE, self.loop_rate, source)
        return replace(self, pulse=own or USUAL_PULSE)

    @property
    def scene_ticks(self) -> int:
        """Ticks between two results of the scene; 0 for every tick, also with "auto".

        Raises:
            HapticBridgeError: The scene's rate is out of range.
        """
        if self.scene_rate == AUTO:
            return 0
        most, rate = self.loop_rate, self.scene_rate
        least = most / MAX_SCENE_TICKS
        if not is_number(rate) or not least <= float(rate) <= most:
            raise HapticBridgeError(
                f"scene rate is {shown(rate)} Hz; it must be 'auto', or {least:g} to {most:g}"
            )
        ticks = round(most / float(rate))
        return 0 if ticks < 2 else ticks

    @property
    def rendering_method(self) -> Method:
        """The named method, or the default for these substeps, with the chosen contact."""
        if self.method is None:
            method = default_method(self.substeps or 1)
        else:
            method = method_named(self.method)
        return method.with_contact(self.contact)


DEFAULT_OPTIONS = BridgeOptions()
"""Options of a bridge without choices of the user."""


# Setup of a run

_AT_REST = np.array([((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)], SAMPLE_DTYPE)

STEADY = 0.8
"""Largest K T_s² (1/m_tool + 1/m_hand) of the usual coupling to a slower scene, without unit. The
shown pose is foreseen from data up to 2 T_s old. Above 1.6 the tool shakes by up to 10 N, still
passively."""


def steady_stiffness(
    scene: Scene, info: DeviceInfo, period: float, scale: float, force_scale: float
) -> float:
    """Returns the largest stiffness in N/m with which a slower scene's tool is shown steadily.

        K = STEADY / (T_s² (1/m_tool + s s_f/m_hand))

    m_tool is the tool's smallest inertia at the grip in kg, at the scene's start, and m_hand that
    of hand and device.

    Args:
        scene: The loaded scene.
        info: The device's data sheet.
        period: T_s in s.
        scale: s, handle motion per device motion.
        force_scale: s_f, force on the device per force on the tool.
    """
    start = scene.for_trial()
    start.reset()
    tool = site_inertia(start.model, start.data, start.model.site(start.grip).id)
    hand = DEFAULT_HAND.mass + (info.mass or 0.0)
    return STEADY / (period * period * (1.0 / tool + scale * force_scale / hand))


STEADY_TURN = 0.4
"""Largest K_r T_s²/I_hand of the usual coupling to a slower scene, without unit. The tool's inertia
does not count. Above 0.8 that lets a tool in a lightly damped hand shake, passively."""


def steady_rotational_stiffness(
    info: DeviceInfo, period: float, scale: float, force_scale: float
) -> float:
    """Returns the largest rotational stiffness in N m/rad that a slower scene shows steadily.

        K_r = STEADY_TURN I_hand / (T_s² s_f/s)

    I_hand is the rotational inertia of hand and device in kg m²; the rest as in
    ``steady_stiffness``. It is infinite if the device turns nothing.
    """
    if not set(AXES[3:]) & set(info.axes):
        return math.inf
    hand = DEFAULT_HAND.rotational_inertia + (info.rotational_inertia or 0.0)
    return STEADY_TURN * hand * scale / (period * period * force_scale)


PRESCRIBED_MOTION = DeviceInfo(
    name="prescribed motion",
    axes=AXES,
    force_limit=UNLIMITED.force,
    is_prescribed=True,
    is_real=False,
)
"""Data sheet of a motion without a device, for studies; it does not react to any force."""


def held_scene(scene: Scene, options: BridgeOptions) -> Scene:
    """Returns the scene with the weight that the hand will feel, for the choice of a hand."""
    return scene if options.tool_weight or scene.is_carried else scene.with_tool_carried()


@contextmanager
def device_for_run(
    scene: Scene, device: Device | str, clock: Clock, grip_axis: str = ""
) -> Iterator[Device]:
    """Yields a device, opened if it is named by a string; ``grip_axis`` as for ``device_for``.

    A device that was opened here is closed if the body raises. One that the caller opened is not.

    Raises:
        DeviceError: The device cannot be opened, is no device, or is bound to real time and the
            clock is simulated, or states a loop of its own that it lacks.
    """
    if not isinstance(device, str):
        if fault := device_fault(device):
            raise DeviceError(
                f"device is {shown(device)}, which {fault}; it must be a string such as "
                "'simulated', or an object with the calls of hapticbridge.Device and its data "
                "sheet 'info'"
            )
        _refuse_missing_loop(device)
        yield device
        return
    refuse_simulated_time(device, clock)
    opened = device_for(scene, device, grip_axis=grip_axis)
    with calling_on_error(opened.close):
        _refuse_missing_loop(opened)
        yield opened


def _refuse_missing_loop(device: Device) -> None:
    """Refuses a device that states a loop of its own and has no calls to run one.

    Raises:
        DeviceError: It does.
    """
    if device.info.loop_period is not None and not isinstance(device, LoopDevice):
        raise DeviceError(
            f"the device '{device.info.name}' states loop_period, a loop of its own, but lacks the "
            "calls of hapticbridge.device.own_loop.LoopDevice to show it a tool: leave out "
            "loop_period and loop_delay ('hapticbridge bound --loop-rate' judges a coupling on "
            "such a board)"
        )


def _usual_coupling(
    scene: Scene, info: DeviceInfo, options: BridgeOptions, scene_ticks: int, evaluations: int
) -> Coupling:
    """Returns the stiffest coupling that is safe, softer where a slow scene shakes with it.

    ``evaluations`` is the number of times that a tick evaluates the coupling's law.
    """
    method, period = options.rendering_method, period_of(options.loop_rate)
    scales = options.workspace.scales
    usual = default_coupling(info, period, *scales, evaluations, method)
    if not scene_ticks and info.loop_period is None:
        return usual
    foreseen = scene_period = max(scene_ticks, 1) * period
    if info.loop_period is not None:  # half the age of what its tool is foreseen from
        foreseen = 0.5 * (scene_period + (info.delay or 0.0))
    law = method.law_coupling(usual, period)
    share = min(steady_stiffness(scene, info, foreseen, *scales) / law.stiffness, 1.0)
    turned = min(
        (share if info.moves else 1.0) * law.rotational_stiffness,
        steady_rotational_stiffness(info, foreseen, *scales),
    )
    law = replace(law, stiffness=share * law.stiffness, rotational_stiffness=turned)
    return method.requested_coupling(law, scene_period / (options.substeps or 1))


def _suits_own_loop(scene: Scene, method: Method) -> bool:
    """Returns True if a device with a loop of its own renders the coupling itself.

    It has the coupling's law, and one tool of the bridge's scene.
    """
    is_one = not scene.has_several_hands and scene.joint < 0
    return method.can_be_slow and is_one and scene.credit == 0.0


def _refuse_delay(info: DeviceInfo, period: float) -> None:
    """Refuses a stated delay for which no coupling is computed.

    Raises:
        DeviceError: Names the longest delay at this rate.
    """
    lag = assumed_lag(info, period)
    most = MAX_DELAY * lag.ticks_per_sample * period
    if lag.delay > most * (1.0 + ROUNDING) and not info.is_prescribed:
        raise DeviceError(
            f"the device '{info.name}' states a delay of {format_si(info.delay or 0.0, 's')}, and "
            f"at {format_number(1.0 / period)} Hz a coupling is computed for less than "
            f"{format_si(most, 's')}: state it in seconds, or lower --rate"
        )


def _refuse_buttons(options: BridgeOptions, info: DeviceInfo, *, is_recorded: bool) -> None:
    """Refuses a button that the device lacks, and marks of a recording that there is none of.

    Raises:
        RecordingError: A button is to mark moments, and nothing is recorded.
        DeviceError: The device has fewer buttons.
    """
    if options.mark is not None and not is_recorded:
        raise RecordingError(
            f"button {options.mark} is to mark moments of a recording, but nothing is recorded;"
            " name a file to record to"
        )
    for name in ("clutch", "dead_man", "mark"):
        button = getattr(options, name)
        if button is not None and info.buttons is not None and button >= info.buttons:
            known = f"{format_count(info.buttons, 'button')}, numbered from 0"
            raise DeviceError(
                f"{name.replace('_', '-')} is button {button}, and the device '{info.name}' "
                f"has {known if info.buttons else 'none'}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSetup(StepTimes):
    """Scene, device, coupling, method and guard of a run, checked against each other.

    Attributes:
        scene: The loaded scene.
        coupling: Requested K and B.
        method: The rendering method.
        period: T in s.
        info: The device's data sheet.
        substeps: MuJoCo steps per tick, or between two results of a slower scene.
        scene_ticks: Ticks between two results of a slower scene; 0 if it steps in every tick.
        workspace: Map from the device's frame to the scene's.
        limits: Limits of the wrench.
        guard: Guard parameters.
        contact_stiffness: K_c in N/m for a massless tool, else 0.
        mark: Bit of the mark button; 0 without one.
        is_probed: True if the device is probed before the run.
        tool_weight: False to carry the tool's weight.
        impact_pulses: Share of a blow's energy that may pay for a pulse.
        pulse: Frequency in Hz and time constant in s of the pulses.
        is_realtime: True if real time is requested from the system.
        is_pipelined: True if a tick computes ahead for the next one.
    """

    scene: Scene
    coupling: Coupling
    method: Method
    period: float
    info: DeviceInfo = PRESCRIBED_MOTION
    substeps: int = 1
    scene_ticks: int = 0
    workspace: Workspace = SAME_FRAME
    limits: Limits = UNLIMITED
    guard: GuardParameters = UNGUARDED
    contact_stiffness: float = 0.0
    mark: int = 0
    is_probed: bool = False
    tool_weight: bool = True
    impact_pulses: float = 0.0
    pulse: tuple[float, float] = PULSES[USUAL_PULSE]
    is_realtime: bool = False
    is_pipelined: bool = False

    @classmethod
    def resolve(
        cls,
        scene: Scene,
        info: DeviceInfo,
        coupling: Coupling | Mapping[str, float] | None,
        options: BridgeOptions,
        clock: Clock,
        *,
        is_recorded: bool = True,
    ) -> RunSetup:
        """Completes a user's options, and refuses what they cannot do.

        Args:
            scene: The loaded scene.
            info: The device's data sheet.
            coupling: Requested K and B. None selects the stiffest safe coupling for the device's
                damping: 80 % of the bound, with a quarter of b as damping, less where substeps need
                it. Unknown damping is replaced by ``certificate.assumed_damping``. A mapping
                replaces gains of that coupling.
            options: The user's options.
            clock: Clock of the run.
            is_recorded: True if the run is recorded.

        Raises:
            HapticBridgeError: Two of them exclude each other; the message names both.
        """
        method, period = options.rendering_method, period_of(options.loop_rate)
        if not _suits_own_loop(scene, method):
            info = replace(info, loop_period=None)
        substeps, ticks = options.substeps or 1, options.scene_ticks
        is_real_clock = clock.name == RealClock.name
        if options.scene_rate == AUTO and is_real_clock and method.can_be_slow:
            ticks = scene_ticks_for(substeps * busy_step_time(scene, method, period), period)
        _refuse_buttons(options, info, is_recorded=is_recorded)
        refuse_simulated_time(info, clock)
        _refuse_delay(info, period)
        if info.loop_period is not None and ticks:  # it waits for no scene, so the run is as slow
            period, ticks = ticks * period, 0
            options = replace(options, rate=1.0 / period, scene_rate=1.0 / period)
        evaluations = 1 if ticks else method.law_evaluations(substeps)
        if isinstance(coupling, Coupling):
            requested = coupling
        else:
            usual = _usual_coupling(scene, info, options, ticks, evaluations)
            requested = usual.with_gains(coupling or {})
        require_hazard_consent(method, is_real=info.is_real, i_know=options.i_know)
        setup = cls(
            scene=scene,
            info=info,
            coupling=requested,
            method=method,
            period=period,
            substeps=substeps,
            scene_ticks=ticks,
            workspace=options.workspace,
            limits=limits_for(info, options.limits),
            contact_stiffness=resolve_contact_stiffness(
                method, requested, options.contact_stiffness
            ),
            mark=button_mask(options.mark),
            is_probed=not info.is_prescribed
            and (info.is_real if options.probe is None else options.probe),
            tool_weight=options.tool_weight,
            impact_pulses=options.impact_pulses,
            pulse=PULSES[USUAL_PULSE]
            if options.pulse == SCENE
            else pulse_of(options.pulse, options.loop_rate),
            is_realtime=wants_real_time(options.realtime, clock, is_real=info.is_real),
            is_pipelined=is_real_clock if options.pipelined is None else options.pipelined,
        )
        guard = guard_parameters_for(
            info,
            setup.limits,
            period,
            needed=setup.loop.needs(),
            scale=options.workspace.scale,
            controller=options.controller,
        )
        guard = replace(
            guard,
            clutch=button_mask(options.clutch),
            dead_man=button_mask(options.dead_man),
        )
        setup = replace(setup, guard=guard)
        if setup.impact_pulses:
            if scene.has_several_hands:
                raise no_pulses(setup.impact_pulses, SEVERAL_HANDS)
            setup.unloaded(_AT_REST, None)  # refuses what pulses cannot have
        return setup

    @property
    def credit(self) -> float:  # type: ignore[override] # that of the scene
        """Energy in J that another program's scene may give; 0 for a scene of the bridge."""
        return self.scene.credit

    @property
    def law(self) -> Coupling:
        """Coupling of the law: K and B', for which the device needs b >= s (K T/2 + B')."""
        return self.method.law_coupling(self.coupling, self.timestep)

    @property
    def attainable(self) -> Coupling:
        """Requested coupling, with damping raised to the least that the method can render."""
        return self.method.requested_coupling(self.law, self.timestep)

    @property
    def law_evaluations(self) -> int:
        """Evaluations of the wrench on the tool per tick."""
        return 1 if self.scene_ticks else self.method.law_evaluations(self.substeps)

    @property
    def loop(self) -> LoopSetting:
        """The loop as the device condition sees it."""
        scale, force_scale = self.workspace.scales
        info, period = pulling_loop(self.info, self.period)
        return LoopSetting(
            info=info,
            law=self.law,
            period=period,
            scale=scale,
            force_scale=force_scale,
            law_evaluations=1 if self.info.loop_period else self.law_evaluations,
            method=self.method,
            timestep=self.timestep,
        )

    @property
    def coupling_limits(self) -> CouplingLimits:
        """Couplings that may be selected during the run."""
        return CouplingLimits(loop=self.loop, start=self.attainable, limits=self.limits)

    @property
    def pulse_damping(self) -> float:
        """Damping in N s/m that the device has for pulses, beyond what the coupling needs."""
        own, _ = self.info.dissipating_damping
        return max((own or 0.0) - self.loop.needs()[0], 0.0) if self.impact_pulses else 0.0

    def tap(self) -> Tap | None:
        """Returns a tap of the tool on what does not bounce.

        The tool counts with its smallest inertia at the grip; where no geom that collides is rigid
        with the grip, its parts on joints with theirs. It is None if none collides.
        """
        model, data = self.scene.model, mujoco.MjData(self.scene.model)
        grip = model.site(self.scene.grip).id
        is_part, is_tool = moving_geoms(model, grip), tool_geoms(model, grip)
        pairs = [pair[:2] for pair in meeting_pairs(model, is_part)]
        if not pairs:
            return None
        data.qpos[:] = self.scene.data.qpos
        mujoco.mj_forward(model, data)  # a check of the scene may have left another inertia
        mass = site_inertia(model, data, grip)
        geoms = {geom for pair in pairs for geom in pair if is_part[geom]}
        if not any(is_tool[geom] for geom in geoms):
            mass = min(geom_inertia(model, data, geom) for geom in geoms)
        return Tap.of(self.unloaded(_AT_REST, None), mass)

    def holding(self, start: NDArray[np.void], effective: Coupling | None) -> RunParameters:
        """Returns the parameters of a run that starts now and whose device can hold the tool.

        If a still hand would need more than the device's force or torque limit because of the
        tool's weight, or if the tool topples in a moving one and then pulls more, the weight is
        carried, which replaces the scene's model.

        Args:
            start: As for ``parameters``.
            effective: As for ``parameters``.

        Raises:
            SceneError: The scene must not be changed (``Scene.as_is``).
            HapticBridgeError: A value is out of range.
        """
        parameters = self.parameters(start, effective)
        if reason := self.overload(parameters):
            self.carry(reason)
            return self.parameters(start, effective)
        return parameters

    def overload(self, parameters: RunParameters) -> str:
        """Returns why the device cannot hold the tool, as a clause; empty if it can.

        A torque counts on a device that turns. In one without such motors the tool slips, and hangs
        from the hand.
        """
        scene, most = self.scene, self.on_device(parameters.levels_on_tool)
        if not self.method.has_law or self.info.is_prescribed or scene.is_carried:
            return ""
        pull = self.on_device(holding_wrench(scene, parameters))
        if over := [part for part in range(1 + self.info.turns) if pull[part] > most[part]]:
            weightless = self.on_device(holding_wrench(scene, parameters, has_weight=False))
            unpowered = self.on_device(holding_wrench(scene, parameters, has_motors=False))
            weight = np.minimum(pull, unpowered)  # what motors hold of the tool counts for it
            for part in over:
                # else motors or springs push, more than the weight
                is_heavy = weightless[part] <= max(most[part], pull[part] / 2)
                if (
                    is_heavy
                    and weight[part] > most[part]
                    and self._is_own(parameters, part, float(pull[part]))
                ):
                    return self._heavy(parameters, part, float(weight[part]))
        if reason := self._sagging(parameters):
            return reason
        if pull[0] > most[0]:
            return ""
        force = self._toppling(scene, parameters)
        if force > most[0] and self._toppling(scene.with_tool_carried(), parameters) <= most[0]:
            return (
                f"it stands upright and topples: {TIPPED:g} m beside, it pulls with "
                f"{format_number(force, 3)} N, and the device holds {format_number(most[0], 3)} N"
            )
        return ""

    def _sagging(self, parameters: RunParameters) -> str:
        """Returns the clause on a weight that hangs beyond the guard's limit at rest; or empty."""
        coupling, limits = parameters.coupling, self.limits
        load, scale = self.load_at_rest(parameters), self.workspace.scale
        for part, verb, stiffness, limit, name, unit in (
            (0, "stretches", coupling.stiffness * scale, limits.stretch, "stretch", "m"),
            (1, "turns", coupling.rotational_stiffness, limits.angle, "angle", "rad"),
        )[: 1 + self.info.turns]:
            if load[part] <= stiffness * limit or not stiffness:
                continue
            left = static_load(self.scene.with_tool_carried(), parameters)
            if wrench_sizes(left)[part] <= stiffness * limit:
                return (
                    f"at rest it {verb} the coupling by {format_si(load[part] / stiffness, unit)}, "
                    f"and the {name} limit is {format_si(limit, unit)}"
                )
        return ""

    def _toppling(self, scene: Scene, parameters: RunParameters) -> float:
        """Returns the force in N on the device with which a tool that has toppled pulls."""
        return float(self.on_device((toppling_force(scene, parameters), 0.0))[0])

    def _is_own(self, parameters: RunParameters, part: int, pull: float) -> bool:
        """Returns True if a pull comes from the tool, or from what loads it at rest.

        Else a body that falls on it or strikes it pulls as much at a tool that is carried.
        """
        at_rest = self.on_device(self.load_at_rest(parameters))[part]
        if at_rest > self.on_device(parameters.levels_on_tool)[part]:
            return True
        carried = holding_wrench(self.scene.with_tool_carried(), parameters)
        return bool(self.on_device(carried)[part] < OWN_PULL * pull)

    def _heavy(self, parameters: RunParameters, part: int, weight: float) -> str:
        """Returns the clause on a weight that pulls (part 0) or turns (part 1) the device."""
        verb, unit = (("pulls", "N"), ("turns", "N m"))[part]
        most = self.on_device(parameters.levels_on_tool)[part]
        left = static_load(self.scene.with_tool_carried(), parameters)
        own = along(left, static_load(self.scene, parameters))[part]
        is_laden = 2.0 * own > self.load_at_rest(parameters)[part]
        at_rest = format_si(self.on_device(wrench_sizes(left))[part], unit)
        laden = f"{at_rest} of it at rest from what hangs or lies on the tool, "
        return (
            f"within {format_si(HOLDING_STEPS * parameters.timestep, 's')} it {verb} with up to "
            f"{format_si(weight, unit)}, {laden if is_laden else ''}and the device holds "
            f"{format_si(most, unit)}"
        )

    def load_at_rest(self, parameters: RunParameters) -> tuple[float, float]:
        """Force in N and torque in N m with which the tool loads the coupling at the start."""
        own, loaded = self.guard, parameters.guarding
        return loaded.idle_force - own.idle_force, loaded.idle_torque - own.idle_torque

    def carry(self, reason: str) -> None:
        """Lets the scene carry the tools' weight, for a result of ``overload``.

        Raises:
            SceneError: The scene must not be changed (``Scene.as_is``).
        """
        if self.scene.as_is:
            raise SceneError(
                f"the tool is too heavy ({reason}): let its weight be carried (--no-tool-weight, "
                "or without --as-is)"
            )
        self.scene.carry_tool(reason)

    def on_device(self, sizes: ArrayLike) -> NDArray[np.float64]:
        """Returns force and torque on the device, of those on the tool."""
        scale, force_scale = self.workspace.scales
        return np.asarray(sizes) * (force_scale, force_scale / scale)

    def parameters(self, start: NDArray[np.void], effective: Coupling | None) -> RunParameters:
        """Returns the parameters of a run that starts now.

        Args:
            start: The device's first sample, ``SAMPLE_DTYPE``, shape (1,).
            effective: Result of ``methods.prepare``; the handle starts at the scene's grip.

        Raises:
            HapticBridgeError: A value is out of range.
        """
        unloaded = self.unloaded(start, effective)
        return self._loaded(unloaded) if self.method.has_law else unloaded

    def unloaded(self, start: NDArray[np.void], effective: Coupling | None) -> RunParameters:
        """Returns the parameters of a run whose tool pulls at nothing; as ``parameters``."""
        pose = tuple(float(v) for v in (*start["position"][0], *start["quaternion"][0]))
        if self.scene.joint >= 0:  # which the device's x axis moves
            pose = (pose[0], *IDENTITY_POSE[1:])
        damping, rotational_damping = self.info.dissipating_damping
        scale, force_scale = self.workspace.scales
        is_absolute = self.workspace.absolute
        return RunParameters(
            grip=self.scene.grip,
            period=self.period,
            substeps=self.substeps,
            scene_ticks=self.scene_ticks,
            coupling=self.law,
            scale=scale,
            force_scale=force_scale,
            axes=self.workspace.rotation,
            force_limit=self.limits.force,
            torque_limit=self.limits.torque,
            ramp_ticks=self.limits.ramp_ticks(self.info, self.period),
            device_origin=IDENTITY_POSE if is_absolute else pose,
            handle_origin=IDENTITY_POSE if is_absolute else self.scene.grip_pose(),
            device_start=pose,
            credit=self.credit,
            scheme=self.method.scheme,
            is_rigid=self.method.is_rigid,
            effective=effective,
            contact_stiffness=self.contact_stiffness,
            device_damping=damping,
            device_rotational_damping=rotational_damping,
            guarding=self.guard,
            loop_period=self.info.loop_period or 0.0,
            impact_pulses=self.impact_pulses,
            pulse_frequency=self.pulse[0],
            pulse_decay=self.pulse[1],
            pulse_damping=self.pulse_damping,
            pulse_lag=self.period if self.impact_pulses and self.info.is_real else 0.0,
        )

    def _loaded(self, parameters: RunParameters) -> RunParameters:
        """Returns parameters with which the coupling holds the tool at rest at the start."""
        load, guard = static_load(self.scene, parameters), parameters.guarding
        force, torque = float(np.linalg.norm(load[:3])), float(np.linalg.norm(load[3:]))
        guard = replace(
            guard,
            hold_force=guard.hold_force + force,
            hold_torque=guard.hold_torque + torque,
            idle_force=guard.idle_force + force,
            idle_torque=guard.idle_torque + torque,
        )
        handle = parameters.handle_origin
        if not self.workspace.absolute:
            handle = start_handle(self.scene, parameters, load)
        return replace(parameters, handle_origin=handle, guarding=guard)
