"""Several hands in one scene: what each holds, with which device, and their devices as one.

``kernel.tick`` is the arithmetic of their tick, ``session`` runs it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import check_fields, option, rule, shared
from hapticbridge.clock import Clock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.methods import METHODS, default_method, method_named
from hapticbridge.device import Device, DeviceInfo
from hapticbridge.device.base import checked, device_remark
from hapticbridge.errors import DeviceError, HapticBridgeError, SceneError, choices
from hapticbridge.kernel.codes import Grip
from hapticbridge.recording.format import MAX_HANDS
from hapticbridge.run.options import AUTO, BridgeOptions, RunSetup, Workspace, device_for_run
from hapticbridge.scene import Scene, load_scene


@dataclass(frozen=True, slots=True)
class GripAxis:
    """Joint of the scene that a device's grip axis moves.

        y = y_0 + scale · (x − x_0),    F = −q · scale · f

    y is the joint's handle in m or rad, x how far the grip is closed in m, f the coupling's force
    or torque on the joint, F the force on the fingers in N; q = force_scale / scale of the hand, so
    that energy counts alike for all of it.

    Attributes:
        joint: Hinge or slide of the scene that the device's grip axis moves, as the jaw of pliers.
            By default 'hapticbridge run' takes the one that the scene names in its custom text
            'grip_axis'; 'none' leaves it free.
        scale: Motion of that joint per motion of the grip, in rad/m or without unit, not 0; below 0
            for a joint that falls while the grip closes. By default the joint's range over the
            grip's travel.
        coupling: Gains of the coupling to the joint, or some of them by name, in N m/rad and
            N m s/rad for a hinge; None selects the stiffest that is safe.

    Raises:
        HapticBridgeError: The joint is not a text, or the scale out of range.
    """

    joint: str = field(metadata=rule(is_filled=True))
    scale: float | None = option(None)
    coupling: Coupling | Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.scale == 0.0:
            raise HapticBridgeError("scale is 0.0; it must be finite and not 0")

    def workspace(self, scene: Scene, info: DeviceInfo, hand: Workspace) -> Workspace:
        """Returns the map from the grip to the joint.

        Args:
            scene: The scene as the grip axis holds it.
            info: The axis' data sheet.
            hand: Map of the hand whose fingers close it.

        Raises:
            SceneError: The scale is not named, and the travel or the joint's range is unknown.
        """
        scale = self.scale
        if scale is None:
            low, high = scene.model.jnt_range[scene.joint]
            if info.reach is None or not scene.model.jnt_limited[scene.joint]:
                raise SceneError(
                    f"the travel of '{info.name}' or the range of joint '{self.joint}' is unknown; "
                    "name the joint's motion per m of the grip (--grip-scale)"
                )
            scale = float(high - low) / info.reach
        size, axes = abs(scale), _SAME if scale > 0 else _REVERSED
        ratio = hand.energy_ratio
        return Workspace(scale=size, force_scale=None if ratio == 1.0 else ratio * size, axes=axes)


_SAME, _REVERSED = np.eye(3), np.diag([-1.0, 1.0, -1.0])


@dataclass(frozen=True, slots=True)
class Grasp:
    """A grip of the scene that one of several hands holds, with its own device.

    Attributes:
        grip: Site that the hand holds; or BODY, at its centre of mass; or BODY@x,y,z, a point in m
            in the body's frame; or joint:NAME. If the scene has none of that name, the most
            plausible ones are listed. Several hands differ, and the first holds no joint.
        device: 'simulated' (in the scene's own hand; 'simulated:damping=5,path=hand.csv' leads it
            along a file), 'trajectory:FILE' (CSV or recording), 'mouse' (drag the handle in the
            view, which it shows by itself), or a device from the list of 'hapticbridge devices'. In
            code an open device, too. A simulated one of several follows SCENE_GRIP.csv beside the
            scene, if there is such a file.
        coupling: As for ``Bridge``, for this hand.
        workspace: Map from this device's frame to the scene's; None takes that of the options.
        limits: Limits of this hand; None takes those of the options.
        clutch: Number of this device's button, from 0, that lets it move without the handle.
        dead_man: Number of this device's button, from 0, that must be held for any force on it.
        grip_axis: Joint that the device's grip axis moves; None leaves the axis without force.

    Raises:
        HapticBridgeError: The grip is not a text.
    """

    grip: str = field(metadata=rule(is_filled=True))
    device: Annotated[Device | str, str] = "simulated"
    _: KW_ONLY
    coupling: Coupling | Mapping[str, float] | None = None
    workspace: Workspace | None = None
    limits: Limits | None = None
    clutch: int | None = shared(BridgeOptions, "clutch")
    dead_man: int | None = shared(BridgeOptions, "dead_man")
    grip_axis: GripAxis | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def grips(self) -> tuple[str, ...]:
        """The grips of the device, one or, with a grip axis, two."""
        axis = self.grip_axis
        return (self.grip,) if axis is None else (self.grip, str(Grip(axis.joint, "joint")))


def check_grasps(grasps: Sequence[Grasp]) -> tuple[str, ...]:
    """Returns the grips of the hands, in order; a grip axis is a hand of its own.

    Raises:
        SceneError: There are too few or too many, or two are equal.
    """
    grips = tuple(grip for grasp in grasps for grip in grasp.grips)
    if not 2 <= len(set(grips)) == len(grips) <= MAX_HANDS:
        raise SceneError(
            f"the hands hold {choices(grips)}; there must be 2 to {MAX_HANDS} different grips"
        )
    return grips


def scene_of_grasps(scene: Scene | str | Path, grasps: Sequence[Grasp]) -> Scene:
    """Returns the scene with a handle per grasp, loaded if it is named.

    Raises:
        SceneError: A loaded scene has other grips, or there are too many or equal ones.
    """
    grips = check_grasps(grasps)
    if not isinstance(scene, Scene):
        return load_scene(scene, grips)
    if (scene.grip, *scene.other_grips) != grips:
        raise SceneError(
            f"scene '{scene.name}' was loaded with {choices((scene.grip, *scene.other_grips))}, "
            f"and the hands hold {choices(grips)}: load it with these, in this order"
        )
    return scene


@contextmanager
def devices_for_run(
    scene: Scene, grasps: Sequence[Grasp], clock: Clock
) -> Iterator[tuple[Device, ...]]:
    """Yields the devices of all grasps, as ``options.device_for_run`` does for one.

    Raises:
        DeviceError: As there, or two hands have one device.
    """
    with ExitStack() as stack:
        devices: tuple[Device, ...] = ()
        hand = 0
        for grasp in grasps:
            own, joint = scene.of_hand(hand), grasp.grip_axis.joint if grasp.grip_axis else ""
            devices += (stack.enter_context(device_for_run(own, grasp.device, clock, joint)),)
            hand += len(grasp.grips)
        if len({id(device) for device in devices}) < len(devices):
            raise DeviceError("two hands have one device; each needs a device of its own")
        yield devices


def resolve_hands(
    scene: Scene,
    grasps: Sequence[Grasp],
    infos: Sequence[DeviceInfo],
    options: BridgeOptions,
    clock: Clock,
    *,
    is_recorded: bool,
) -> tuple[RunSetup, ...]:
    """Returns the setup of each hand; its own choices replace those of the options.

    A grip axis is a hand of its own.

    Raises:
        HapticBridgeError: As for ``RunSetup.resolve``, or a choice does not suit several hands.
    """
    if options.method is None:
        options = replace(options, method=default_method(has_several_hands=True).name)
    _refuse_unsuited(options)
    common = replace(options, scene_rate=options.loop_rate, pipelined=False)
    setups: list[RunSetup] = []

    def resolve(
        info: DeviceInfo, coupling: Coupling | Mapping[str, float] | None, own: BridgeOptions
    ) -> None:
        held = scene.of_hand(len(setups))
        setups.append(RunSetup.resolve(held, info, coupling, own, clock, is_recorded=is_recorded))

    for grasp, info in zip(grasps, infos, strict=True):
        workspace = grasp.workspace or options.workspace
        if scene.of_hand(len(setups)).joint >= 0:
            workspace = _workspace_of_joint(grasp, options)
        own = replace(
            common,
            workspace=workspace,
            limits=grasp.limits or options.limits,
            clutch=grasp.clutch,
            dead_man=grasp.dead_man,
        )
        resolve(info, grasp.coupling, own)
        if grasp.grip_axis is None:
            continue
        if info.grip_axis is None:
            raise DeviceError(
                f"the device '{info.name}' has no grip axis for joint '{grasp.grip_axis.joint}'; "
                "leave it out"
            )
        # a hand that closes the grip to its stop must not lose the joint there
        axis, limits = (
            info.grip_axis,
            replace(own.limits, reach=math.inf, force=math.inf, torque=math.inf),
        )
        workspace = grasp.grip_axis.workspace(scene.of_hand(len(setups)), axis, workspace)
        own = replace(own, workspace=workspace, limits=limits)
        resolve(axis, grasp.grip_axis.coupling, own)
    _refuse_unequal_energies(setups)
    return tuple(setups)


_EQUAL = 1e-9
"""Largest relative difference of two equal ratios of scales, from rounding. A hand that goes round
between two handles could gain this share of what it moves, which any damping burns."""


def _refuse_unequal_energies(setups: Sequence[RunSetup]) -> None:
    """Refuses hands between which energy would be multiplied.

    With q_i = force_scale / scale of hand i, the work W_i of its coupling on the scene, the energy
    V_i of its springs at the start and the scene's storage S_0, in J,

        E_i <= q_i (V_i − W_i),    Σ W_i >= −S_0,    so    Σ E_i <= q (Σ V_i + S_0)

    for one q alone: E_i is what hand i gets beyond what it puts in. With two, a bar that joins the
    handles gains (q_2/q_1 − 1) of what it carries across. A prescribed motion feels no force, so it
    gets nothing, and its q is free.

    Raises:
        HapticBridgeError: The ratios of two hands differ.
    """
    felt = [(each.scene.grip, each.workspace) for each in setups if not each.info.is_prescribed]
    for grip, workspace in felt[1:]:
        (first, others), own = felt[0], workspace.energy_ratio
        if not math.isclose(own, others.energy_ratio, rel_tol=_EQUAL):
            alike = others.energy_ratio * workspace.scale
            raise HapticBridgeError(
                f"force_scale / scale is {others.energy_ratio:.10g} for the hand at '{first}' and "
                f"{own:.10g} for that at '{grip}': what one puts in would come out at the other "
                f"multiplied; let them be equal, as with force_scale {alike:.10g} at '{grip}'"
            )


def _workspace_of_joint(grasp: Grasp, options: BridgeOptions) -> Workspace:
    """Returns the map from a device's x axis to the joint that it holds.

    Raises:
        HapticBridgeError: The grasp's own axes turn the x axis away from the joint.
    """
    if grasp.workspace is None:
        return replace(options.workspace, axes=_SAME)
    if abs(grasp.workspace.rotation[0]) != 1.0:
        raise HapticBridgeError(
            f"axes of the hand at '{grasp.grip}' turn the device's x axis away; a joint is moved "
            "by that axis, so they must keep it or reverse it"
        )
    return grasp.workspace


def _methods() -> list[str]:
    """Returns the names of the methods that several hands may have."""
    return [name for name, method in METHODS.items() if method.scheme.properties.allows_hands]


def _refuse_unsuited(options: BridgeOptions) -> None:
    """Refuses options that several hands cannot have."""
    for is_chosen, sentence in (
        (
            not method_named(options.method or "").scheme.properties.allows_hands,
            f"method '{options.method}' has one hand; several need one of {choices(_methods())}",
        ),
        ((options.substeps or 1) != 1, f"several hands take one substep, not {options.substeps}"),
        (
            options.scene_rate != AUTO and options.scene_ticks,
            f"the scene steps in every tick for several hands, not at {options.scene_rate} Hz",
        ),
        (bool(options.pipelined), "several hands have no pipelined tick; leave pipelined out"),
        (options.mark is not None, "several hands have no mark button; leave mark out"),
        (
            options.clutch is not None or options.dead_man is not None,
            "each of several hands has buttons of its own: name clutch and dead_man in its Grasp",
        ),
    ):
        if is_chosen:
            raise HapticBridgeError(sentence)


class DeviceGroup:
    """Devices of several hands, read and written together like one.

    Args:
        devices: The devices, in the order of their hands.
        counts: Number of hands of each device: 1, or 2 with its grip axis.

    Attributes:
        info: Data sheet for the loop alone: real if any device is, prescribed if all are, and as
            long as the longest motion.
        external_flags: Receives each device's flags, (n,); the kernel's, once it is bound.
    """

    def __init__(self, devices: Sequence[Device], counts: Sequence[int]) -> None:
        infos = [device.info for device in devices]
        durations = [info.duration for info in infos]
        known = [duration for duration in durations if duration is not None]
        self.info = replace(
            infos[0],
            name=" and ".join(info.name for info in infos),
            is_real=any(info.is_real for info in infos),
            is_prescribed=all(info.is_prescribed for info in infos),
            duration=max(known) if len(known) == len(durations) else None,
        )
        self.external_flags: NDArray[np.int64] = np.zeros(sum(counts), np.int64)
        ends = np.cumsum(counts).tolist()
        # each device with the number of its hands, and their place among all
        self._devices = [
            (checked(device), count, slice(end - count, end))
            for device, count, end in zip(devices, counts, ends, strict=True)
        ]
        # taking an array apart costs as much as reading a device, so it is done once per array
        self._sample: object = None
        self._wrench: object = None
        self._reading: list[tuple[int, Any, NDArray[np.int64] | None, Any]] = []
        self._writing: list[tuple[Any, NDArray[np.float64]]] = []

    @property
    def remarks(self) -> list[str]:
        """Remarks of each hand's device (``device_remark``)."""
        return [device_remark(device) for device, count, _ in self._devices for _ in range(count)]

    def real_ones(self) -> tuple[DeviceGroup, list[int]]:
        """Returns the real devices, of which there must be one, and the numbers of their hands."""
        real = [each for each in self._devices if each[0].info.is_real]
        hands = [hand for *_, part in real for hand in range(part.start, part.stop)]
        return DeviceGroup([each[0] for each in real], [each[1] for each in real]), hands

    def start(self, period: float) -> NDArray[np.void]:
        """Starts every device; returns their poses, (n,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: One of them cannot run at this period.
        """
        return np.concatenate([device.start(period)[:count] for device, count, _ in self._devices])

    def read(self, sample: NDArray[np.void]) -> int:
        """Reads every device's newest sample; returns 0, since each hand has flags of its own.

        Raises:
            DeviceLost: One of them is gone, or silent for too long.
        """
        if sample is not self._sample:
            self._sample = sample
            self._reading = [
                (
                    part.start,
                    device.read,
                    sample["buttons"][part] if count > 1 else None,
                    sample[part],
                )
                for device, count, part in self._devices
            ]
        flags = self.external_flags
        for hand, read, buttons, own in self._reading:
            flags[hand] = read(own)
            if buttons is not None:  # those of the device are those of its grip axis
                flags[hand + 1], buttons[1] = flags[hand], buttons[0]
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench per device, (n, 6), or one for all, (6,).

        If one of them fails, the others still get theirs.

        Raises:
            DeviceLost: One of them is gone.
        """
        if wrench is not self._wrench:
            self._wrench = wrench
            each = np.broadcast_to(wrench, (self.external_flags.size, 6))
            # a device with one hand gets its wrench, (6,)
            self._writing = [
                (device.write, each[part if count > 1 else part.start])
                for device, count, part in self._devices
            ]
        failed: DeviceError | None = None
        for write, own in self._writing:
            try:
                write(own)
            except DeviceError as error:
                failed = failed or error
        if failed is not None:
            raise failed

    def close(self) -> None:
        """Closes every device."""
        with ExitStack() as stack:
            for device, *_ in self._devices:
                stack.callback(device.close)
