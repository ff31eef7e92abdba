"""``hapticbridge run``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from signal import Signals
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
from rich.markup import escape

from hapticbridge.arguments import option, shared
from hapticbridge.cli.terminal import (
    compiling,
    err,
    notify,
    out,
    plain,
    print_json,
    working,
)
from hapticbridge.clock import Clock, RealClock, SimulatedClock, period_of
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import (
    conditions_of,
    default_coupling,
    run_conditions,
)
from hapticbridge.demand.guard import refuse_simulated_time
from hapticbridge.demand.loop_setting import device_period
from hapticbridge.demand.methods import RunCoupling, default_method, unsuited_reason
from hapticbridge.demand.pulse import tap_words
from hapticbridge.demand.rehearsal import RunPoint
from hapticbridge.device import AXES, Device, DeviceInfo, device_for
from hapticbridge.device.base import checked
from hapticbridge.device.mouse import MouseDevice
from hapticbridge.device.registry import is_device
from hapticbridge.device.trajectory import DEFAULT_SECONDS
from hapticbridge.errors import HapticBridgeError, RecordingError, SafetyTrip, choices
from hapticbridge.files import check_regular, check_target, refuse_existing
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.realtime import busy_step_time, scene_ticks_for
from hapticbridge.recording.container import refuse_replacing
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.fidelity import NO_MEASURE, own_substeps
from hapticbridge.run.hands import Grasp, GripAxis, check_grasps
from hapticbridge.run.options import (
    AUTO,
    DEFAULT_OPTIONS,
    USUAL_RATE,
    BridgeOptions,
    RunSetup,
    held_scene,
    steady_rotational_stiffness,
    steady_stiffness,
)
from hapticbridge.run.programs import prepare_run, words
from hapticbridge.run.summary import WELD, Summary, coarse_spring, is_always_implicit
from hapticbridge.scene import (
    Scene,
    SceneSource,
    compile_scene,
    own_grips,
    read_scene,
    settings_from,
)
from hapticbridge.scene.compile import custom_text
from hapticbridge.scene.fault import weight
from hapticbridge.scene.first_faults import worst_faults
from hapticbridge.scene.physics import tool_masses
from hapticbridge.scene.rehearsal import along, static_load, wrench_sizes
from hapticbridge.scene.softness import bounces
from hapticbridge.signals import Interrupts, StopSignal, interrupting_on_signals
from hapticbridge.units import format_degrees, format_energy, format_number, format_si

if TYPE_CHECKING:
    from hapticbridge.view import Window


def announce(setup: RunSetup, named: Mapping[str, float], *, is_method_chosen: bool) -> None:
    """Prints the coupling and the device conditions that do not hold.

    ``named`` has the gains of the coupling that the user named, ``is_method_chosen`` is true if
    they named the method.
    """
    method = setup.method
    scene, device = escape(setup.scene.name), escape(setup.info.name)
    at = f" at '{escape(setup.scene.grip)}'" if setup.scene.has_several_hands else ""
    err.print(
        f"[bold]{scene}[/bold]{at} on {device}, {1 / setup.period:g} Hz, method {method.name}, "
        f"{method.contact} contacts"
    )
    held = is_always_implicit(setup.scene.model, setup.scene.grip)
    rendered = RunCoupling.of(method, setup.timestep, setup.coupling, is_always_implicit=held)
    scales = setup.workspace.scales
    is_apart = setup.info.loop_period is not None
    felt = rendered.felt_at(setup.scene.grip, *scales, is_apart=is_apart)
    for sentence in felt.sentences(setup.info):
        err.print(f"  {sentence}")
    coarse = coarse_spring(setup.scene.model, setup.scene.grip, method)
    if coarse:
        err.print(
            f"  the tool has {coarse}: the springs of the scene are followed to first order in T, "
            "half the error at half the period; without it the tool would be followed to second "
            "order, a quarter"
        )
    usual = default_method()
    if is_method_chosen and method.name != usual.name:
        err.print(f"  {method.name}: {escape(method.about)}")
    elif method.name != usual.name and setup.scene.hand == 0 and not setup.credit:
        has_several = setup.scene.has_several_hands
        reason = unsuited_reason(usual, setup.substeps, has_several_hands=has_several)
        err.print(f"  {method.name}, because {usual.name} {reason}")
    if not method.is_rigid and (bouncing := bounces(setup.scene.model)):
        err.print(
            f"  MuJoCo's springs bounce by themselves: {plain('; '.join(map(str, bouncing)))}; how "
            "far depends on the time step, and may be higher than the fall (rigid contacts, the "
            "default, bounce as impacts that pay for it)"
        )
    if method.hazard:
        err.print(f"[yellow]warning:[/yellow] {escape(method.hazard)}")
    if setup.scene_ticks:
        _announce_slow(setup)
    if setup.is_probed:
        err.print(
            "  the device is first pushed a little along each axis, to see that it goes the right "
            "way (--no-probe)"
        )
    if setup.impact_pulses:
        frequency, decay = setup.pulse
        err.print(
            f"  after a blow of the tool the device gets a pulse of force of {frequency:g} Hz, "
            f"which falls to 37 % in {format_si(decay, 's')}; {tap_words(setup.tap())}"
        )
    _announce_damping(setup, named)
    _announce_own_rate(setup)
    for sentence in _without_motor(setup):
        err.print(f"  {sentence}")
    reach = setup.guard.reach
    if reach < math.inf:
        err.print(
            f"  the device reaches {format_si(reach, 'm')} from its centre; beyond that the "
            "handle stays and no force acts"
        )
    if method.has_law:  # else printed once the weld is measured: ``announce_measured``
        warn_of_conditions(setup)


def warn_of_conditions(setup: RunSetup) -> None:
    """Prints the device conditions that do not hold."""
    for condition in conditions_of(setup.loop):
        if not condition.holds:
            err.print(f"[yellow]warning:[/yellow] {condition.sentence()}")


def _announce_damping(setup: RunSetup, named: Mapping[str, float]) -> None:
    """Says where the user named less damping than the method can render."""
    for symbol, name, unit in (
        ("B", "damping", "N s/m"),
        ("B_r", "rotational_damping", "N m s/rad"),
    ):
        least = getattr(setup.attainable, name)
        if name in named and named[name] < least * (1.0 - 1e-9):
            err.print(
                f"  {symbol} = {named[name]:g} {unit} is less than the {format_number(least)} that "
                f"method {setup.method.name} shows at this stiffness and rate"
            )


def _announce_own_rate(setup: RunSetup) -> None:
    """Says what stiffness a device slower than the loop would bear at a rate of its own."""
    info, own = setup.info, device_period(setup.info, setup.period)
    if info.loop_period is not None:
        rate, scene_rate = format_si(1 / info.loop_period, "Hz"), format_si(1 / setup.period, "Hz")
        err.print(
            f"  a loop of the device's own renders the coupling at {rate}; the scene steps at "
            f"{scene_rate}, behind its link"
        )
        return
    if own == setup.period or not setup.method.has_law or info.damping is None:
        return
    scales, method = setup.workspace.scales, setup.method
    usual = default_coupling(info, own, *scales, setup.law_evaluations, method)
    if usual.stiffness > setup.coupling.stiffness:
        err.print(
            f"  the device gives {format_number(1 / own)} new samples per second, and each force "
            f"is held: --rate {format_number(1 / own)} would allow "
            f"{format_number(usual.stiffness, 3)} N/m"
        )


def _announce_slow(setup: RunSetup) -> None:
    rate, scales = 1.0 / setup.scene_period, setup.workspace.scales
    if setup.credit:
        err.print(
            f"  another program shows its tool, {format_number(rate)} times per second or as it "
            f"can; the hand gets at most what it put in plus {format_energy(setup.credit)}"
        )
        return
    err.print(
        f"  the scene steps at {format_number(rate)} Hz beside the loop, and its tool is shown in "
        "between"
    )
    most = steady_stiffness(setup.scene, setup.info, setup.scene_period, *scales)
    if setup.coupling.stiffness > 2.0 * most:
        err.print(
            "[yellow]warning:[/yellow] at this scene rate the tool may shake above about "
            f"{format_number(2.0 * most, 2)} N/m: lower --stiffness, or raise --scene-rate"
        )
    most = steady_rotational_stiffness(setup.info, setup.scene_period, *scales)
    if setup.coupling.rotational_stiffness > 2.0 * most:
        err.print(
            "[yellow]warning:[/yellow] at this scene rate the tool may shake above about "
            f"{format_number(2.0 * most, 2)} N m/rad: lower --rotational-stiffness, or raise "
            "--scene-rate"
        )


def _without_motor(setup: RunSetup) -> Iterator[str]:
    """Yields a sentence for translation and for rotation if the device lacks axes of the kind."""
    if setup.scene.joint >= 0:
        return
    for kind, part, limit in (
        ("place", AXES[:3], format_si(setup.limits.hold_force, "N")),
        ("orientation", AXES[3:], f"{format_si(setup.limits.hold_torque, 'N m')} (--hold-torque)"),
    ):
        if sensed := [axis for axis in part if axis in setup.info.sensed]:
            yield (
                f"the device senses {', '.join(sensed)} without a motor: the tool follows up to "
                f"{limit} beyond its weight, and the hand does not feel it"
            )
        present = (*setup.info.axes, *setup.info.sensed)
        if lacking := [axis for axis in part if axis not in present]:
            yield (
                f"the device has no motor for {', '.join(lacking)}: the tool keeps its {kind} up "
                f"to {limit} beyond its weight, then slips"
            )


def announce_measured(bridge: Bridge) -> None:
    """Prints what is known once the bridge is open.

    These are the changes of the scene, the tool's weight, and the device conditions of a method
    without a coupling law.
    """
    setup, parameters = bridge.setup, bridge.session.parameters
    for change in setup.scene.changes:
        err.print(f"  changed in the scene: {escape(change)}")
    for each, own in zip(bridge.setups, bridge.session.hand_parameters, strict=True):
        for sentence in _weight_in_hand(each, own):
            err.print(f"  {sentence}")
    if setup.method.has_law:
        return
    if parameters.effective is not None:
        measured = RunCoupling(setup.coupling, None, parameters.effective)
        for sentence in measured.sentences():
            err.print(f"  {sentence}: {WELD}")
    conditions = run_conditions(setup.info, parameters, setup.method)
    met = {condition.sentence() for condition in conditions if condition.holds}
    for sentence in bridge.conditions():
        head = "  " if sentence in met else "[yellow]warning:[/yellow] "
        err.print(head + escape(sentence))


MAX_FAULTS = 2
"""Number of a scene's faults that a run repeats."""


def _findings(source: SceneSource, scene: Scene) -> tuple[str, ...]:
    """Returns the worst of what ``hapticbridge check`` finds without a motion."""
    return tuple(
        f"{fault.sentence} ({fault.place}; 'hapticbridge check' says what to write instead)"
        for fault in islice(worst_faults(source, scene), MAX_FAULTS)
    )


HEAVY = 0.25
"""Share of the force or torque limit above which a sentence tells the tool's load; no unit."""

EASED = 0.05
"""Share of that load which carrying the tool must take off to be advised; no unit."""


def _weight_in_hand(setup: RunSetup, parameters: RunParameters) -> Iterator[str]:
    """Yields a sentence on the load of the tool at rest, for its force and torque if heavy."""
    if setup.scene.joint >= 0 or not setup.method.has_law:
        return
    loads, limits = setup.load_at_rest(parameters), (setup.limits.force, setup.limits.torque)
    for part in range(1 + setup.info.turns):
        if HEAVY * limits[part] < setup.on_device(loads)[part] < math.inf:
            yield _heavy_load(setup, parameters, part)


def _heavy_load(setup: RunSetup, parameters: RunParameters, part: int) -> str:
    """Returns the sentence on a heavy load; part 0 is the force, 1 the torque."""
    scene, load = setup.scene, setup.load_at_rest(parameters)[part]
    coupling, unit = parameters.coupling, ("N", "N m")[part]
    beside = (
        format_degrees(load / coupling.rotational_stiffness)
        if part
        else format_si(load / coupling.stiffness, "m")
    )

    def in_hand(sizes: tuple[float, float]) -> str:
        return format_si(setup.on_device(sizes)[part], unit)

    felt = in_hand(setup.load_at_rest(parameters))
    whole = static_load(scene, parameters)
    others = along(static_load(scene, parameters, has_weight=False), whole)
    if 2.0 * others[part] > load:
        return (
            f"at rest the hand bears {felt}, {beside} beside the handle, most of "
            "it from motors, springs or parts of the scene that push the tool"
        )
    borne = f"that the hand bears {beside} beside the handle"
    lift = 'gravcomp="1" in these bodies carries them'
    if scene.is_carried:
        return (
            f"at rest the hand bears {felt}, {beside} beside the handle, from what "
            f"hangs or lies on the tool, whose weight is carried; {lift}"
        )
    left = static_load(scene.with_tool_carried(), parameters)
    felt_alone = wrench_sizes(left)
    alone = (
        "--no-tool-weight carries the tool alone (tried: the hand then bears "
        f"{in_hand(felt_alone)})"
    )
    # where a motor lifts the tool, it bears more
    is_eased = felt_alone[part] < (1.0 - EASED) * load
    if 2.0 * along(left, whole)[part] > load:
        verb = "makes" if part else "weighs"
        remedy = f"{lift}, and {alone}" if is_eased else lift
        return f"what hangs or lies on the tool {verb} most of the {felt} {borne}; {remedy}"
    own, mass = tool_masses(scene.model, scene.grip)
    subject = "this tool"
    if own < 0.5 * mass:
        subject += f" with its links ({weight(mass)}, without them {weight(own)})"
    verb = f"turns the hand with {felt}" if part else f"weighs {felt} in the hand"
    remedy = f"; {alone}" if is_eased else ""
    return f"{subject} {verb}, which holds it {beside} beside the handle{remedy}"


def is_mouse(device: str) -> bool:
    """Returns True for the device that moves in the page of a view."""
    return device.partition(":")[0] == "mouse"


def open_window(port: int | None) -> Window:
    """Returns the page of a view, at the usual port by None."""
    from hapticbridge.view import Address, Window  # noqa: PLC0415 - for --view alone

    return Window(Address() if port is None else Address(port))


def attach_window(window: Window | None, bridge: Bridge, device: object) -> None:
    """Lets a page, if there is one, give commands, and move the mouse."""
    if window is not None:
        window.on_command = partial(bridge.command, by="view")
        if isinstance(device, MouseDevice):
            window.on_hand = device.aim


def announce_window(window: Window | None, device: object) -> None:
    """Prints the address of a page, if there is one."""
    if window is not None:
        steer = "drag the arrows at the tool, and " if isinstance(device, MouseDevice) else ""
        notify(f"view: {window.url} (open it in a browser; {steer}Ctrl-C ends the run)")


def refuse_overwriting(record: Path | None, *devices: str, overwrite: bool) -> None:
    """Refuses a file that was not to be replaced, no recording, or the motion of the run.

    ``devices`` are the run's, as named.
    """
    if record is None:
        if overwrite:
            raise HapticBridgeError(
                "--overwrite goes with --record FILE; nothing would be recorded"
            )
        return
    if not record.exists():
        return
    check_target(record, RecordingError)
    check_regular(record, RecordingError)
    refuse_existing(record, RecordingError, overwrite=overwrite)
    refuse_replacing(record)
    for named in devices:
        motion = Path(named.partition("trajectory:")[2].partition(":/")[0])
        if motion.is_file() and motion.samefile(record):
            raise RecordingError(f"'{motion}' is the motion of the run; choose another file")


def refuse_without_hand(options: BridgeOptions, infos: Sequence[DeviceInfo]) -> None:
    """Refuses options that only a hand gives an effect, where the motion is prescribed."""
    if not all(info.is_prescribed for info in infos):
        return
    for name, value in (("ramp", options.limits.ramp), ("probe", options.probe)):
        if value:
            raise HapticBridgeError(
                f"--{name} has no effect on the device '{infos[0].name}', as its motion is "
                "prescribed and no hand feels a force; leave it out"
            )


def print_summary(summary: Summary, scene: Scene, record: Path | None, *, as_json: bool) -> None:
    """Prints a run's summary, for a reader or as JSON with what was told of its scene before."""
    if as_json:
        told = {"scene_changes": scene.changes, "scene_findings": scene.findings}
        print_json(summary.to_dict() | {"recording": str(record or "") or None} | told)
        return
    for line in str(summary).splitlines():
        out.print(plain(line))


def exit_code(summary: Summary) -> int:
    """Returns 0 for a passive run on a device that is certified or not judged, else 1."""
    return 0 if summary.verdict == "passive" and summary.is_certified is not False else 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Put a scene behind a haptic device and feel it.

    Ctrl-C ends the run in order: zero force first, then the recording is closed. The exit code is
    then 0, or 1 after an active run or on a device that is not certified.

    Example:
        hapticbridge run peg_in_hole --duration 8 --record run.mcap
    """

    FIRST_OPTIONS: ClassVar = (
        "scene",
        "set",
        "grip",
        "device",
        "force-limit",
        "dead_man",
        "duration",
        "record",
        "fast",
        "stiffness",
        "damping",
        "view",
    )

    scene: str = option(metavar="SCENE", is_positional=True)
    """An MJCF file, or a scene's name (see 'hapticbridge scenes')."""
    settings: tuple[str, ...] = option((), flag="set", metavar="NAME=VALUE", is_repeated=True)
    """Set a parameter of the scene, as in --set clearance=0.1e-3. 'hapticbridge scenes NAME' lists
    the parameters with units and ranges."""
    grip: str = shared(Grasp, "grip", "grip")
    as_is: bool = False
    """Refuse a scene that must be changed to be felt: options that exclude the coupling (solver
    PGS, noslip_iterations, sleep), force limits of joints, a tool inside something or too heavy.
    By default it is changed, with a line for each change."""
    grip_axis: str | None = shared(GripAxis, "joint", None, metavar="JOINT")
    grip_scale: float | None = shared(GripAxis, "scale")
    device: str = shared(Grasp, "device")
    hand: tuple[str, ...] = option((), metavar="GRIP=DEVICE", is_repeated=True)
    """Hold a grip with a device, in place of --grip and --device, once per hand: --hand
    wrench=falcon --hand bolt=spacemouse. Both are named as for those two; GRIP+JOINT names what the
    device's grip axis moves. Scale, axes, limits and gains apply to every hand, --clutch and
    --dead-man to every real device. The method is 'implicit' or 'compensated'."""
    duration: float | None = option(None, unit="s", least=0.0, is_open=True)
    """Duration in s; each missed deadline uses up one period of it. By default a recorded or
    scripted motion is run to its end, which missed deadlines delay; any other device runs until
    Ctrl-C, with --fast for 5 s."""
    record: Path | None = None
    """File to record to (.mcap)."""
    overwrite: bool = False
    """Replace the recording of --record if the file exists."""
    fast: bool = False
    """Run in simulated time: as fast as possible, with equal results in every run."""
    coupling: Mapping[str, float] = option(gains_of=Coupling)
    options: BridgeOptions = DEFAULT_OPTIONS
    view: bool = False
    """Show the run in a browser, from a process of its own; needs the extra 'view'."""
    port: int | None = option(None, least=0, most=65535)
    """Port of the view on this machine, by default 8080; 0 takes any free port. Only the printed
    address opens it. From another machine: ssh -L 8080:localhost:8080 MACHINE."""
    as_json: bool = option(False, flag="json")
    """Print the summary as JSON."""

    def execute(self) -> int:
        """Runs the bridge; returns the exit code."""
        refuse_overwriting(self.record, self.device, *self.hand, overwrite=self.overwrite)
        clock = SimulatedClock() if self.fast else RealClock()
        if self.hand and (self.grip != "grip" or self.device != "simulated"):
            raise HapticBridgeError("--hand GRIP=DEVICE takes the place of --grip and --device")
        refuse_simulated_time(self.device, clock)  # before the user is asked to home it
        if self.port is not None and not self._is_viewed:
            raise HapticBridgeError("--port without --view has no effect")
        window = open_window(self.port) if self._is_viewed else None
        with ExitStack() as stack:
            interrupts = stack.enter_context(interrupting_on_signals())
            with working("reading the scene"):
                source = read_scene(self.scene, **settings_from(self.settings))
            held = self._completed(self._held(source.spec), own_grips(source))
            prepare_run(lambda left: notify(words(left)))
            if len(held) > 1:
                return self._run_hands(source, held, clock, stack, window, interrupts)
            if held:
                return self._alone(*held[0]).execute()
            with working("trying the scene"):
                with compiling(self.scene):
                    scene = compile_scene(source, self.grip, as_is=self.as_is)
                self._warn_of_faults(source, scene)
            joint = self._own_grip_axis(scene)
            if not joint:
                self._refuse_grip_scale()
            device = device_for(held_scene(scene, self.options), self.device, notify, joint)
            # what is refused from here on must not leave it claimed
            stack.callback(checked(device).close)
            refuse_without_hand(self.options, [device.info])
            chosen = self._for_devices([device.info])
            if device.info.grip_axis is not None and not joint and self.grip_axis is None:
                notify(
                    f"the grip axis of '{device.info.name}' moves no joint; --grip-axis names one"
                )
            if joint and self.grip_axis is None and device.info.grip_axis is None:
                notify(f"'{device.info.name}' has no grip axis, so joint '{joint}' moves freely")
            elif joint:
                grasp = self._with_buttons(self._grasp(self.grip, joint, device))
                found = scene.findings
                scene = compile_scene(source, grasp.grips, as_is=self.as_is, warns=False)
                scene.findings = found
                return chosen._without_buttons()._feel(
                    scene, [grasp], clock, stack, window, interrupts
                )
            if self.options.substeps is None:
                with working("trying the scene"):
                    chosen = chosen._with(substeps=chosen._own_substeps(source, scene, device.info))
            return chosen._feel(scene, device, clock, stack, window, interrupts)

    @property
    def _is_viewed(self) -> bool:
        """True if a page shows the run, with its state; plain lines would repeat it every 2 s."""
        return self.view or is_mouse(self.device)

    def _warn_of_faults(self, source: SceneSource, scene: Scene) -> None:
        """Prints the worst faults of the scene, and keeps them for the recording."""
        scene.findings = _findings(source, scene)
        if not self.as_json:
            for sentence in scene.findings:
                err.print(f"[yellow]warning:[/yellow] {plain(sentence)}")

    def _refuse_grip_scale(self) -> None:
        if self.grip_scale is not None:
            raise HapticBridgeError(
                "--grip-scale without a grip axis has no effect; name its joint: --grip-axis JOINT"
            )

    def _own_grip_axis(self, scene: Scene) -> str:
        """Returns the joint that a grip axis moves, the user's or the scene's; empty for none."""
        own = custom_text(scene.model, "grip_axis") if self.grip_axis is None else self.grip_axis
        return "" if own == "none" else own

    def _grasp(self, grip: str, joint: str, device: Device) -> Grasp:
        """Returns what a hand holds, with the joint of its grip axis if that is not empty."""
        axis = GripAxis(joint, self.grip_scale) if joint else None
        return Grasp(grip, device, coupling=self.coupling, grip_axis=axis)

    def _with(self, **changes: Any) -> Run:
        """Returns the run with changed options."""
        return replace(self, options=replace(self.options, **changes))

    def _for_devices(self, infos: Sequence[DeviceInfo]) -> Run:
        """Returns the run at the rate for its devices; says if that is not the usual one."""
        options = self.options.for_devices(infos)
        is_own = any(info.loop_period is not None for info in infos)
        if self.options.rate is None and options.loop_rate < USUAL_RATE and not is_own:
            notify(
                f"the loop runs at {format_number(options.loop_rate)} Hz, as often as the device "
                f"has a new sample: it bears stiffer walls so than at {USUAL_RATE:g} Hz (--rate "
                "sets another)"
            )
        return replace(self, options=options)

    def _with_buttons(self, grasp: Grasp) -> Grasp:
        return replace(grasp, clutch=self.options.clutch, dead_man=self.options.dead_man)

    def _without_buttons(self) -> Run:
        """Returns the run of several hands, each of which has the buttons in its grasp."""
        return self._with(clutch=None, dead_man=None)

    def _held(self, spec: mujoco.MjSpec) -> list[tuple[str, str, str]]:
        """Returns grip, joint of the grip axis (may be empty) and device of each --hand.

        A name of the scene may hold ``=`` and ``+``.
        """
        held = []
        names = {each.name for each in (*spec.sites, *spec.bodies)}
        for each in self.hand:
            parts = each.split("=")
            pairs = [("=".join(parts[:i]), "=".join(parts[i:])) for i in range(1, len(parts))]
            known = (pair for pair in pairs if is_device(pair[1]))
            grip, device = next(known, pairs[0] if pairs else ("", ""))
            grip, joint = (grip, "") if grip in names else grip.partition("+")[::2]
            if not grip or not device:
                raise HapticBridgeError(f"--hand is {each!r}; it must be GRIP=DEVICE")
            held.append((grip, joint, device))
        return held

    def _alone(self, grip: str, joint: str, device: str) -> Run:
        """Returns the run of one hand that --hand names."""
        joint_of_all = joint or self.grip_axis
        return replace(self, hand=(), grip=grip, device=device, grip_axis=joint_of_all)

    def _completed(
        self, held: list[tuple[str, str, str]], grips: tuple[str, ...]
    ) -> list[tuple[str, str, str]]:
        """Adds a simulated device for each grip that the scene names and no --hand holds."""
        if not held and self.grip != "grip":
            return []
        if grips and not held and self.device != "simulated":
            raise HapticBridgeError(
                f"several hands hold {choices(grips)} in this scene; name the device of each, as "
                f"in --hand {grips[0]}={self.device}"
            )
        named = {grip for grip, _, _ in held}
        return held + [(grip, "", "simulated") for grip in grips if grip not in named]

    def _run_hands(
        self,
        source: SceneSource,
        held: Sequence[tuple[str, str, str]],
        clock: Clock,
        stack: ExitStack,
        window: Window | None,
        interrupts: Interrupts,
    ) -> int:
        """Runs several hands, each with its grip, grip axis and device; returns the exit code."""
        for _, _, device in held:
            refuse_simulated_time(device, clock)
            if is_mouse(device):
                raise HapticBridgeError("the mouse is for one hand: --device mouse")
        if self.grip_axis not in (None, "none"):
            raise HapticBridgeError(
                f"--grip-axis is for one hand; several name it as in --hand "
                f"{held[0][0]}+{self.grip_axis}={held[0][2]}"
            )
        axes = {grip: GripAxis(joint) for grip, joint, _ in held if joint}
        if not axes:
            self._refuse_grip_scale()
        grips = check_grasps([Grasp(grip, grip_axis=axes.get(grip)) for grip, *_ in held])
        with working("trying the scene"), compiling(self.scene):
            scene = compile_scene(source, grips, as_is=self.as_is)
            self._warn_of_faults(source, scene)
        grasps, infos, felt = [], [], held_scene(scene, self.options)
        for grip, joint, name in held:
            opened = device_for(felt.of_hand(grips.index(grip)), name, notify, joint)
            stack.callback(opened.close)
            infos.append(opened.info)
            grasps.append(self._grasp(grip, joint, opened))
        refuse_without_hand(self.options, infos)
        one = self._without_buttons()._for_devices(infos)
        if self.options.substeps is None:
            with working("trying the scene"):
                one = one._with(substeps=one._own_substeps(source, scene, infos[0]))
        return one._feel(scene, self._with_their_buttons(grasps), clock, stack, window, interrupts)

    def _with_their_buttons(self, grasps: Sequence[Grasp]) -> list[Grasp]:
        """Returns the grasps with the buttons of their devices; a simulated hand has none."""
        if self.options.clutch is None and self.options.dead_man is None:
            return list(grasps)
        is_real = [not isinstance(g.device, str) and g.device.info.is_real for g in grasps]
        if not any(is_real):
            raise HapticBridgeError(
                "--clutch and --dead-man are buttons of a real device, and no hand has one"
            )
        return [
            self._with_buttons(grasp) if is_pressed else grasp
            for grasp, is_pressed in zip(grasps, is_real, strict=True)
        ]

    def _own_substeps(self, source: SceneSource, scene: Scene, info: DeviceInfo) -> int:
        """Returns the substeps that the scene needs; says if it moves otherwise than its file."""
        if self.options.method is not None:
            return 1
        ticks = self._scene_ticks(scene)
        period = max(ticks, 1) * period_of(self.options.loop_rate)
        coupling = default_coupling(info, period, *self.options.workspace.scales)
        setting = RunPoint(coupling, period, contact=self.options.contact or "rigid")
        count, moved = own_substeps(source, scene, setting)
        if ticks:  # more steps would not be in time
            count = 1
        if count > 1:
            notify(
                f"{count} MuJoCo steps per tick keep the file's own time step, without which the "
                "scene alone would move noticeably differently (--substeps 1 takes one)"
            )
        elif moved is None:
            notify(NO_MEASURE)
        elif moved.deviations:
            notify("; ".join(filter(None, (str(moved), moved.advice(setting)))))
        elif moved.lost:
            notify(moved.doubt)
        return count

    def _scene_ticks(self, scene: Scene) -> int:
        if self.options.scene_rate != AUTO or self.fast:
            return self.options.scene_ticks
        period = period_of(self.options.loop_rate)
        return scene_ticks_for(busy_step_time(scene, default_method(), period), period)

    def _feel(
        self,
        scene: Scene,
        device: Device | Sequence[Grasp],
        clock: Clock,
        stack: ExitStack,
        window: Window | None,
        interrupts: Interrupts,
    ) -> int:
        """Runs the bridge on a device that is open, or one per hand; returns the exit code."""
        is_shown = not self.as_json and (err.is_terminal or not (self.fast or self._is_viewed))
        options = replace(self.options, live=is_shown)
        coupling = None if isinstance(device, Sequence) else self.coupling
        bridge = Bridge(
            scene, device, coupling, options, clock=clock, recording=self.record, observer=window
        )
        attach_window(window, bridge, device)
        if not self.as_json:
            for setup in bridge.setups:
                announce(setup, self.coupling, is_method_chosen=options.method is not None)
        with working("rehearsing the start of the run"):
            stack.enter_context(bridge)
        interrupts.hand_over(bridge.stop_on_signal)  # also while it closes: never cut short
        announce_window(window, device)
        if not self.as_json:
            announce_measured(bridge)
        try:
            summary = bridge.run(self._duration(bridge.device.info))
        except SafetyTrip:
            stack.close()
            self._print(bridge.summary(), bridge.scene)
            raise
        stack.close()
        if not summary.ticks and (name := bridge.session.signal):
            raise StopSignal(Signals[name])
        self._print(summary, bridge.scene)
        return exit_code(summary)

    def _print(self, summary: Summary, scene: Scene) -> None:
        print_summary(summary, scene, self.record, as_json=self.as_json)
        if not self.as_json and self._is_viewed and self.record is not None:
            notify(f"the page ends with the run; 'hapticbridge view {self.record}' plays it")

    def _duration(self, info: DeviceInfo) -> float | None:
        """Returns the duration of the run in s; None until it is stopped."""
        if self.duration is not None or info.duration is not None or not self.fast or self.view:
            return self.duration
        notify(
            f"the simulated hand's motion has no end: this run takes {DEFAULT_SECONDS:g} s of "
            "simulated time (--duration takes another)"
        )
        return DEFAULT_SECONDS
