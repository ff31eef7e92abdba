"""A recorded run, taken apart for repetition with changes; of several hands, each of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.demand.guard import USUAL_RAMP
from hapticbridge.demand.trip import Trip
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import RecordingError
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import TickFlag
from hapticbridge.recording import Recording
from hapticbridge.run.description import parameters_of
from hapticbridge.run.hands import GripAxis
from hapticbridge.run.options import BridgeOptions, RunSetup
from hapticbridge.run.request import RunRequest, request_of, setups_of
from hapticbridge.run.unpacked import unpack_scene
from hapticbridge.whatif.settings import Settings


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Description of a run from its recording; of one hand, if several hold the scene.

    Attributes:
        recording: The recording with its ticks.
        request: What was asked for, of all hands.
        setup: The hand's setup, without its scene.
        parameters: Run parameters.
        settings: Settings that may be changed.
        scene_file: The scene's main file, unpacked from the recording.
    """

    recording: Recording
    request: RunRequest
    setup: RunSetup
    parameters: RunParameters
    settings: Settings
    scene_file: Path

    @classmethod
    def from_hands(cls, hands: Sequence[Recording], folder: Path) -> tuple[RecordedRun, ...]:
        """Takes a recording apart, into a run per hand.

        The scene's files are unpacked to ``folder``.

        Raises:
            RecordingError: The recording does not describe its run, or carries no scene.
        """
        scene_file = unpack_scene(hands[0].path, hands[0].attachments, folder)
        request, setups = request_of(hands[0].meta), setups_of(hands[0].meta)
        return tuple(
            cls(
                recording=recording,
                request=request,
                setup=setup,
                parameters=parameters_of(recording.meta),
                settings=Settings.of(request, setup),
                scene_file=scene_file,
            )
            for recording, setup in zip(hands, setups, strict=True)
        )

    @property
    def info(self) -> DeviceInfo:
        """Data sheet of the device."""
        return self.setup.info

    @property
    def ticks(self) -> NDArray[np.void]:
        """Records, ``TICK_DTYPE``."""
        return self.recording.ticks

    @property
    def period(self) -> float:
        """T in s."""
        return self.parameters.period

    @property
    def anchor_pose(self) -> tuple[float, ...]:
        """Device pose (7,) that corresponds to the handle's start pose in the first tick.

        A device that moved before the first tick re-anchored the coupling, so its earlier motion
        does not appear in the scene.
        """
        first = self.ticks[0]
        if not int(first["flags"]) & int(TickFlag.REANCHORED):
            return self.parameters.device_start
        return (*first["device_position"].tolist(), *first["device_quaternion"].tolist())

    @property
    def trip(self) -> Trip | None:
        """The guard's stop, or None."""
        return Trip.among(self.recording.events)


def changed_request(hands: Sequence[RecordedRun], settings: Sequence[Settings]) -> RunRequest:
    """Returns the recorded request with changed settings, one per hand, for a simulated clock.

    All else stays as requested. With any change, the coupling and the method that the bridge had
    chosen are kept. A scene's rate that was measured is kept, and so is a real device's ramp.

    Raises:
        HapticBridgeError: The changed request is refused.
    """
    request, hand = hands[0].request, 0
    is_changed = any(own != run.settings for own, run in zip(settings, hands, strict=True))
    options, new = request.options, settings[0].options
    if is_changed:
        options = replace(new, workspace=options.workspace, limits=options.limits)
    elif hands[0].setup.scene_ticks:
        options = replace(options, scene_rate=new.scene_rate)
    grasps = []
    for grasp in request.grasps:
        run, own = hands[hand], settings[hand]
        held = grasp if len(hands) > 1 else options  # several have workspace and limits each
        chosen = {
            name: _changed(getattr(held, name) or getattr(options, name), before, after)
            for name, before, after in _parts(run.settings.options, own.options)
        }
        if run.info.is_real and run.setup.limits.ramp is None and own.options.limits.ramp is None:
            limits = chosen.get("limits", held.limits or options.limits)
            chosen["limits"] = replace(limits, ramp=USUAL_RAMP)
        if is_changed:
            grasp = replace(grasp, coupling=own.coupling)  # noqa: PLW2901
        if len(hands) > 1:
            grasp = replace(grasp, **chosen)  # noqa: PLW2901
        else:
            options = replace(options, **chosen)
        if is_changed and grasp.grip_axis is not None:
            axis = _changed_axis(grasp.grip_axis, hands[hand + 1], settings[hand + 1])
            grasp = replace(grasp, grip_axis=axis)  # noqa: PLW2901
        grasps.append(grasp)
        hand += len(grasp.grips)
    return replace(
        request,
        parameters=settings[0].scene,
        grasps=tuple(grasps),
        options=replace(options, realtime=False, probe=False, live=False),
    )


def _parts(before: BridgeOptions, after: BridgeOptions) -> Iterator[tuple[str, Any, Any]]:
    """Yields name, old and new value of the workspace and the limits, where they changed."""
    for name in ("workspace", "limits"):
        if getattr(before, name) != getattr(after, name):
            yield name, getattr(before, name), getattr(after, name)


def _changed(asked: Any, before: Any, after: Any) -> Any:
    """Returns what was asked for, with the fields that differ between two resolved ones."""
    pairs = [(each.name, getattr(after, each.name)) for each in fields(after)]
    return replace(asked, **{name: new for name, new in pairs if new != getattr(before, name)})


def _changed_axis(axis: GripAxis, run: RecordedRun, own: Settings) -> GripAxis:
    """Returns a grip axis with the settings of its hand.

    Raises:
        RecordingError: It is to have a force scale of its own.
    """
    workspace, before = own.options.workspace, run.settings.options.workspace
    if workspace.force_scale not in (None, before.force_scale):
        raise RecordingError(
            f"force_scale of the grip axis at '{run.parameters.grip}' follows its scale and its "
            "hand's; change scale"
        )
    scale = math.copysign(workspace.scale, run.setup.workspace.rotation[0])
    return replace(axis, coupling=own.coupling, scale=scale)
