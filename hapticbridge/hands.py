"""Several hands in one scene: what each holds, with which device, and their devices as one.

``kernel.hands`` is the arithmetic of their tick, ``session`` runs it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import shown
from hapticbridge.clock import Clock
from hapticbridge.coupling import Coupling
from hapticbridge.device import Device, DeviceInfo
from hapticbridge.device.base import checked_read, checked_write
from hapticbridge.errors import DeviceError, HapticBridgeError, SceneError, choices
from hapticbridge.guard import Limits
from hapticbridge.options import AUTO, BridgeOptions, RunSetup, Workspace, device_for_run
from hapticbridge.recording.format import MAX_HANDS
from hapticbridge.scene import Scene, load_scene


@dataclass(frozen=True, slots=True, kw_only=True)
class _Choices:
    coupling: Coupling | Mapping[str, float] | None = None
    workspace: Workspace | None = None
    limits: Limits | None = None
    clutch: int | None = None
    dead_man: int | None = None


@dataclass(frozen=True, slots=True)
class Grasp(_Choices):
    """A grip of the scene that one of several hands holds, with its own device.

    Attributes:
        grip: Site, ``BODY`` or ``BODY@x,y,z``, as for ``load_scene``; different in every hand.
        device: An open device, or a string for ``open_device``. A simulated one follows
            ``SCENE_GRIP.csv`` beside the scene, if there is such a file.
        coupling: As for ``Bridge``, for this hand.
        workspace: Map from this device's frame to the scene's; None takes that of the options.
        limits: Limits of this hand; None takes those of the options, or else the device's own.
        clutch: Number of this device's button, from 0, that lets it move without the handle.
        dead_man: Number of this device's button, from 0, that must be held for any force on it.

    Raises:
        HapticBridgeError: The grip is not a text.
    """

    grip: str
    device: Device | str = "simulated"

    def __post_init__(self) -> None:
        if not isinstance(self.grip, str) or not self.grip:
            raise HapticBridgeError(f"grip is {shown(self.grip)}; it must name a site or a body")


def check_grasps(grasps: Sequence[Grasp]) -> tuple[str, ...]:
    """Returns the grips of the hands, in order.

    Raises:
        SceneError: There are too few or too many, or two are equal.
    """
    grips = tuple(grasp.grip for grasp in grasps)
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
        devices = tuple(
            stack.enter_context(device_for_run(scene.of_hand(hand), grasp.device, clock))
            for hand, grasp in enumerate(grasps)
        )
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

    The method is ``implicit`` unless it is named.

    Raises:
        HapticBridgeError: As for ``RunSetup.resolve``, or a choice does not suit several hands.
    """
    if options.method is None:
        options = replace(options, method="implicit")
    _refuse_unsuited(options)
    common = replace(options, scene_rate=options.rate, pipelined=False)
    return tuple(
        RunSetup.resolve(
            scene.of_hand(hand),
            info,
            grasp.coupling,
            replace(
                common,
                workspace=grasp.workspace or options.workspace,
                limits=grasp.limits or options.limits,
                clutch=grasp.clutch,
                dead_man=grasp.dead_man,
            ),
            clock,
            is_recorded=is_recorded,
        )
        for hand, (grasp, info) in enumerate(zip(grasps, infos, strict=True))
    )


def _refuse_unsuited(options: BridgeOptions) -> None:
    """Refuses options that several hands cannot have."""
    for is_chosen, sentence in (
        (
            options.method not in ("implicit", "compensated"),
            f"method '{options.method}' has one hand; several need 'implicit' or 'compensated'",
        ),
        (options.substeps != 1, f"several hands take one substep, not {options.substeps}"),
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
        (options.live, "the live line shows one hand; leave live out with several"),
    ):
        if is_chosen:
            raise HapticBridgeError(sentence)


class DeviceGroup:
    """Devices of several hands, read and written together like one.

    Args:
        devices: One per hand, in order.

    Attributes:
        info: Data sheet for the loop alone: real if any device is, prescribed if all are, and as
            long as the longest motion.
        external_flags: Receives each device's flags, (n,); the kernel's, once it is bound.
    """

    def __init__(self, devices: Sequence[Device]) -> None:
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
        self.external_flags: NDArray[np.int64] = np.zeros(len(devices), np.int64)
        self._devices = tuple(devices)
        self._reads = tuple(checked_read(device) for device in devices)
        self._writes = tuple(checked_write(device) for device in devices)

    def start(self, period: float) -> NDArray[np.void]:
        """Starts every device; returns their poses, (n,), ``SAMPLE_DTYPE``.

        Raises:
            DeviceError: One of them cannot run at this period.
        """
        return np.concatenate([device.start(period) for device in self._devices])

    def read(self, sample: NDArray[np.void]) -> int:
        """Reads every device's newest sample; returns 0, since each hand has flags of its own.

        Raises:
            DeviceLost: One of them is gone, or silent for too long.
        """
        for hand, read in enumerate(self._reads):
            self.external_flags[hand] = read(sample[hand : hand + 1])
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench per device, (n, 6), or one for all, (6,).

        If one of them fails, the others still get theirs.

        Raises:
            DeviceLost: One of them is gone.
        """
        failed: DeviceError | None = None
        for hand, write in enumerate(self._writes):
            try:
                write(wrench if wrench.ndim == 1 else wrench[hand])
            except DeviceError as error:
                failed = failed or error
        if failed is not None:
            raise failed

    def close(self) -> None:
        """Closes every device."""
        with ExitStack() as stack:
            for device in self._devices:
                stack.callback(device.close)
