"""Resources of an open run, and their orderly release.

``Session`` owns them. ``TickKernel`` is the arithmetic of a tick around MuJoCo's step,
``StopRequest`` a wish to end the run.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.arguments import is_number, shown
from hapticbridge.clock import Clock, RealClock, SimulatedClock, slept_ns
from hapticbridge.coupling import Coupling
from hapticbridge.dataclass_json import to_json
from hapticbridge.demand.guard import (
    refuse_implausible_pose,
    refuse_stretched_start,
    wait_until_still,
)
from hapticbridge.demand.methods import prepare, prepare_hands
from hapticbridge.demand.own_loop import EVENT as OWN_LOOP_EVENT
from hapticbridge.demand.probe import EVENT as PROBE_EVENT
from hapticbridge.demand.probe import Probed, ProbedHand, probe_devices
from hapticbridge.demand.trip import BY_TRIP, Trip, TripCode
from hapticbridge.device import Device
from hapticbridge.device.base import checked, device_remark
from hapticbridge.device.own_loop import LoopDevice
from hapticbridge.errors import DeviceError, HapticBridgeError, SafetyTrip
from hapticbridge.kernel.codes import OK, RING_FULL
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE, TickFlag
from hapticbridge.kernel.state import STATE_DTYPE, BoundHands, BoundKernel
from hapticbridge.kernel.tick import (
    answer_step,
    before_step,
    can_split,
    finish_tick,
    publish,
    publish_positions,
)
from hapticbridge.realtime import (
    Grant,
    check_pace,
    memory_at_rest,
    warn_of_refusals,
    warn_of_slow_motion,
)
from hapticbridge.recording.format import SHOWN_EVENT
from hapticbridge.recording.recorder import RecordOutput, RecordStream
from hapticbridge.recording.ring import Snapshot
from hapticbridge.run.commands import CommandExecutor, CommandQueue, EventApplier
from hapticbridge.run.description import (
    CHANGED_EVENT,
    attachments,
    change_remedy,
    changed_words,
    describe_hands,
    describe_machine,
    describe_scene,
    describe_start,
    start_state,
    state_of_scene,
    watched_fields,
    watched_state,
)
from hapticbridge.run.hands import DeviceGroup
from hapticbridge.run.options import RunSetup
from hapticbridge.run.own_loop import OwnLoop
from hapticbridge.run.posted_scene import PostedScene
from hapticbridge.run.request import RunRequest
from hapticbridge.run.slow_scene import SlowScene
from hapticbridge.run.summary import RunOutcome, Summary, hand_energy
from hapticbridge.run.unpacked import warn_of_other_scene
from hapticbridge.scene import Scene
from hapticbridge.scene.checks import strongest_actuator, working_pump
from hapticbridge.scene.inputs import Write
from hapticbridge.signals import deferring_stops

OnTick = Callable[[int], None]
"""Function called with a tick's number before the tick, for scripted inputs."""

LONGEST = 1e9
"""Longest run in s, 30 years: beyond it numbers of ticks are too large to count."""

SUSPENDED_NS = 50_000_000
"""Longest sleep of the machine in ns that a run survives. After a longer one the state of hand and
power is unknown. A smaller value could end a run without a sleep, because the two clocks are read
microseconds apart."""

CHECK_PERIOD, PICTURE_PERIOD, NOTE_PERIOD = 0.1, 1 / 30, 0.01
"""Time in s between two checks of the recorder, between two pictures for an observer, and between
two events on what another program has shown; the latter two include a check. A recorded run ends
with its recorder; a longer period finds its end later. An eye sees no more pictures. Check and
picture cost the loop 4 µs each after the wrench was sent."""

_NO_FORCE = np.zeros(6)


class StopRequest:
    """Requests to end a run, from any thread or from a signal handler.

    Attributes:
        waiting: Origin of each request, and the signal's name or an empty text. The loop tests only
            if it is empty, which needs neither a lock nor a call.
    """

    def __init__(self) -> None:
        self.waiting: deque[tuple[str, str]] = deque()

    def request(self, by: str, signal: str = "") -> None:
        """Ends the present run after its present tick, or the next run before its first tick."""
        self.waiting.append((by or "caller", signal))

    def take(self) -> tuple[str, str]:
        """Removes all requests; returns origin and signal of the last one, both empty if none."""
        last = "", ""
        while self.waiting:
            last = self.waiting.popleft()
        return last


class MarkButton:
    """Button that writes an event for each press; one held from the start marks nothing.

    Args:
        mask: Bit of the button.
        sample: The loop's sample, ``SAMPLE_DTYPE``, shape (1,).
        note: Called for each press.
    """

    def __init__(self, mask: int, sample: NDArray[np.void], note: Callable[[], None]) -> None:
        self._mask, self._buttons, self._note = mask, sample["buttons"], note
        self._was_held = True

    def look(self) -> None:
        """Compares the button with its last state."""
        is_held = bool(self._buttons[0] & self._mask)
        if is_held and not self._was_held:
            self._note()
        self._was_held = is_held


class ProbedPort:
    """Device as the probe reads and writes it: flags and a wrench per hand.

    Args:
        device: The device, or those of several hands.
    """

    def __init__(self, device: Device) -> None:
        self._device = checked(device)

    def read(self, sample: NDArray[np.void]) -> Sequence[int]:
        """Reads the newest samples; returns the flags of each."""
        flags = self._device.read(sample)
        if isinstance(self._device, DeviceGroup):
            return list(self._device.external_flags)
        return [flags]

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a wrench per hand, (n, 6)."""
        self._device.write(wrench if isinstance(self._device, DeviceGroup) else wrench[0])


class Port(NamedTuple):
    """Calls of a tick to the device.

    Attributes:
        read: Writes the newest sample and returns its flags.
        write: Sends the wrench of the tick.
    """

    read: Callable[[NDArray[np.void]], int]
    write: Callable[[NDArray[np.float64]], None]


class TickKernel:
    """Compiled arithmetic of a tick, bound to a scene, and the arrays that it works on.

    MuJoCo's steps are called through Python, because an error inside the C functions would end the
    process with the last force on the motors.

    Args:
        sample: The loop's sample, ``SAMPLE_DTYPE``, one per hand.
        stream: Receives the records.

    Attributes:
        before, answer, finish: Machine code of ``before_step``, ``answer_step`` and
            ``finish_tick`` of ``kernel.tick``.
        sample: Each device's newest sample.
        rows, cursors: Records and cursors of the ring.
        bound: Kernel state that belongs to the scene; of several hands, that of the first.
        hands: Bound states of all hands if there are several; else None.
        state, row: Bound state and record, one element per hand.
        step, first_half, second_half: MuJoCo's step for the method, and its two parts around
            the sample in a tick that was computed ahead.
        wrench: Wrench on the device, shape (6,), in N and N m; of several hands, (n, 6).
        external_flags: Flags of the sample, shape (1,), for the kernel.
        is_ahead: True if a tick computes the first half of the next one.
    """

    def __init__(self, sample: NDArray[np.void], stream: RecordStream) -> None:
        self.sample, self.rows, self.cursors = sample, stream.rows, stream.cursors
        state, row = np.zeros(sample.size, STATE_DTYPE), np.zeros(sample.size, TICK_DTYPE)
        rows, cursors = self.rows, self.cursors
        head, numbers = np.zeros(1, np.int64), np.zeros(1)
        self._publish_positions = direct(publish_positions, state, cursors, head, numbers)
        self.hands: BoundHands | None = None
        self.before: Callable[..., int]
        self.answer: Callable[..., int]
        self.finish: Callable[..., int]
        self._publish = direct(publish, row, rows, cursors, 0, 0, 0, 0, 0)
        self.before = direct(before_step, state, sample, row, 0, 0.0)
        self.answer = direct(answer_step, state, row, 0)
        self.finish = direct(finish_tick, state, row, rows, cursors, 0, 0, 0, 0, 0, True)

    def bind_hands(self, hands: BoundHands) -> None:
        """Attaches the arrays of a scene that several hands hold."""
        self.hands, self.bound = hands, hands.hands[0]
        self.state, self.row = hands.state, hands.row
        self.step, self.substeps, self.is_ahead = hands.step, range(1), False
        self.first_half, self.second_half = mujoco.mj_fwdPosition, mujoco.mj_step2
        self.external_flags = np.zeros(1, np.int64)  # each hand's state has its own
        self.wrench = hands.state["loop"]["wrench_on_device"]

    def bind(
        self, bound: BoundKernel, setup: RunSetup, slow: SlowScene | PostedScene | None
    ) -> None:
        """Attaches the arrays of a scene and the steps of a method."""
        self.bound, self.step, self.substeps = bound, bound.step, range(setup.substeps)
        self.state, self.row = bound.state, bound.row
        if slow is not None:
            self.step, self.substeps = slow.exchange, range(1)
        self.first_half, self.second_half = mujoco.mj_fwdPosition, mujoco.mj_step2
        self.is_ahead = False
        self.external_flags = bound.external_flags
        self.wrench = bound.wrench_on_device

    def publish_again(self, deadline: int, wake: int, read: int, write: int, flags: int) -> int:
        """Publishes a record that a full ring refused; returns ``OK`` or ``RING_FULL``.

        The times are those of the record, in ns of running.
        """
        times = deadline, wake, read, write
        is_taken = self._publish(self.row, self.rows, self.cursors, *times, flags)
        return OK if is_taken else RING_FULL

    def publish_positions(self, snapshot: Snapshot, bound: BoundKernel) -> None:
        """Copies the positions of a scene for an observer."""
        self._publish_positions(bound.state, self.cursors, snapshot.head, snapshot.numbers)


class Session:
    """Resources of an open run: device, bound kernel, records, commands and counters.

    Constructing it opens everything; the scene is prepared, the kernel compiled and the device
    started last, because from then on it is held. ``close`` releases in reverse order.

    Args:
        request: What the user asked for.
        setups: The setup of each hand that it resolves to.
        device: The device, open but not started; a ``DeviceGroup`` for several hands.
        clock: Clock of the run.
        output: Destinations of the records.
        stop: Requests to end the run.

    Attributes:
        setup: Setup of the first hand.
        parameters: All that decides the run's numbers, beside scene and device motion; of several
            hands, those of the first.
        hand_parameters: The parameters of each hand.
        kernel: Arithmetic of a tick.
        samples: What the device reads: a sample of each hand, and of one hand's grip axis that
            moves no joint.
        stream: Records and events on their way out.
        commands: Queue of commands.
        executor: Execution of the queue's commands.
        inputs: Waiting changes of the scene's inputs.
        beside: Scene beside the bridge's loop: one that is slower, or another program's; None for a
            scene in the loop.
        mark: The mark button; None without one.
        tick: Number of the next tick.
        end: Tick before which the run ends; −1 for none.
        signal: Name of the signal that ended the last run; empty if none did.
        last_trip: Trip that ended the last run; None without one.
        probed: Result of the probe of each hand's device; None of one that was not to be probed.
        is_open: False after ``close``.

    Raises:
        HapticBridgeError: The scene is in use, a method cannot render it, or the device cannot
            start. Everything opened until then is released.
    """

    def __init__(
        self,
        request: RunRequest,
        setups: Sequence[RunSetup],
        device: Device,
        clock: Clock,
        output: RecordOutput,
        stop: StopRequest,
    ) -> None:
        self._request, self._setups = request, tuple(setups)
        self.setup = setups[0]
        self.device, self.clock, self.output, self.stop = device, clock, output, stop
        self._calls = checked(device)
        self.tick = self.overruns = self.skipped = 0
        self.end, self._is_timed, self._slept = -1, False, 0
        self._start_potential = 0.0
        self.stopped_by = self.signal = ""
        self.last_trip: Trip | None = None
        self.probed: list[Probed | None] = [None] * len(self._setups)
        self._before_trip = np.empty(0, TICK_DTYPE)
        self._grants: tuple[Grant, ...] = ()
        self._is_begun = self._is_held = self._has_warned = self._is_hot = False
        self.beside: SlowScene | PostedScene | None = None
        self.inputs: deque[list[Write]] = deque()
        limits = {each.scene.grip: each.coupling_limits for each in self._setups}
        self.commands = CommandQueue(
            limits,
            is_recorded=output.path is not None,
            is_posted=self.setup.scene.credit > 0.0,
            now=lambda: 1e-9 * clock.now(),
        )
        with ExitStack() as resources:
            resources.callback(self._calls.close)  # ``_open`` says why it is called twice
            self._open(resources)
            resources.callback(self.command_zero_force)
            self._watched = watched_fields(self.setup.scene.model)
            self._parts = state_of_scene(self.setup.scene.model)
            self._written: set[str] = set()
            self._keep_state()
            self._resources = resources.pop_all()
        self._is_begun = self.is_open = True

    def _open(self, resources: ExitStack) -> None:
        """Opens everything in order; what is registered last is closed first.

        The device's ``close``, which may be called again, is registered twice. The first one, by
        the constructor, closes a device that was never started because something else failed. The
        second one, before the start, ends the force of a started device at once: to close the
        scene or the recording may take long.
        """
        setup, scene, clock = self.setup, self.setup.scene, self.clock
        scene.claim()
        resources.callback(self._release_scene)
        if not setup.tool_weight and not scene.is_carried:
            scene.carry_tool("--no-tool-weight")
        effective = self._prepare(scene)
        if self.output.path is not None:
            warn_of_other_scene(scene, self._request, self.output.path, self._prepare)
        with deferring_stops():
            self._snapshot = None if self.output.observer is None else Snapshot.shared(scene.model)
            if self._snapshot is not None:
                resources.callback(self._snapshot.close)
            self.stream = RecordStream(
                self.output,
                setup.period,
                may_wait=clock.may_wait,
                snapshot=str(self._snapshot and self._snapshot.name),
                hands=len(self._setups),
            )
            resources.callback(self._close_stream)
        self.samples = np.zeros(len(self._setups) + self._has_free_grip, SAMPLE_DTYPE)
        sample = self.samples[: len(self._setups)]
        self.kernel = TickKernel(sample, self.stream)
        if clock.name == RealClock.name:
            pace = scene, setup.method, setup.scene_period, setup.substeps
            if setup.scene_ticks:
                warn_of_slow_motion(*pace)
            else:
                check_pace(*pace, is_real=self.device.info.is_real)
        if setup.is_realtime:
            self._grants = resources.enter_context(memory_at_rest())
        resources.callback(self._close_scene)
        resources.callback(self._calls.close)
        self.samples[:] = self._calls.start(setup.period)[: self.samples.size]
        for each, own in zip(self._setups, self._samples(), strict=True):
            refuse_implausible_pose(each.info, own)
        self.hand_parameters = self._parameters(effective)
        self.parameters = self.hand_parameters[0]
        start = start_state(scene.model, scene.data).tobytes()
        self._bind(resources)
        bound = self.kernel.bound
        self._refuse_stretched_start()
        if self.stream.is_read:
            self._start_stream()
        if self.output.observer is not None:
            self.commands.warm_up()
        bounds = (self.kernel.hands or bound).hands
        parts = tuple(zip(bounds, self.hand_parameters, strict=True))
        self._open_port(bound)
        self._applier = EventApplier(parts, scene.data, setup.method, start, self.beside)
        fade_ticks = max(each.guard.fade_ticks for each in self._setups)
        self.executor = CommandExecutor(self.commands, self._applier, fade_ticks, self.event)
        self.mark: MarkButton | None = None
        if setup.mark:
            self.mark = MarkButton(setup.mark, sample, lambda: self.event("mark", by="button"))
        self._chore_ticks = max(round(self._chore_period / setup.period), 1)

    def _open_port(self, bound: BoundKernel) -> None:
        """Makes the port to the device, or to a loop of its own."""
        self._port = Port(self._calls.read, self._calls.write)
        self._own_loop: OwnLoop | None = None
        if self.parameters.is_apart:
            device = cast(LoopDevice, self.device)
            self._own_loop = own = OwnLoop(device, bound, self.parameters)
            self._port = Port(own.read, own.write)

    @property
    def slow(self) -> SlowScene | None:
        """Loop of a scene that is slower than the bridge's; None without one."""
        return self.beside if isinstance(self.beside, SlowScene) else None

    @property
    def port(self) -> Port:
        """Port to the device: itself, or what shows the tool to a loop of its own."""
        return self._port

    @property
    def posted(self) -> PostedScene | None:
        """Scene that another program steps; None for another scene."""
        return self.beside if isinstance(self.beside, PostedScene) else None

    @property
    def _has_free_grip(self) -> bool:
        return len(self._setups) == 1 and self.device.info.grip_axis is not None

    @property
    def _chore_period(self) -> float:
        if self.posted is not None:
            return NOTE_PERIOD
        return CHECK_PERIOD if self._snapshot is None else PICTURE_PERIOD

    def _prepare(self, scene: Scene) -> Coupling | None:
        """Prepares the scene, or the same from its recording; returns a weld's coupling."""
        setup = self.setup
        if not scene.has_several_hands:
            pace = setup.scene_period, setup.substeps
            return prepare(scene, setup.coupling, *pace, setup.method)
        self._update_scenes()  # the model may have been replaced since they were resolved
        couplings = [each.coupling for each in self._setups]
        prepare_hands(scene, couplings, setup.period, setup.method)
        return None

    def _update_scenes(self) -> None:
        scene = self.setup.scene
        self._setups = tuple(
            replace(each, scene=scene.of_hand(hand)) for hand, each in enumerate(self._setups)
        )

    def _samples(self) -> list[NDArray[np.void]]:
        """Returns each hand's sample as a view, shape (1,)."""
        sample = self.kernel.sample
        return [sample[hand : hand + 1] for hand in range(sample.size)]

    def _parameters(self, effective: Coupling | None) -> list[RunParameters]:
        """Returns the parameters of each hand; a tool that is too heavy for one is carried."""
        if not self.setup.scene.has_several_hands:
            return [self.setup.holding(self.kernel.sample, effective)]
        for _ in range(2):
            pairs = zip(self._setups, self._samples(), strict=True)
            parameters = [each.parameters(own, None) for each, own in pairs]
            reasons = map(RunSetup.overload, self._setups, parameters)
            reason = next(filter(None, reasons), "")
            if not reason:
                break
            self.setup.carry(reason)
            self._update_scenes()
        return parameters

    def _bind(self, resources: ExitStack) -> None:
        """Binds the kernel of all hands, or of one and the loop of a slower scene."""
        scene, parameters = self.setup.scene, self.parameters
        if isinstance(self.device, DeviceGroup):
            hands = BoundHands(scene.model, scene.data, self.hand_parameters)
            resources.callback(hands.release)
            self.kernel.bind_hands(hands)
            self.device.external_flags = hands.state["loop"]["external_flags"]
            return
        bound = BoundKernel(scene.model, scene.data, parameters)
        resources.callback(bound.release)
        if parameters.credit > 0.0:
            self.beside = PostedScene(bound, scene.data, parameters)
        elif parameters.scene_ticks:
            self.beside = slow = SlowScene(bound, scene.model, scene.data, parameters)
            if not self.clock.may_wait:
                slow.start()
        self.kernel.bind(bound, self.setup, self.beside)

    def _refuse_stretched_start(self) -> None:
        """Refuses an absolute pose of a device that is too far from its grip."""
        for hand, (each, own) in enumerate(zip(self._setups, self._samples(), strict=True)):
            if each.workspace.absolute:
                state = self.kernel.state[hand : hand + 1]
                grip = each.scene.grip if self.setup.scene.has_several_hands else ""
                refuse_stretched_start(state, own, each.limits, grip)

    def _description(self) -> dict[str, str]:
        of_hands = [
            self._request.description(each, self.hand_parameters[hand])
            | describe_start(self.kernel.state[hand : hand + 1])
            for hand, each in enumerate(self._setups)
        ]
        return {
            **describe_hands(of_hands),
            **describe_scene(self.setup.scene),
            **describe_machine(),
            "request": to_json(self._request),
        }

    def close(self, error: BaseException | None) -> None:
        """Records the end, commands zero force, and closes recording, scene and device.

        ``error`` is the exception that ended the run; None without one.
        """
        self.is_open = False
        if not self.tick and (self.signal or isinstance(error, KeyboardInterrupt)):
            self._is_begun = False
        is_failed = error is not None and self.last_trip is None
        self._note_shown()
        self._note_own_loop()
        if changed := self._changed_fields():
            self.event(CHANGED_EVENT, fields=changed)
        self.event(
            "stop",
            reason="error" if is_failed else self.stopped_by,
            **({} if error is None else {"error": f"{type(error).__name__}: {error}"}),
            **self._signal_detail(),
            overruns=self.overruns,
            skipped=self.skipped,
            dropped=self.stream.dropped,
        )
        self._resources.close()

    def _changed_fields(self) -> str:
        """Returns the fields of the model that a program changed since the start; else empty."""
        now = watched_fields(self.setup.scene.model)
        fields = [name for name, value in self._watched.items() if now.get(name) != value]
        return ", ".join((*fields, *sorted(self._written)))

    def watching(self, on_tick: OnTick | None) -> OnTick | None:
        """Returns a function that calls a program's, and notes what it writes to the state."""
        if on_tick is None:
            return None

        def watched(tick: int) -> None:
            self._keep_state()
            on_tick(tick)
            self._compare_state()

        return watched

    def _keep_state(self) -> None:
        """Keeps the state, unless a scene changes it in a thread of its own."""
        is_still = self.beside is None or self.clock.may_wait
        data = self.setup.scene.data
        self._state = watched_state(data, self._parts) if is_still else {}

    def _compare_state(self) -> None:
        """Notes the fields of the state that are not what they were when it was kept."""
        if self._state:
            now = watched_state(self.setup.scene.data, self._parts)
            self._written |= {name for name in now if now[name] != self._state[name]}

    def _close_scene(self) -> None:
        if self.beside is not None:
            self.beside.close()

    def _release_scene(self) -> None:
        """Releases the scene, unless a step still works on it."""
        scene = self.setup.scene
        if self.beside is None or not self.beside.is_running:
            scene.release()
            return
        warnings.warn(
            f"a step of scene '{scene.name}' still runs; load the scene again for another run",
            stacklevel=2,
        )

    def _start_stream(self) -> None:
        scene = self.setup.scene
        self.stream.start(self._description(), attachments(scene))
        self.event("start")
        for sentence in scene.findings:
            self.event("finding", sentence=sentence)

    def _close_stream(self) -> None:
        """Finishes the recording, or removes that of a run that never began."""
        self.stream.close(is_discarded=not self._is_begun)

    def begin(self, duration: float | None, *, has_program: bool = False) -> None:
        """Sets the end of a run and its event; a later run starts with a ramp of the force.

        With a program between the ticks nothing is computed ahead, because it may call MuJoCo's
        functions for the scene's data, which would overwrite that.

        Raises:
            HapticBridgeError: The duration is not finite and > 0.
        """
        period = self.setup.period
        if duration is not None and not (is_number(duration) and 0.0 < duration <= LONGEST):
            raise HapticBridgeError(
                f"duration is {shown(duration)} s; it must be a number > 0, at most {LONGEST:g}"
            )
        self._compare_state()  # what a program wrote since the last run
        if not self.tick:
            self._start_potential = float(self.kernel.state["energy"]["potential"][0])
        self._is_timed = duration is not None
        length = self.device.info.duration
        if duration is not None:
            self.end = self.tick + max(round(duration / period), 1)
        elif length is not None:
            self.end = max(self.tick, round(length / period) + 1)
        else:
            self.end = -1
        if self.tick:  # the device may have moved meanwhile, under zero force
            (self.kernel.hands or self.kernel.bound).resume()
            if self._own_loop is not None:
                self._own_loop.begin()
            self.event("resume", reason=self.stopped_by, **self._signal_detail())
        self.stopped_by = self.signal = ""
        self.last_trip = None
        self._before_trip = np.empty(0, TICK_DTYPE)
        # a callback that forbids the split may have been set since the bridge was opened
        model, method = self.setup.scene.model, self.setup.method
        may_split = self.beside is None and can_split(model, method.scheme)
        self.kernel.is_ahead = self.setup.is_pipelined and may_split and not has_program

    def note_grants(self, grants: tuple[Grant, ...]) -> None:
        """Records the answers of the system to the real-time requests; warns once of refusals."""
        if not self.tick:
            warn_of_refusals(self._grants + grants)
        answers = {grant.name: grant.sentence for grant in self._grants + grants}
        self.event("real_time", **answers)

    def start_clock(self) -> None:
        """Waits until the real devices are still, probes them, and starts the time of the run.

        A simulated hand beside them is not read meanwhile: its motion begins with the run.

        Raises:
            DeviceError: The device keeps moving, a hand moved one with absolute poses too far, or
                an axis is reversed or exchanged.
        """
        setup, waiting, sample = self.setup, self.stop.waiting, self.kernel.sample
        device, hands = self.device, list(range(sample.size))
        if isinstance(device, DeviceGroup) and device.info.is_real:
            device, hands = device.real_ones()
        newest = sample[hands]
        wait_until_still(device, newest, setup.period, self.clock, lambda: waiting)
        sample[hands] = newest
        if not self.tick and not waiting:
            self._refuse_stretched_start()
            # a clock of another kind drives the device, which a probe would leave behind
            keeps_time = isinstance(self.clock, RealClock | SimulatedClock)
            if keeps_time and any(self._setups[i].is_probed for i in hands):
                self._probe(device, hands, newest)
                sample[hands] = newest
                self._refuse_stretched_start()
        self.clock.start(round(setup.period * 1e9))
        self._slept = slept_ns()

    def _probe(self, device: Device, hands: Sequence[int], sample: NDArray[np.void]) -> None:
        """Probes the devices of some hands, and records the findings; ``sample`` is theirs."""
        clock = type(self.clock)()  # the run's time begins with its first tick
        clock.start(round(self.setup.period * 1e9))
        setups, waiting = [self._setups[i] for i in hands], self.stop.waiting
        probed_hands = [
            ProbedHand(
                each.info,
                each.limits,
                each.period,
                has_dead_man=each.guard.dead_man != 0,
            )
            for each in setups
        ]
        results = probe_devices(ProbedPort(device), sample, probed_hands, clock, lambda: waiting)
        for i, each, probed in zip(hands, setups, results, strict=True):
            self.probed[i] = probed
            grip = {"grip": each.scene.grip} if len(self._setups) > 1 else {}
            self.event(PROBE_EVENT, **grip, **probed.details(each.info, each.period))
        for each, probed in zip(setups, results, strict=True):
            probed.refuse_wrong_axes(each.info)

    def take_changes(self) -> None:
        """Applies waiting inputs and one command before a tick, and records them."""
        while self.inputs:
            writes = self.inputs.popleft()
            self._applier.write(writes)
            self.event("input", writes=writes)
        if self.commands.waiting or self.executor.later:
            self.executor.act(self.tick)

    def do_chores(self) -> int:
        """Publishes the scene's positions and checks the recorder; returns the next due tick.

        Raises:
            RecordingError: The recorder ended, or its disk is full.
        """
        if self._snapshot is not None:
            publish = partial(self.kernel.publish_positions, self._snapshot)
            if self.beside is None:
                publish(self.kernel.bound)
            else:
                self.beside.note_picture(publish)
        self.stream.look()
        self._note_own_loop()
        if self.beside is not None:
            self._note_shown()
            self._look_after(self.beside)
        return self.tick + self._chore_ticks

    def _note_own_loop(self) -> None:
        """Records what a loop of the device's own has reported; warns once of hot motors."""
        if self._own_loop is not None and (notes := self._own_loop.take_notes()):
            self.event(OWN_LOOP_EVENT, **notes)
            account = self._own_loop.tally.account
            if account.is_hot and not self._is_hot:
                self._is_hot = True
                warnings.warn(
                    f"{self.device.info.name}: {account.heat}; let them rest", stacklevel=2
                )

    def _note_shown(self) -> None:
        """Records what another program has shown since the last call."""
        if self.posted is not None and (notes := self.posted.take_notes()):
            self.event(SHOWN_EVENT, **notes)

    def _look_after(self, slow: SlowScene | PostedScene) -> None:
        """Fades the force out while a step of the scene is overdue; warns once it is zero.

        While a reset waits for the step, the force is off.
        """
        is_missing = slow.is_missing
        if is_missing != self._is_held and not self.executor.later:
            self._is_held ^= self.commands.hold(is_missing, "scene")
        lever = self.kernel.bound.state["guard"]["lever"][0]
        if is_missing and lever == 0.0 and not self._has_warned and slow.missing_words:
            self._has_warned = True
            warnings.warn(slow.missing_words, stacklevel=2)

    def count_losses(self, skipped: int) -> int:
        """Counts skipped deadlines; returns the record's flags for them and for lost records.

        A run with a duration has fewer ticks by the skipped ones. If the machine slept meanwhile,
        the run ends.
        """
        lost, self.stream.lost = self.stream.lost, 0
        if not skipped:
            return lost
        self.overruns += 1
        self.skipped += skipped
        if self._is_timed:
            self.end = max(self.end - skipped, self.tick + 1)
        asleep = slept_ns() - self._slept
        if asleep > SUSPENDED_NS:
            self._slept += asleep
            self.event("suspended", seconds=1e-9 * asleep)
            self.stop.request("suspend of the machine")
        return lost | int(TickFlag.OVERRUN)

    def note_stop(self) -> None:
        """Takes the requests that ended the run; later ones end the next run."""
        self._keep_state()
        self._note_own_loop()
        by, signal = self.stop.take()
        if by:
            self.stopped_by, self.signal = by, signal

    def command_zero_force(self) -> Trip | None:
        """Commands zero force; returns a trip if that failed, or None."""
        try:
            self._calls.write(_NO_FORCE)
        except DeviceError as error:
            return Trip(TripCode.ZERO_FORCE, self.tick, detail=str(error))
        return None

    def trip(self, cause: Trip) -> SafetyTrip:
        """Records a trip; returns its exception, with the records of the last second and a remedy.

        The remedy is a note of the exception. Its message is the bare reason, as in the recording.
        """
        self.stopped_by, self.last_trip = BY_TRIP, cause
        self.event("trip", **cause.details())
        self._before_trip = self.stream.latest(1)  # the ring is closed before the summary
        trip = SafetyTrip(cause.sentence, self.stream.latest(round(1.0 / self.setup.period)))
        created = float(self.kernel.state["energy"]["environment_energy"][0])
        hands = enumerate(self.hand_parameters)
        energies = (hand_energy(self.kernel.state[i : i + 1], own) for i, own in hands)
        energy = max(energies, key=lambda each: each.net)
        model, data = self.setup.scene.model, self.setup.scene.data
        scene = self.setup.scene
        grips = () if cause.is_unsound else (scene.grip, *scene.other_grips)
        pump = working_pump(data, grips) if cause.may_be_pumped else None
        if changed := self._changed_fields():
            trip.add_note(change_remedy(changed))
        elif pump is not None:
            trip.add_note(f"{pump.words}; write {pump.change}")
        elif remedy := cause.remedy(energy, created, strongest_actuator(model, data)):
            trip.add_note(remedy)
        return trip

    def event(self, event: str, **details: Any) -> None:
        """Records an event before the present tick."""
        self.stream.event(event, self.tick, self.clock.now(), **details)

    def _signal_detail(self) -> dict[str, str]:
        return {"signal": self.signal} if self.signal else {}

    def summary(self) -> Summary:
        """Returns the summary of all ticks so far."""
        outcome = RunOutcome(
            ticks=self.tick,
            overruns=self.overruns,
            skipped=self.skipped,
            dropped=self.stream.dropped,
            stopped_by=self.stopped_by,
            recording=self.output.path,
            is_realtime=self.setup.is_realtime,
            start_potential=self._start_potential,
            trip=self.last_trip,
            own_loop=None if self._own_loop is None else self._own_loop.tally.account,
            overlap=self.setup.scene.remaining_overlap(),
            changed=changed_words(changed) if (changed := self._changed_fields()) else "",
        )
        device = self.device
        remarks = (
            device.remarks if isinstance(device, DeviceGroup) else [device_remark(self._calls)]
        )
        hands = [
            Summary.from_state(
                self.kernel.state[hand : hand + 1],
                self.hand_parameters[hand],
                setup.info,
                setup.method,
                setup.coupling,
                replace(outcome, probed=self.probed[hand], driver=remarks[hand]),
            )
            for hand, setup in enumerate(self._setups)
        ]
        if len(self._before_trip):  # the tick that tripped is half done and not recorded
            hands = [
                each.at_record(row) for each, row in zip(hands, self._before_trip, strict=True)
            ]
        first, *others = hands
        return Summary.of_hands((first, *others)) if others else first
