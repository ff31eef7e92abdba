"""Recorded motion as a device, the hand behind it as a model, and the repetition of a run."""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.clock import Clock, SimulatedClock
from hapticbridge.demand.loop_setting import delay_ticks
from hapticbridge.demand.trip import TripCode
from hapticbridge.device import AXES, Device, DeviceInfo, Hand, Motion
from hapticbridge.device.simulated.device import GrippingDevice, SimulatedDevice
from hapticbridge.device.trajectory import ReplayDevice, TrajectoryDevice
from hapticbridge.errors import SafetyTrip
from hapticbridge.kernel.record import TickFlag
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import CHANGES as COMMANDED
from hapticbridge.run.commands import concerns, coupling_in, tuning_ticks
from hapticbridge.run.description import CARRIED, sample_at
from hapticbridge.run.hands import Grasp
from hapticbridge.run.unpacked import load_unpacked
from hapticbridge.scene import Scene
from hapticbridge.whatif.recorded import RecordedRun, changed_request
from hapticbridge.whatif.settings import GAINS, Settings

# Recorded motion as a device, and recorded times as a clock

_STALE = int(TickFlag.STALE_SAMPLE)


class RecordedClock:
    """Clock that replays the times of a recording.

    Its device reports reading and writing. The tick that follows the recorded ones, in which a
    guard stopped the run, comes a period after them.
    """

    name = SimulatedClock.name
    may_wait = True

    def __init__(self, ticks: NDArray[np.void], period: float) -> None:
        deadline = ticks["deadline_ns"]
        late = (ticks["flags"] & int(TickFlag.OVERRUN)) != 0
        between = np.diff(deadline, prepend=0) // round(1e9 * period) - 1
        skipped = np.where(late, np.maximum(between, 1), 0)
        columns = deadline, ticks["wake_ns"], skipped, ticks["read_ns"], ticks["write_ns"]
        self._rows = list(zip(*(column.tolist() for column in columns), strict=True))
        after = [int(column[-1]) + round(1e9 * period) for column in columns]
        self._rows.append((after[0], after[1], 0, after[3], after[4]))
        self._tick, self._now = -1, 0

    def start(self, period_ns: int) -> None:
        """Does nothing; the times are recorded."""

    def wait(self) -> tuple[int, int, int]:
        """Advances to the next recorded tick; see ``Clock.wait``."""
        self._tick = min(self._tick + 1, len(self._rows) - 1)
        deadline, self._now, skipped, *_ = self._rows[self._tick]
        return deadline, self._now, skipped

    def now(self) -> int:
        """Returns the recorded time of the latest action."""
        return self._now

    def note_read(self) -> None:
        """Notes that the device was read."""
        self._now = self._rows[self._tick][3]

    def note_written(self) -> None:
        """Notes that the wrench was sent."""
        if self._tick >= 0:
            self._now = self._rows[self._tick][4]


class Outside:
    """Recorded buttons and stale samples, resampled to another rate.

    ``period`` is the recorded period in s.
    """

    def __init__(self, ticks: NDArray[np.void], period: float) -> None:
        self._pressed, self._period = ticks["buttons"].copy(), period
        self._stale = ticks["flags"] & _STALE
        self._tick, self._share = 0, 1.0

    def start(self, period: float) -> None:
        """Starts at the first tick of a loop with this period in s."""
        self._tick, self._share = 0, period / self._period

    def read(self, sample: NDArray[np.void]) -> int:
        """Puts the next tick's buttons into a sample; after the last tick they stay.

        Returns:
            ``STALE_SAMPLE`` for a stale sample, else 0.
        """
        row = int(self._tick * self._share + 1e-9)  # a period in decimals is rounded
        row = min(row, len(self._stale) - 1)
        self._tick += 1
        sample["buttons"] = self._pressed[row]
        return int(self._stale[row])


class RecordedMotion(ReplayDevice):
    """Device that replays the recorded samples, one per tick.

    The motion is prescribed at any force, which is exact but no hand: it presses as deep into a
    stiffer wall as into the recorded one. The data sheet is the recorded device's, so that guard
    and controller act as with it. With recorded times and unchanged settings, the run equals the
    recorded one in every bit. At least two rows are needed.

    Raises:
        DeviceError: See ``ReplayDevice``.
    """

    def __init__(self, run: RecordedRun, clock: RecordedClock) -> None:
        super().__init__(run.ticks, run.period)
        self.info = _replay_info(run.info, self.info)
        self._clock, self._before = clock, run.parameters.device_start
        self._news = iter((run.ticks["flags"] & _STALE).tolist())

    def start(self, period: float) -> NDArray[np.void]:
        """Implements ``Device.start``."""
        return placed(super().start(period), self._before)

    def read(self, sample: NDArray[np.void]) -> int:
        """Implements ``Device.read``."""
        super().read(sample)
        self._clock.note_read()
        return next(self._news, 0)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Ignores the wrench; the motion is prescribed."""
        self._clock.note_written()


class ResampledMotion(TrajectoryDevice):
    """Device that replays the recorded motion at another rate.

    Positions are interpolated linearly, orientations by slerp. At least two rows are needed.
    """

    def __init__(self, run: RecordedRun) -> None:
        ticks, times = run.ticks, run.period * np.arange(len(run.ticks))
        super().__init__(Motion(times, ticks["device_position"], ticks["device_quaternion"]))
        self.info = _replay_info(run.info, self.info)
        self._before, self._last = run.parameters.device_start, b""
        self._outside = Outside(ticks, run.period)

    def start(self, period: float) -> NDArray[np.void]:
        """Implements ``Device.start``."""
        self._outside.start(period)
        return placed(super().start(period), self._before)

    def read(self, sample: NDArray[np.void]) -> int:
        """Implements ``Device.read``."""
        before = self._last
        super().read(sample)
        self._last = sample[["position", "quaternion"]].tobytes()
        flags = self._outside.read(sample)
        return flags if self._last == before else 0  # a changed pose is a new sample


def placed(sample: NDArray[np.void], pose: tuple[float, ...]) -> NDArray[np.void]:
    """Returns a sample at a pose (7,), with the buttons of another sample."""
    there = sample_at(pose)
    there["buttons"] = sample["buttons"]
    return there


def _replay_info(info: DeviceInfo, own: DeviceInfo) -> DeviceInfo:
    """Returns the recorded data sheet without motors, with the duration of the replay."""
    return replace(info, is_real=False, duration=own.duration)


# Intended motion of a recorded hand

INTENT = 8e-3
"""Standard deviation in s of the Gaussian that smooths the hand's intended motion. It halves motion
at 23 Hz, faster than an arm moves on purpose. A longer one loses fast strokes, a shorter one keeps
noise."""


def intended(
    info: DeviceInfo, hand: Hand, ticks: NDArray[np.void], period: float, start: tuple[float, ...]
) -> Array:
    """Returns the hand's intended motion p, as a ``Motion.table`` relative to the start.

    A recording shows the motion of a hand, not its intent. The hand must have applied f = m a + b v
    − w, with the device's m and b and the wrench w sent to it. Replayed as a function of time, f is
    a hand without stiffness and damping: a millinewton too much makes it drift away without end.
    The hand is therefore modelled as ``device.Hand``, a measured arm or the scene's own, which
    pulls with spring and damper towards p:

        b_h p' + k_h p = (m + m_h) a + (b + b_h) v + k_h x − w + f_c sign(v)

    This p reproduces the recorded motion; the response to other forces is an assumption of the
    model. p is smoothed, because a person's intent is slow and the second derivative of rounded
    positions is noise.

    Rotation follows the same law with rotation vectors from the start's orientation. It is exact
    about one axis, and a good approximation for angles well below π. ``start`` is the device pose
    (7,) before the first tick.
    """
    origin = Rotation.from_quat(np.array(start[3:]), scalar_first=True)
    turned = Rotation.from_quat(ticks["device_quaternion"], scalar_first=True) * origin.inv()
    wrench = _mean_wrench(ticks["wrench_on_device"], delay_ticks(info, period) or 0)
    wanted = [
        _solve_intent(moved, force, period, (m + m_h, b + b_h, b_h, k_h, friction))
        for moved, force, m, m_h, b, b_h, k_h, friction in (
            (
                ticks["device_position"] - np.array(start[:3]),
                wrench[:, :3],
                info.mass or 0.0,
                hand.mass,
                info.damping or 0.0,
                hand.damping,
                hand.stiffness,
                info.friction or 0.0,
            ),
            (
                turned.as_rotvec(),
                wrench[:, 3:] * float(info.turns),
                info.rotational_inertia or 1e-4,
                hand.rotational_inertia,
                info.rotational_damping or 0.0,
                hand.rotational_damping,
                hand.rotational_stiffness,
                0.0,
            ),
        )
    ]
    table = np.column_stack(
        [
            period * np.arange(len(ticks)),
            wanted[0],
            Rotation.from_rotvec(wanted[1]).as_quat(canonical=True, scalar_first=True),
        ]
    )
    return np.ascontiguousarray(table)


def _mean_wrench(wrench: Array, delay: int) -> Array:
    """Averages the wrenches that acted before and after each sample."""
    acting = np.concatenate([np.zeros((delay + 1, 6)), wrench])
    return np.asarray(0.5 * (acting[: len(wrench)] + acting[1 : len(wrench) + 1]))


def _solve_intent(
    moved: Array, force: Array, period: float, law: tuple[float, float, float, float, float]
) -> Array:
    """Solves b_h p' + k_h p = M a + β v + k_h x − w + f_c sign(v) for p, by the bilinear rule.

    The rule is stable, and it suppresses the noise of central differences at half the rate.
    """
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415 - with scipy.signal 0.6 s
    from scipy.signal import lfilter  # noqa: PLC0415

    inertia, damping, hand_damping, stiffness, friction = law
    padded = np.concatenate([moved[:1], moved, moved[-1:]])
    velocity = (padded[2:] - padded[:-2]) / (2 * period)
    acceleration = (padded[2:] - 2 * moved + padded[:-2]) / period**2
    pull = inertia * acceleration + damping * velocity + stiffness * moved - force
    pull += friction * np.sign(velocity)
    if hand_damping == 0.0:  # a hand with mass alone has no intent
        wanted = pull / stiffness if stiffness else moved
    else:
        pole = 2 * hand_damping / period + stiffness
        # the filter starts from a constant intended position
        first = pull[:1] / stiffness if stiffness else moved[:1]
        rest = first - pull[:1] / pole
        wanted, _ = lfilter([1.0, 1.0], [pole, 2 * stiffness - pole], pull, axis=0, zi=rest)
    return np.asarray(gaussian_filter1d(wanted, INTENT / period, axis=0, mode="nearest"))


# Repetition of a run's inputs, commands and pauses

_BY_STATE = (
    *(TripCode.STRETCHED, TripCode.TWISTED, TripCode.GAVE_ENERGY),
    *(TripCode.CONTACTS_FULL, TripCode.CONSTRAINTS_FULL),
)
"""Trips caused by the state after the previous tick, at any sample; that tick can be repeated."""

Event = Mapping[str, Any]


@cache
def load_bridge_code(method: str, contact: str, is_slow: bool, has_several_hands: bool) -> None:
    """Loads the machine code of a bridge, which is first compiled and kept on disk if missing.

    A child process may not write it (``recorded_scene.load_machine_code``).
    """
    options: dict[str, Any] = {"method": method, "contact": contact, "clock": SimulatedClock()}
    if is_slow:
        options["scene_rate"] = 500.0
    scene = "plug_and_socket" if has_several_hands else "point_mass"
    devices = [Grasp("plug"), Grasp("socket")] if has_several_hands else "simulated"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Bridge(scene, devices, i_know=True, **options) as bridge:
            bridge.run(4e-3)


class Repetition:
    """One repetition of a run with given settings, one per hand.

    Attributes:
        settings: Settings of the bridge, with the coupling of the first hand.
        request: What is asked of it.
        warned: Warnings about the scene, one sentence each.
    """

    def __init__(self, hands: Sequence[RecordedRun], settings: Sequence[Settings]) -> None:
        self._hands, self.settings = tuple(hands), settings[0]
        self._settings = tuple(settings)
        self._run = self._hands[0]
        self.request = changed_request(hands, settings)
        self._has_several_hands = len(self._hands) > 1
        self._per_tick = 1.0
        self.warned: tuple[str, ...] = ()

    def into(self, path: Path, devices: Sequence[Device], clock: Clock) -> float:
        """Runs into a file until its end or a trip; returns the period in s.

        Raises:
            HapticBridgeError: The changed bridge is refused; the message names the reason.
        """
        run, bridge = self._run, self._bridge(path, devices, clock)
        self._per_tick = run.period / bridge.period
        with warnings.catch_warnings(record=True) as caught, ExitStack() as stack:
            warnings.simplefilter("always", UserWarning)
            stack.enter_context(bridge)
            stack.enter_context(suppress(SafetyTrip))  # the recording has it
            self._repeat(bridge)
        # the temporary path of the unpacked scene means nothing to the reader
        messages = (getattr(each.message, "concern", str(each.message)) for each in caught)
        self.warned = tuple(dict.fromkeys(messages))
        return bridge.period

    def scene(self) -> Scene:
        """Loads the scene with the parameters of the settings, and a handle per hand.

        Raises:
            SceneError: A parameter is out of range, or the scene cannot be loaded.
        """
        is_carried = self._run.recording.meta.get("tool_weight") == CARRIED
        return load_unpacked(self._run.scene_file, self.request, is_carried=is_carried)

    def _bridge(self, path: Path, devices: Sequence[Device], clock: Clock) -> Bridge:
        """Returns the changed bridge; ``devices`` has one per hand."""
        request, own = self.request, iter(devices)
        options: dict[str, Any] = {"clock": clock, "recording": path}
        if not self._has_several_hands:
            coupling = request.grasps[0].coupling
            return Bridge(self.scene(), devices[0], coupling, request.options, **options)
        grasps = []
        for grasp in request.grasps:
            device = next(own)
            if grasp.grip_axis is not None:
                axis = next(own)
                device = GrippingDevice(device, axis, axis.info.reach)
            grasps.append(replace(grasp, device=device))
        return Bridge(self.scene(), grasps, None, request.options, **options)

    def _repeat(self, bridge: Bridge) -> None:
        due = deque(
            (math.ceil(int(event["tick"]) * self._per_tick - 1e-9), event)
            for each in self._run.recording.events
            if (event := self._action_for(each))
        )

        def on_tick(tick: int) -> None:
            commands = []
            while due and due[0][0] <= tick:
                event = due.popleft()[1]
                if event["event"] == "input":
                    bridge.repeat_input(event["writes"])
                else:
                    commands.append(event)
            if commands:
                bridge.repeat_commands(commands)

        done = 0
        for end in self._ends():
            count = round(end * self._per_tick) - done
            if count > 0:
                bridge.run(count * bridge.period, on_tick)
                done += count
        if self._was_tripped_by_state():
            bridge.run(bridge.period, on_tick)

    def _ends(self) -> list[int]:
        """Returns the ticks at which the recorded run paused, and the end."""
        events = self._run.recording.events
        pauses = [int(e["tick"]) for e in events if e.get("event") == "resume"]
        return [*pauses, len(self._run.ticks)]

    def _was_tripped_by_state(self) -> bool:
        trip = self._run.trip
        return trip is not None and trip.tick == len(self._run.ticks) and trip.code in _BY_STATE

    def _action_for(self, event: Event) -> Event | None:
        """Returns the action that repeats a recorded event under these settings, or None."""
        name = event.get("event")
        if name == "coupling":
            return self._coupling(event) if self.keeps_coupling(event) else None
        if name == "reset" and not self.keeps_resets:
            return None
        return event if name in ("input", *COMMANDED) else None

    def keeps_coupling(self, event: Event) -> bool:
        """Returns True if a recorded change of a coupling is repeated; a new coupling replaces it.

        Args:
            event: The event ``coupling``.
        """
        hand = self._hand_of(event)
        old, new = self._hands[hand].settings.coupling, self._settings[hand].coupling
        is_kept = (old.stiffness, old.damping) == (new.stiffness, new.damping)
        return is_kept and self._settings[hand].method.has_law

    def _hand_of(self, event: Event) -> int:
        return next(i for i, each in enumerate(self._hands) if concerns(event, each.parameters))

    @property
    def keeps_resets(self) -> bool:
        """True if resets are repeated; a massless tool has nothing to reset."""
        return self.settings.method.has_coupling

    def _coupling(self, event: Event) -> Event:
        """Returns the change to an equal effective coupling under these settings."""
        hand = self._hand_of(event)
        old, new = self._hands[hand].settings, self._settings[hand]
        period = 1.0 / self.settings.options.loop_rate
        if new.loop == old.loop:
            return event
        law = coupling_in(event, self._hands[hand].parameters)
        requested = old.method.requested_coupling(law, old.timestep)
        kept = {name: getattr(new.coupling, name) for name in GAINS[2:]}
        law = new.method.law_coupling(replace(requested, **kept), new.timestep)
        return {**event, **asdict(law), "ticks": tuning_ticks(period)}


Array = NDArray[np.float64]


def missing_for_closed_loop(info: DeviceInfo) -> str:
    """Returns the reason why a device's motion cannot be simulated, or empty."""
    if info.is_prescribed:
        return "the recorded motion was prescribed, so no device responded to the force"
    needed = {"mass": info.mass, "damping": info.damping}
    if info.turns:
        needed["rotational_inertia"] = info.rotational_inertia
        needed["rotational_damping"] = info.rotational_damping
    unknown = [name.replace("_", " ") for name, value in needed.items() if value is None]
    if unknown:
        return (
            f"unknown {' and '.join(unknown)} of the device; measure with 'hapticbridge identify'"
        )
    return ""


class IdentifiedDevice(SimulatedDevice):
    """The recorded device by its data sheet, in a model hand with the recorded hand's intent.

    Unlike a prescribed motion (``again``), the hand yields to the force. It needs mass and damping
    (``missing_for_closed_loop``) and at least three rows. Until the first tick the device is held
    at ``anchor_pose``.
    """

    def __init__(self, run: RecordedRun, hand: Hand) -> None:
        info, ticks, period, start = run.info, run.ticks, run.period, run.anchor_pose
        super().__init__(
            mass=info.mass or 0.0,
            damping=info.damping or 0.0,
            # without rotational axes the inertia has no effect
            rotational_inertia=info.rotational_inertia or 1e-4,
            rotational_damping=info.rotational_damping or 0.0,
            hand=hand,
            resolution=info.resolution or 0.0,
            friction=info.friction or 0.0,
            force_limit=info.force_limit,
            torque_limit=info.torque_limit,
            speed_limit=info.speed_limit,
        )
        self._motion = intended(info, hand, ticks, period, start)
        self._start = np.array(start)
        self._outside = Outside(ticks, period)
        self._has_axis = np.array([axis in info.axes for axis in AXES], dtype=np.float64)
        self.info = replace(info, is_real=False, duration=float(self._motion[-1, 0]))

    def start(self, period: float, parts: int = 1) -> NDArray[np.void]:
        """Implements ``SimulatedDevice.start``; the hand may pull from the start on."""
        self._delay = delay_ticks(self.info, period) or 0  # in ticks of this loop
        sample = super().start(period, parts)
        self._outside.start(period)
        state = self._states[0]
        state["target_position"] = self._motion[0, 1:4]
        state["target_quaternion"] = self._motion[0, 4:]
        return self._to_recorded_frame(sample)

    def read(self, sample: NDArray[np.void]) -> int:
        """Implements ``SimulatedDevice.read``."""
        flags = super().read(sample)
        # buttons only; this device always has new samples
        self._outside.read(sample)
        self._to_recorded_frame(sample)
        return flags

    def write(self, wrench: Array) -> None:
        """Implements ``SimulatedDevice.write``; components without a device axis have no effect."""
        super().write(wrench * self._has_axis)

    def _to_recorded_frame(self, sample: NDArray[np.void]) -> NDArray[np.void]:
        """Moves a sample from coordinates relative to the start to the device's coordinates."""
        sample["position"][0] += self._start[:3]
        quaternion = sample["quaternion"][0]
        mujoco.mju_mulQuat(quaternion, quaternion.copy(), self._start[3:])
        mujoco.mju_normalize4(quaternion)
        if quaternion[0] < 0.0:
            quaternion *= -1.0
        return sample
