"""Simulated device in a simulated hand, exact at the sampling instants."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import shown
from hapticbridge.device.base import (
    AXES,
    USUAL_FORCE_LIMIT,
    USUAL_SPEED_LIMIT,
    USUAL_TORQUE_LIMIT,
    Device,
    DeviceInfo,
    checked,
    checked_number,
    checked_period,
)
from hapticbridge.device.motion_file import read_motion
from hapticbridge.device.simulated.dynamics import (
    DEFAULT_HAND,
    FREE,
    IN_A_HAND,
    MAX_DELAY,
    NO_HAND,
    ON_A_LINE,
    STATE_DTYPE,
    Hand,
    next_sample,
    sampled_axis,
)
from hapticbridge.device.trajectory import Motion
from hapticbridge.errors import DeviceError, SceneError
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.scene import Scene, custom_numbers
from hapticbridge.scene.physics import site_weight
from hapticbridge.theory.sampled_loop import WorstHand

# Hand of a scene

SCENE_HAND = "simulated_hand"
"""Name of the custom numbers in a scene's file."""

_FIELDS = ("stiffness", "damping", "rotational_stiffness", "rotational_damping")


def scene_hand(model: mujoco.MjModel, path: Path) -> Hand:
    """Returns the hand that follows a scene's path; ``DEFAULT_HAND`` without custom numbers.

    A relaxed arm (135 N/m) follows a path only against little resistance; driving a nail or turning
    a key requires a firmer grip. A scene specifies it in its file,

        <custom><numeric name="simulated_hand" data="1000 30"/></custom>

    as stiffness in N/m and damping in N s/m, optionally followed by rotational stiffness in N m/rad
    and rotational damping in N m s/rad. All other values, including the inertia, are those of the
    default hand.

    Raises:
        SceneError: The numbers are not two or four, or one is not finite or negative.
    """
    numbers = custom_numbers(model, SCENE_HAND)
    if not numbers:
        return DEFAULT_HAND
    words = " ".join(f"{number:g}" for number in numbers)
    where = f"scene '{path}': its custom numbers '{SCENE_HAND}' are '{words}'"
    if len(numbers) not in (2, 4):
        raise SceneError(
            f"{where}; they must be stiffness in N/m and damping in N s/m of the hand, optionally "
            "followed by its rotational stiffness in N m/rad and damping in N m s/rad"
        )
    try:
        return replace(DEFAULT_HAND, **dict(zip(_FIELDS, numbers, strict=False)))
    except DeviceError as error:
        raise SceneError(f"{where}; {error}") from None


MAX_LIFT = 0.01
"""Way in m that a hand's path leads a tool that does not follow: that of the slow Lissajous figure.
A tool heavier than the default hand's spring pulls over it would never be lifted."""

LIFT_SAG = 0.005
"""Way in m by which a tool hangs below the path of a hand that fits its weight. Half of it makes
the hand twice as stiff, beyond a firm human grip at 10 N."""


def hand_for(scene: Scene) -> Hand:
    """Returns the hand that follows a scene's path, which is firm enough to lift the tool.

    It is ``scene_hand``. If the weight W of the tool is more than the default hand bears over
    ``MAX_LIFT``, it is firmer,

        k_h = W/s,    b_h = b_0 √(k_h/k_0)

    with the sag s = ``LIFT_SAG`` and k_0, b_0 of ``DEFAULT_HAND``. A tool heavier than
    ``USUAL_FORCE_LIMIT`` is carried by the bridge, and needs no firmer hand.

    Raises:
        SceneError: As for ``scene_hand``.
    """
    hand = scene_hand(scene.model, scene.path)
    if custom_numbers(scene.model, SCENE_HAND) or scene.joint >= 0:
        return hand
    length = math.sqrt(hand.rotational_stiffness / hand.stiffness)
    weight = site_weight(scene.model, scene.data, scene.model.site(scene.grip).id, length)
    if not hand.stiffness * MAX_LIFT < weight <= USUAL_FORCE_LIMIT:
        return hand
    stiffness = weight / LIFT_SAG
    damping = hand.damping * math.sqrt(stiffness / hand.stiffness)
    return replace(hand, stiffness=stiffness, damping=damping)


@cache
def _machine_code() -> Callable[[NDArray[np.void], NDArray[np.float64], NDArray[np.void]], None]:
    """Returns the compiled step; cached, because looking up the types takes a millisecond."""
    return direct(
        next_sample, np.zeros(1, STATE_DTYPE), np.empty((0, 8)), np.zeros(1, SAMPLE_DTYPE)
    )


def _check_hands(
    hand: Hand | WorstHand | None, rotational_hand: WorstHand | None, friction: float
) -> None:
    if hand is not None and not isinstance(hand, Hand | WorstHand):
        raise DeviceError(f"hand is {shown(hand)}; it must be a Hand, a WorstHand or None")
    is_line = isinstance(hand, WorstHand)
    if rotational_hand is not None and not is_line:
        raise DeviceError("a rotational worst hand requires a worst hand in translation too")
    if is_line and friction:
        raise DeviceError(f"friction = {friction!r} N: a worst hand is linear and has none")


def _target(
    hand: Hand | WorstHand | None, path: str | os.PathLike[str] | Motion | None
) -> tuple[NDArray[np.float64], float | None]:
    """Returns the table of the hand's path and its duration in s; an empty one without a path."""
    if not isinstance(hand, Hand) or path is None:
        return np.empty((0, 8)), None
    if not isinstance(path, str | os.PathLike | Motion):
        raise DeviceError(f"path is {shown(path)}; it must be a file or a Motion")
    motion = path if isinstance(path, Motion) else read_motion(path)
    return np.array(motion.relative().table, order="C"), motion.duration


class SimulatedDevice:
    """Six-axis device with inertia and damping, held by a hand that follows a path.

    Per axis of the device's frame, between two samples with a held force F,

        (m_d + m_h) v' = F − f_c sign(v) − b v − b_h (v − ṗ) − k_h (x − p)

    is solved exactly (``sampled_axis``), with a target p that moves linearly between its poses at
    the samples. Euler at a twentieth of the period would shift the stability limit by 5 %. Friction
    sticks and slips exactly within the period.

    Rotation follows the same law with the rotation vector e = log(R R_pᵀ) in place of x − p and R ←
    exp(δ) R. The inertia is isotropic, so there is no gyroscopic torque. The solution is exact
    while rotation, target and torque share one axis and the angle to the target stays below π.
    Otherwise e' = ω within the period holds to first order in the angle from the target. The
    composition of rotations about changing axes holds to third order in the period. At π the
    hand's torque reverses.

    With ``dof`` 3 the device neither turns nor feels torque, as a Falcon.

    Wrenches are not clipped; the guard that sends them applies the limits.

    Args:
        mass: m_d in kg, > 0.
        damping: b in N s/m, >= 0.
        rotational_inertia: Rotational inertia in kg m², > 0.
        rotational_damping: Rotational damping in N m s/rad, >= 0.
        hand: The hand. None: the device is free and the path is not used. A ``WorstHand``
            represents device and hand together: mass, damping and path are then not used, and the
            orientation is fixed without a ``rotational_hand``.
        rotational_hand: Worst hand for rotation, in N m s/rad; only beside a ``WorstHand``.
        path: Target of the hand, relative to its first pose, in the device's frame: a CSV file
            (``read_motion``), a motion, or None for a slow Lissajous figure (``lissajous``). After
            the end of a motion the hand stays at its last pose.
        resolution: Step of the reported position in m, >= 0; 0 reports it exactly.
        rotational_resolution: Step of the reported rotation vector's components in rad, >= 0.
        friction: Coulomb friction f_c per axis of translation in N, >= 0.
        dof: 6, or 3 for a device without rotation.
        delay: Whole samples from a write until the motors act, 0 to 100. The data sheet calls a
            delay unknown, and then the device is not judged.
        force_limit: Force limit of the data sheet in N, > 0.
        torque_limit: Torque limit of the data sheet in N m, > 0.
        speed_limit: Speed limit of the data sheet in m/s, >= 0.

    Raises:
        DeviceError: A value is out of range, or the path cannot be read.
    """

    def __init__(
        self,
        *,
        mass: float = 0.1,
        damping: float = 2.0,
        rotational_inertia: float = 1e-4,
        rotational_damping: float = 2e-3,
        hand: Hand | WorstHand | None = DEFAULT_HAND,
        rotational_hand: WorstHand | None = None,
        path: str | os.PathLike[str] | Motion | None = None,
        resolution: float = 0.0,
        rotational_resolution: float = 0.0,
        friction: float = 0.0,
        dof: int = 6,
        delay: int = 0,
        force_limit: float = USUAL_FORCE_LIMIT,
        torque_limit: float = USUAL_TORQUE_LIMIT,
        speed_limit: float = USUAL_SPEED_LIMIT,
    ) -> None:
        if isinstance(delay, bool) or not isinstance(delay, int) or not 0 <= delay <= MAX_DELAY:
            raise DeviceError(f"delay is {delay!r}; it must be 0 to {MAX_DELAY} whole samples")
        if dof not in (3, 6):
            raise DeviceError(f"dof is {shown(dof)}; it must be 3 or 6 degrees of freedom")
        mass = checked_number("mass", mass, "kg", is_positive=True)
        inertia = "kg m²"
        rotational_inertia = checked_number(
            "rotational_inertia", rotational_inertia, inertia, is_positive=True
        )
        _check_hands(hand, rotational_hand, friction)
        self._motion, duration = _target(hand, path)
        self.info = DeviceInfo(
            name="simulated",
            axes=AXES[:dof],
            mass=mass,
            damping=damping,
            rotational_inertia=rotational_inertia,
            rotational_damping=rotational_damping,
            friction=friction,
            resolution=resolution,
            force_limit=force_limit,
            torque_limit=torque_limit,
            speed_limit=speed_limit,
            delay=None if delay else 0.0,  # in samples, so its time is not known yet
            is_delay_measured=True,
            is_real=False,
            duration=duration,
            buttons=0,
        )
        holder = hand if isinstance(hand, Hand) else NO_HAND
        self._translation = {
            "inertia": mass + holder.mass,
            "damping": damping,
            "hand_damping": holder.damping,
            "stiffness": holder.stiffness,
            "friction": friction,
        }
        self._rotation = {
            "inertia": rotational_inertia + holder.rotational_inertia,
            "damping": rotational_damping,
            "hand_damping": holder.rotational_damping,
            "stiffness": holder.rotational_stiffness,
            "friction": 0.0,
        }
        self.hand = hand
        self._lines = (hand if isinstance(hand, WorstHand) else None, rotational_hand)
        self._rotational_resolution = checked_number(
            "rotational_resolution", rotational_resolution, "rad"
        )
        self._delay = delay
        self._states = np.zeros(1, STATE_DTYPE)
        # a memoryview assigns six numbers in 0.05 µs, NumPy in 0.15 µs
        self._written = memoryview(self._states["written"][0, :dof].data)
        if dof == 3:
            self._motion[:, 4:] = 1.0, 0.0, 0.0, 0.0
        self._is_started = False

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        """Places the device at rest at the origin, and compiles the functions of the loop.

        With ``parts`` the device takes that many steps per period; the delay remains in whole
        periods.

        Raises:
            DeviceError: The period is not valid, is too long for a stiff hand with friction, or
                differs from the period of a worst hand; the delay is more than 100 parts.
        """
        period = checked_period(period) / parts
        if self._delay * parts > MAX_DELAY:
            raise DeviceError(
                f"delay = {self._delay} samples: with {parts} ticks per period it must be at most "
                f"{MAX_DELAY // parts}"
            )
        state = np.zeros((), STATE_DTYPE)
        state["period"] = period
        state["holder"] = ON_A_LINE if self._lines[0] else FREE if self.hand is None else IN_A_HAND
        for name, line in zip(("translation_line", "rotation_line"), self._lines, strict=True):
            if line is not None:
                if line.period != period:
                    raise DeviceError(
                        f"the worst hand is tuned to a period of {line.period:g} s, the loop's is "
                        f"{period:g} s"
                    )
                state[name] = line.recursion()
        state["quaternion"][0] = state["target_quaternion"][0] = 1.0
        state["resolution"] = self.info.resolution
        state["rotational_resolution"] = self._rotational_resolution
        state["delay"] = self._delay * parts
        state["translation"] = sampled_axis(period, **self._translation)
        state["rotation"] = sampled_axis(period, **self._rotation)
        self._states[0] = state
        sample = np.zeros(1, SAMPLE_DTYPE)
        self._next_sample = _machine_code()
        self._next_sample(self._states.copy(), self._motion, sample)
        self._is_started = True
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        """Advances by one period (not at the first call) and returns the pose, without buttons."""
        if not self._is_started:
            raise DeviceError(
                "the simulated device is read before it was started; call start() first"
            )
        self._next_sample(self._states, self._motion, sample)
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Holds a wrench on the handle until the next write, ``delay`` samples later."""
        self._written[:] = wrench.data[: len(self._written)]

    def displace(self, offset: NDArray[np.float64]) -> None:
        """Displaces the device before its first sample, in m and rad (rotation vector).

        Raises:
            DeviceError: The device was not started, or has been read already.
        """
        state = self._states[0]
        if not self._is_started or state["tick"] > 0:
            raise DeviceError(
                "a device can be displaced only after its start and before its first sample"
            )
        state["position"] += offset[:3]
        from scipy.spatial.transform import Rotation  # noqa: PLC0415 - 0.3 s, and no run needs it

        x, y, z, w = Rotation.from_rotvec(offset[3:]).as_quat(canonical=True)
        state["quaternion"] = w, x, y, z

    @property
    def stepper(self) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        """State and motion for ``next_sample``, for loops that are fully compiled.

        The newest wrench is the state's field ``written``.
        """
        return self._states, self._motion

    def close(self) -> None:
        """Ends the force."""
        self._states["written"] = 0.0

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity in m/s and angular velocity in rad/s at the newest sample, shape (6,)."""
        state = self._states[0]
        return np.concatenate([state["velocity"], state["angular_velocity"]])


class GrippingDevice:
    """A device with another one, which has one axis, as its grip axis.

    Args:
        device: What the hand holds.
        grip: What the fingers close; its first axis is the grip axis, in m, and rises as it closes.
        travel: How far it closes in m; None if unknown.

    Attributes:
        info: The sheet of the first, with that of the second as ``grip_axis``.
    """

    def __init__(self, device: Device, grip: Device, travel: float | None = None) -> None:
        self._device, self._grip = checked(device), checked(grip)
        sheet = replace(grip.info, name=f"grip of {device.info.name}", axes=("x",), reach=travel)
        self.info = replace(device.info, grip_axis=sheet)

    def start(self, period: float) -> NDArray[np.void]:
        """Starts both; returns the pose and the grip's, (2,).

        Raises:
            DeviceError: One of them cannot run at this period.
        """
        return np.concatenate([self._device.start(period), self._grip.start(period)])

    def read(self, sample: NDArray[np.void]) -> int:
        """Reads the pose, and into a second sample the grip.

        Raises:
            DeviceLost: One of them is gone, or silent for too long.
        """
        flags = self._device.read(sample[:1])
        if sample.size > 1:
            flags |= self._grip.read(sample[1:2])
        return flags & int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands the wrench, (6,), or with that of the grip axis, (2, 6).

        Raises:
            DeviceLost: One of them is gone.
        """
        both = np.zeros((2, 6)) if wrench.ndim == 1 else wrench
        with ExitStack() as stack:  # if the first fails, the second still gets its own
            stack.callback(self._grip.write, both[1])
            self._device.write(wrench if wrench.ndim == 1 else both[0])

    def close(self) -> None:
        """Closes both."""
        with ExitStack() as stack:
            stack.callback(self._grip.close)
            self._device.close()
