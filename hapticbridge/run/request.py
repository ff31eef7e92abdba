"""Request of a run: what was asked for, as the recording holds it, and the setups it resolves to.

The live run, the audit, the what-if and the pages resolve a request by one function. Numbers that
follow from it are stored beside it, for programs that read a recording, and compared with it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import PurePath
from typing import Annotated, Literal, cast

from hapticbridge.clock import Clock, RealClock
from hapticbridge.coupling import Coupling
from hapticbridge.dataclass_json import from_json, to_json
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel.codes import Grip
from hapticbridge.kernel.parameters import UNGUARDED, RunParameters
from hapticbridge.kernel.pose import IDENTITY_POSE
from hapticbridge.run.description import (
    describe_parameters,
    metas_of,
    parameters_of,
    requested_of,
)
from hapticbridge.run.hands import Grasp, resolve_hands
from hapticbridge.run.options import AUTO, DEFAULT_OPTIONS, BridgeOptions, RunSetup
from hapticbridge.scene import Scene


class RecordedTime(RealClock):
    """Clock of a recorded run, by its name alone; it is never started."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRequest:
    """Request of a user: scene, hands with their devices, options and clock.

    Attributes:
        scene: File name of the scene.
        parameters: Values of the scene's parameters, by name.
        as_is: True if the scene must not be changed to be felt.
        grasps: What each device holds and how; of one hand, grip and coupling, and the rest is in
            the options. In place of a device stands its name.
        devices: Data sheet of each device.
        options: Options of the bridge.
        clock: Name of the clock, ``real`` or ``simulated``.

    Raises:
        RecordingError: The numbers of grasps and devices differ.
    """

    scene: str
    grasps: tuple[Grasp, ...]
    devices: tuple[DeviceInfo, ...]
    clock: Annotated[str, Literal["real", "simulated"]]
    parameters: Mapping[str, float] = field(default_factory=dict)
    as_is: bool = False
    options: BridgeOptions = DEFAULT_OPTIONS

    def __post_init__(self) -> None:
        if not self.grasps or len(self.grasps) != len(self.devices):
            raise RecordingError(
                f"there are {len(self.grasps)} grasps and {len(self.devices)} devices; each device "
                "has one"
            )

    @classmethod
    def of(
        cls,
        scene: Scene,
        grasps: Sequence[Grasp],
        devices: Sequence[DeviceInfo],
        options: BridgeOptions,
        clock: Clock,
    ) -> RunRequest:
        """Returns the request for a run in a loaded scene."""
        named = zip(grasps, devices, strict=True)
        return cls(
            scene=scene.path.name,
            parameters=scene.parameters,
            as_is=scene.as_is,
            grasps=tuple(replace(grasp, device=info.name) for grasp, info in named),
            devices=tuple(devices),
            options=options.for_devices(devices).for_scene(scene.model),
            clock=clock.name,
        )

    @property
    def grips(self) -> tuple[str, ...]:
        """Grip of each hand; a grip axis is a hand of its own."""
        return tuple(grip for grasp in self.grasps for grip in grasp.grips)

    def resolve(
        self,
        scene: Scene,
        clock: Clock | None = None,
        *,
        scene_ticks: int | None = None,
        is_recorded: bool = True,
    ) -> tuple[RunSetup, ...]:
        """Returns the setup of each hand.

        Args:
            scene: The loaded scene.
            clock: Clock of the run; None for a recorded one.
            scene_ticks: Ticks between two results of the scene as measured, for its rate "auto" on
                a real clock; None measures them.
            is_recorded: True if the run is recorded.

        Raises:
            HapticBridgeError: Parts of the request exclude each other; the message names them.
        """
        clock, options = clock or RecordedTime(self.clock), self.options
        if len(self.grips) > 1:
            own = scene, self.grasps, self.devices, options, clock
            return resolve_hands(*own, is_recorded=is_recorded)
        if scene_ticks is not None and options.scene_rate == AUTO and clock.name == RealClock.name:
            options = replace(options, scene_rate=options.loop_rate / max(scene_ticks, 1))
        [grasp], [info] = self.grasps, self.devices
        return (
            RunSetup.resolve(scene, info, grasp.coupling, options, clock, is_recorded=is_recorded),
        )

    def description(self, setup: RunSetup, parameters: RunParameters) -> dict[str, str]:
        """Returns the metadata of a hand that follow from the request and its start."""
        return {
            "scene": PurePath(self.scene).stem,
            "scene_file": self.scene,
            "device": to_json(setup.info),
            "clock": self.clock,
            "method": setup.method.name,
            **describe_parameters(parameters),
            "requested": json.dumps([getattr(setup.coupling, g.name) for g in fields(Coupling)]),
        }


# Recorded request


@dataclass(frozen=True, slots=True)
class UncompiledScene:
    """Grips of a scene that is not compiled, for what a request determines without one."""

    grip: str
    other_grips: tuple[str, ...] = ()
    credit: float = 0.0

    def of_hand(self, hand: int) -> UncompiledScene:
        """Returns the scene as one of its hands holds it."""
        return self if hand == 0 else replace(self, grip=self.other_grips[hand - 1])

    @property
    def has_several_hands(self) -> bool:
        """True if several hands hold it."""
        return bool(self.other_grips)

    @property
    def joint(self) -> int:
        """0 if the hand holds a joint, else −1."""
        return 0 if Grip.from_text(self.grip).is_joint else -1

    def grip_pose(self) -> tuple[float, ...]:
        """Returns a pose, because only the compiled scene has the grip's."""
        return IDENTITY_POSE


@contextmanager
def refused_request() -> Iterator[None]:
    """Turns the refusal of a recorded request into a RecordingError.

    Numbers of any size may stand in it, on which the theory may also divide by zero or overflow.
    """
    try:
        yield
    except (HapticBridgeError, ArithmeticError, ValueError) as error:
        raise RecordingError(f"metadata 'request' is refused: {error}") from None


def request_of(meta: Mapping[str, str]) -> RunRequest:
    """Returns the request of a recorded run, from the metadata of its first hand.

    Raises:
        RecordingError: It is missing or damaged.
    """
    return from_json(RunRequest, meta.get("request", ""), "metadata 'request'")


def setups_of(meta: Mapping[str, str], scene: Scene | None = None) -> tuple[RunSetup, ...]:
    """Resolves a recorded request.

    Without its scene, what a slower one can show and the ratio of a grip axis are the stored
    numbers, where the request leaves them to the scene. A study without a guard stays without one.

    Args:
        meta: Metadata of the first hand.
        scene: The compiled scene; None for setups that have no scene but its grips.

    Raises:
        RecordingError: The request is damaged or refused, or has other hands than the metadata.
    """
    request, metas = request_of(meta), metas_of(meta)
    grips = request.grips
    if [each.get("grip") for each in metas] != list(grips):
        raise RecordingError("metadata 'grip' and 'request' name different hands")
    stored = [parameters_of(each) for each in metas]
    ticks, [first, *others] = stored[0].scene_ticks, request.grasps
    if stored[0].is_apart:  # then the whole run is as slow as its scene
        ticks = round(stored[0].period * request.options.loop_rate)
    if scene is None:
        is_slow = ticks or request.options.scene_ticks
        if is_slow and not isinstance(first.coupling, Coupling):
            first = replace(first, coupling=requested_of(meta))
        request = replace(request, grasps=tuple(_with_ratios((first, *others), stored)))
        scene = cast(Scene, UncompiledScene(grips[0], grips[1:], stored[0].credit))
    with refused_request():
        setups = request.resolve(scene, scene_ticks=ticks)
    return tuple(
        replace(setup, guard=UNGUARDED) if own.guarding == UNGUARDED else setup
        for setup, own in zip(setups, stored, strict=True)
    )


def _with_ratios(grasps: Sequence[Grasp], hands: Sequence[RunParameters]) -> Iterator[Grasp]:
    """Yields the grasps with the recorded ratio of each grip axis that left it to the scene."""
    hand = -1
    for grasp in grasps:
        hand, axis = hand + len(grasp.grips), grasp.grip_axis
        if axis is not None and axis.scale is None:
            ratio = hands[hand].axes[0] * hands[hand].scale
            grasp = replace(grasp, grip_axis=replace(axis, scale=ratio))  # noqa: PLW2901
        yield grasp
