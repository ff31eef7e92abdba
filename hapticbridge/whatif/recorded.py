"""A recorded run, taken apart for repetition with changes; of several hands, each of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import period_of
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.guard import (
    CONTROLLERS,
    IDLE_FORCE,
    IDLE_TORQUE,
    Limits,
    guard_parameters_for,
)
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.loop_setting import LoopSetting
from hapticbridge.pose import IDENTITY_POSE
from hapticbridge.record import TickFlag
from hapticbridge.recorded_scene import (
    load_unpacked,
    recorded_values,
    unpack_scene,
)
from hapticbridge.recording import Recording
from hapticbridge.rendering import Method
from hapticbridge.run_description import method_of, parameters_of, requested_of
from hapticbridge.scene import Scene
from hapticbridge.whatif.settings import Settings

# Exact inversion of a floating-point function

NEIGHBOURS = 8
"""Number of doubles tried on either side of a guess. A product and a sum are off by two at most;
more would only cost time."""


def invert_exactly(wanted: float, function: Callable[[float], float], guess: float) -> float:
    """Returns the input near a guess whose computed value equals the wanted one bit for bit.

    A recording holds T, not the requested rate. Recomputed from 1/T, T may differ in the last
    digit, and the repetition would no longer be exact.

    Returns:
        The input, or the guess if no neighbour gives the value.
    """
    up = down = guess
    for _ in range(NEIGHBOURS + 1):
        for candidate in (up, down):
            if function(candidate) == wanted:
                return candidate
        up, down = math.nextafter(up, math.inf), math.nextafter(down, -math.inf)
    return guess


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Description of a run from its recording; of one hand, if several hold the scene.

    Attributes:
        recording: The recording with its ticks.
        parameters: Run parameters.
        info: The device.
        settings: Settings that may be changed.
        scene_file: The scene's main file, unpacked from the recording.
    """

    recording: Recording
    parameters: RunParameters
    info: DeviceInfo
    settings: Settings
    scene_file: Path

    @classmethod
    def from_hands(cls, hands: Sequence[Recording], folder: Path) -> tuple[RecordedRun, ...]:
        """Takes a recording apart, into a run per hand.

        The scene's files are unpacked to ``folder``.

        Raises:
            RecordingError: The recording does not describe its run, or carries no scene.
        """
        scene_file = unpack_scene(hands[0], folder)
        return tuple(cls._of_hand(recording, scene_file) for recording in hands)

    @classmethod
    def _of_hand(cls, recording: Recording, scene_file: Path) -> RecordedRun:
        parameters = parameters_of(recording.meta)
        method = method_of(recording.meta)
        try:
            info = DeviceInfo.from_json(recording.meta.get("device", ""))
        except HapticBridgeError as error:
            raise RecordingError(f"the metadata do not describe a run: {error}") from None
        rate = invert_exactly(parameters.period, period_of, 1.0 / parameters.period)
        settings = Settings(
            coupling=requested_of(recording.meta),
            method=method,
            rate=rate,
            substeps=parameters.substeps,
            scene_rate=rate / max(parameters.scene_ticks, 1),
            scale=parameters.scale,
            force_scale=parameters.force_scale,
            contact_stiffness=parameters.contact_stiffness or None,
            scene=recorded_values(recording.meta),
            controller=_controller(info, parameters, method),
        )
        return cls(recording, parameters, info, settings, scene_file)

    @property
    def ticks(self) -> NDArray[np.void]:
        """Records, ``TICK_DTYPE``."""
        return self.recording.ticks

    @property
    def period(self) -> float:
        """T in s."""
        return self.parameters.period

    @property
    def is_absolute(self) -> bool:
        """True if the device's poses were poses in the scene."""
        p = self.parameters
        return p.device_origin == p.handle_origin == IDENTITY_POSE

    @property
    def limits(self) -> Limits:
        """Limits of the run, times in s."""
        p, guarding = self.parameters, self.parameters.guarding
        return Limits(
            force=p.force_limit,
            torque=p.torque_limit,
            hold_force=_requested_hold(guarding.hold_force, guarding.idle_force - IDLE_FORCE),
            hold_torque=_requested_hold(guarding.hold_torque, guarding.idle_torque - IDLE_TORQUE),
            ramp=p.ramp_ticks * p.period,
            stretch=invert_exactly(
                guarding.stretch, lambda m: m * p.scale, guarding.stretch / p.scale
            ),
            angle=guarding.angle,
            energy=guarding.energy,
            reach=guarding.reach,
        )

    @property
    def clutch(self) -> int | None:
        """Number of the clutch button, from 0; None without one."""
        return _button(self.parameters.guarding.clutch)

    @property
    def dead_man(self) -> int | None:
        """Number of the button that had to be held for any force; None without one."""
        return _button(self.parameters.guarding.dead_man)

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
    def trip(self) -> str:
        """Reason of the guard's stop, or empty."""
        trips = [e for e in self.recording.events if e.get("event") == "trip"]
        return str(trips[0].get("reason", "unknown")) if trips else ""


def scene_of(hands: Sequence[RecordedRun], settings: Settings) -> Scene:
    """Loads the scene of a run with the parameters of some settings, and a handle per hand.

    Raises:
        SceneError: A parameter is out of range, or the scene cannot be loaded.
    """
    first, grips = hands[0], tuple(hand.parameters.grip for hand in hands)
    grip = grips if len(grips) > 1 else grips[0]
    return load_unpacked(first.scene_file, grip, settings.scene, first.recording.meta)


def _requested_hold(hold: float, load: float) -> float:
    """Returns the limit that was asked for, without the tool's load, to nine decimals."""
    return hold if hold == math.inf else round(hold - load, 9)


def _controller(info: DeviceInfo, parameters: RunParameters, method: Method) -> str | None:
    """Returns the run's passivity controller; None if it is the bridge's default."""
    p = parameters
    needed = LoopSetting.of_run(info, replace(p, effective=None), method).needs()
    limits = Limits(force=p.force_limit, torque=p.torque_limit)
    usual = guard_parameters_for(info, limits, p.period, needed=needed, scale=p.scale)
    if usual.controller == p.guarding.controller:
        return None
    return next(name for name, code in CONTROLLERS.items() if code == p.guarding.controller)


def _button(mask: int) -> int | None:
    return mask.bit_length() - 1 if mask else None
