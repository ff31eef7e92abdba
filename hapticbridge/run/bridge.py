"""Haptic bridge: a device and a MuJoCo scene, joined by a virtual coupling at a fixed rate.

    device ──sample──▶ handle ──▶ scene stepped by MuJoCo ──▶ wrench, energies ──▶ device, recording

``Bridge._loop`` is the loop; ``kernel.tick`` is its arithmetic. ``options`` resolves and refuses
before the device is started. ``session`` owns the resources of an open run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.clock import Clock, RealClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import condition_sentences
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.trip import Trip, TripCode
from hapticbridge.device import Device
from hapticbridge.errors import (
    CommandError,
    DeviceError,
    HapticBridgeError,
    SceneError,
    choices,
)
from hapticbridge.kernel.codes import BAD_RESULT, HALF_DONE, HAND_CODES, OK, RING_FULL
from hapticbridge.kernel.mujoco_c import quiet, without_timers
from hapticbridge.realtime import real_time
from hapticbridge.recording.container import refuse_replacing
from hapticbridge.recording.recorder import RecordOutput, RingObserver
from hapticbridge.run.commands import Command, Repeat, Stop
from hapticbridge.run.hands import (
    DeviceGroup,
    Grasp,
    devices_for_run,
    scene_of_grasps,
)
from hapticbridge.run.options import (
    DEFAULT_OPTIONS,
    BridgeOptions,
    RunSetup,
    Workspace,
    device_for_run,
    held_scene,
)
from hapticbridge.run.request import RunRequest
from hapticbridge.run.session import OnTick, Session, StopRequest
from hapticbridge.run.summary import Ledger, Summary
from hapticbridge.scene import Scene, load_scene
from hapticbridge.scene.checks import refuse_callbacks
from hapticbridge.scene.compile import clause
from hapticbridge.scene.inputs import Write, input_writes
from hapticbridge.signals import stopping_on_signals

_NOT_OPEN = "the bridge is not open; open it with 'with Bridge(...)' first"


def _no_option(name: str) -> str:
    """Returns a sentence on a keyword that is no option of a bridge."""
    if name in Coupling.__match_args__:
        return f"'{name}' is a gain of the coupling: write coupling={{'{name}': …}}"
    for option, holder in (("limits", Limits), ("workspace", Workspace)):
        if name in holder.__dataclass_fields__:
            return f"'{name}' belongs to the option {option}: write it in hb.{holder.__name__}(…)"
    if name in ("grip", "as_is"):
        return f"'{name}' belongs to the scene: write hb.load_scene(…, {name}=…) for it"
    return f"a bridge has no option '{name}'; it has {choices(BridgeOptions.__dataclass_fields__)}"


class Bridge:
    """Runs the haptic loop between a device and a scene.

    Each tick reads the device, moves the handle to its pose, steps the scene, sends the coupling's
    wrench back and publishes one record. Use it as a context manager: entering compiles and starts
    everything, leaving commands zero force and closes recording and device.

        with Bridge("peg_in_hole", "falcon", rate=2000, recording="run.mcap") as bridge:
            summary = bridge.run(duration=10.0)

    Args:
        scene: A loaded scene, a shipped scene's name, or a path to MJCF.
        device: An open device, or a string for ``open_device``. A device opened from a string is
            closed if the bridge is refused. Several hands are named by a ``Grasp`` each, with its
            grip, device and coupling.
        coupling: Stiffness and damping to be felt; None selects the stiffest safe coupling, and a
            mapping such as ``{"damping": 2.0}`` changes gains of it.
        options: Rate, method, workspace, limits, buttons; see ``BridgeOptions``.
        clock: Clock of the run; None is a ``RealClock``. A ``SimulatedClock`` runs as fast as
            possible and equally in every run.
        recording: File to write (``.mcap``), replaced if it exists; None records nothing.
        observer: Second reader of the records, such as ``view.Window``. It is started when the
            bridge is entered and closed when it is left.
        **changes: Fields of ``BridgeOptions`` that differ from ``options``.

    Attributes:
        request: What was asked for.
        setup: The resolved setup: scene, coupling, method, guard; of several hands, the first's.
        device: The device; of several hands, all of them as one.
        clock: Clock of the run.
        output: Destinations of the records.

    Raises:
        HapticBridgeError: A value is out of range, or two of them exclude each other. The message
            names the value and the valid ones.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        device: Device | str | Sequence[Grasp] = "simulated",
        coupling: Coupling | Mapping[str, float] | None = None,
        options: BridgeOptions = DEFAULT_OPTIONS,
        *,
        clock: Clock | None = None,
        recording: str | Path | None = None,
        observer: RingObserver | None = None,
        **changes: Any,
    ) -> None:
        for name in changes.keys() - BridgeOptions.__dataclass_fields__.keys():
            raise HapticBridgeError(_no_option(name))
        options = replace(options, **changes)
        path = None if recording is None else Path(recording)
        if path is not None:
            refuse_replacing(path)
        self.output = RecordOutput(path, observer, options.live)
        self.clock = clock or RealClock()
        if isinstance(self.clock, type):
            raise HapticBridgeError(
                f"clock is the class {self.clock.__name__}; it must be an object of it: "
                f"{self.clock.__name__}()"
            )
        self.device: Device
        if isinstance(scene, Scene):
            scene.tell_written_state()
        if isinstance(device, Sequence) and not isinstance(device, str):
            setups = self._resolve_hands(scene, device, coupling, options)
        else:
            setups = self._resolve(scene, device, coupling, options)
        self.setup, *others = setups
        self._others = tuple(others)
        self._stop = StopRequest()
        self._session: Session | None = None

    def _resolve(
        self,
        scene: Scene | str | Path,
        device: Device | str,
        coupling: Coupling | Mapping[str, float] | None,
        options: BridgeOptions,
    ) -> tuple[RunSetup, ...]:
        loaded = scene if isinstance(scene, Scene) else load_scene(scene)
        if loaded.has_several_hands:
            grips = choices((loaded.grip, *loaded.other_grips))
            raise SceneError(
                f"scene '{loaded.name}' was loaded with {1 + len(loaded.other_grips)} grips, and "
                f"one device holds one; name a Grasp per hand, or load it with one of {grips}"
            )
        grasp = Grasp(loaded.grip, device, coupling=coupling)
        held = held_scene(loaded, options)
        with device_for_run(held, device, self.clock) as self.device:
            return self._requested(loaded, [grasp], [self.device], options)

    def _resolve_hands(
        self,
        scene: Scene | str | Path,
        grasps: Sequence[Grasp],
        coupling: Coupling | Mapping[str, float] | None,
        options: BridgeOptions,
    ) -> tuple[RunSetup, ...]:
        if not all(isinstance(grasp, Grasp) for grasp in grasps):
            raise HapticBridgeError("several hands are named by a Grasp each: Grasp(GRIP, DEVICE)")
        if coupling is not None:
            raise HapticBridgeError("each of several hands has a coupling of its own: Grasp(…)")
        loaded = scene_of_grasps(scene, grasps)
        with devices_for_run(held_scene(loaded, options), grasps, self.clock) as devices:
            setups = self._requested(loaded, grasps, devices, options)
        self.device = DeviceGroup(devices, [len(grasp.grips) for grasp in grasps])
        return setups

    def _requested(
        self,
        scene: Scene,
        grasps: Sequence[Grasp],
        devices: Sequence[Device],
        options: BridgeOptions,
    ) -> tuple[RunSetup, ...]:
        infos = [device.info for device in devices]
        self.request = RunRequest.of(scene, grasps, infos, options, self.clock)
        is_recorded = self.output.path is not None
        return self.request.resolve(scene, self.clock, is_recorded=is_recorded)

    def __enter__(self) -> Self:
        if self._session is not None:
            raise HapticBridgeError("a bridge is opened once; make a new one for another run")
        self._session = Session(
            self.request, self.setups, self.device, self.clock, self.output, self._stop
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.session.close(error)

    def run(self, duration: float | None = None, on_tick: OnTick | None = None) -> Summary:
        """Runs the loop. A second call continues; the force rises from zero as at the start.

        Signals that end a program (Ctrl-C, SIGTERM, SIGHUP, Ctrl-Z …) end the run cleanly while it
        lasts.

        Args:
            duration: Time to run in s of the run's clock. Skipped deadlines count as time, pauses
                between runs do not. None runs until the device's motion ends, one tick per sample,
                or until a signal.
            on_tick: Called with the tick's number before each tick, for scripted inputs. It may
                read the scene, as with ``mj_forward``; what it writes into the scene's state is no
                part of the recording, and the summary names it.

        Returns:
            The summary of all ticks so far.

        Raises:
            SafetyTrip: The guard stopped the run, or the device failed. Zero force was commanded
                first, where it still could be.
            HapticBridgeError: The bridge is not open, a callback of MuJoCo is set, or the duration
                is out of range.
        """
        session, trip = self._open_session(), None
        refuse_callbacks()
        session.begin(duration, has_program=on_tick is not None)
        with ExitStack() as stack:
            stack.callback(session.note_stop)
            stack.enter_context(stopping_on_signals(self.stop_on_signal))
            stack.enter_context(without_timers())
            stack.enter_context(quiet())  # a warning of a step is a trip
            if self.setup.is_realtime:
                session.note_grants(stack.enter_context(real_time()))
            try:
                session.start_clock()
                trip = self._loop(session, session.watching(on_tick))
            except DeviceError as error:
                trip = Trip(TripCode.DEVICE, session.tick, detail=str(error))
            except mujoco.FatalError as error:
                trip = Trip(TripCode.SIMULATION, session.tick, detail=clause(error))
            finally:
                unsent = session.command_zero_force()
        if found := trip or unsent:
            raise session.trip(found)
        session.stopped_by = session.stopped_by or "duration"
        return session.summary()

    def _loop(  # noqa: PLR0912 - one loop
        self, session: Session, on_tick: OnTick | None
    ) -> Trip | None:
        """Runs the ticks until the end; returns a trip, or None."""
        kernel, model, data = session.kernel, self.scene.model, self.scene.data
        wait, now, stops = self.clock.wait, self.clock.now, self._stop.waiting
        read_device, write_device = session.port
        state, row, sample, samples = kernel.state, kernel.row, kernel.sample, session.samples
        before, answer, finish = kernel.before, kernel.answer, kernel.finish
        step, first_half, second_half = kernel.step, kernel.first_half, kernel.second_half
        stream, rows, cursors, wrench = session.stream, kernel.rows, kernel.cursors, kernel.wrench
        inputs, commands, later = session.inputs, session.commands.waiting, session.executor.later
        substeps, is_ahead, mark = kernel.substeps, kernel.is_ahead, session.mark
        external_flags, next_chores, read = kernel.external_flags, session.tick, 0
        while session.tick != session.end and not stops:
            deadline, wake, skipped = wait()
            if on_tick is not None:
                on_tick(session.tick)
            if inputs or commands or later:
                session.take_changes()
            flags = external_flags[0] = read_device(samples)
            last_read, read = read, now()
            elapsed = 1e-9 * (read - last_read)
            for substep in substeps:
                code = before(state, sample, row, substep, elapsed)
                if code == OK:
                    step(model, data)
                elif code == HALF_DONE:
                    second_half(model, data)
                else:
                    return self._trip(code, session.tick)
                code = answer(state, row, substep)
            if code != OK:
                return self._trip(code, session.tick)
            write_device(wrench)
            write = now()
            if mark is not None:
                mark.look()
            if session.tick >= next_chores:
                next_chores = session.do_chores()
            if is_ahead:
                first_half(model, data)
            if skipped or stream.lost:
                flags |= session.count_losses(skipped)
            code = finish(state, row, rows, cursors, deadline, wake, read, write, flags, is_ahead)
            while code == RING_FULL and stream.makes_room(is_stopping=bool(stops)):
                code = kernel.publish_again(deadline, wake, read, write, flags)
            if code == BAD_RESULT:
                return self._trip(code, session.tick)
            session.tick += 1
        return None

    def _trip(self, code: int, tick: int) -> Trip:
        """Returns why the kernel refused a tick, and for which of several hands."""
        hand, code = divmod(code, HAND_CODES)
        grip = self.setups[hand].scene.grip if self.setup.scene.has_several_hands else ""
        return Trip.of_result(code, tick, grip)

    def stop(self, by: str = "caller") -> None:
        """Ends the run after the present tick; callable from ``on_tick`` and from any thread.

        Without a run it ends the next one before its first tick, so that a late request never
        leaves a force on.

        Args:
            by: Origin of the request, for the summary and the event ``stop``; not empty.
        """
        self._stop.request(by)

    def stop_on_signal(self, name: str) -> None:
        """Ends the run as ``stop`` does, for a signal that the program received itself.

        Args:
            name: Name of the signal, for the recording.
        """
        self._stop.request("signal", name)

    def command(self, command: Command, by: str = "caller") -> None:
        """Queues a command for the run; callable from ``on_tick`` and from any thread.

        It is executed between two ticks and recorded with its tick, so that the run can be
        repeated.

        Args:
            command: A change of coupling or switches, a reset, a mark, or a stop. One for a single
                hand of several names the hand's grip.
            by: Origin of the command, for the recording.

        Raises:
            CommandError: The device does not allow it, the last command is too recent, or the run
                cannot execute it. Nothing changes then.
        """
        if isinstance(command, Stop):
            self.stop(by)
            return
        if self._session is None or not self._session.is_open:
            raise CommandError(_NOT_OPEN)
        self._session.commands.offer(command, by)

    def repeat_commands(self, events: Sequence[Mapping[str, Any]]) -> None:
        """Applies recorded commands of another run before the next tick; call it in ``on_tick``.

        The commands are applied without limit checks and without fading the force, because both
        happened in the original run.

        Args:
            events: Events of the recording (``commands.CHANGES``), in order.
        """
        self._open_session().commands.waiting.append((Repeat(tuple(events)), ""))

    def set_input(
        self,
        *,
        ctrl: Mapping[str, ArrayLike] | None = None,
        mocap: Mapping[str, ArrayLike] | None = None,
        joint_force: Mapping[str, ArrayLike] | None = None,
        body_wrench: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Changes inputs of the scene from the next tick on; recorded, so the run can be repeated.

        Move mocap bodies slowly. MuJoCo damps their welds and contacts against rest, so a fast
        move can create energy, and the environment is then called active.

        Args:
            ctrl: Controls by actuator of the scene.
            mocap: Poses (x, y, z[, qw, qx, qy, qz]) in m by mocap body of the scene.
            joint_force: Generalised forces by joint, in N or N m per degree of freedom.
            body_wrench: Wrenches (force, torque) in N and N m by body, in the world frame about its
                centre of mass.

        Raises:
            SceneError: A name does not exist or has the wrong number of values, or the method
                cannot meter the work of inputs.
        """
        model = self.setup.scene.model
        self.repeat_input(
            input_writes(
                model, ctrl=ctrl, mocap=mocap, joint_force=joint_force, body_wrench=body_wrench
            )
        )

    def repeat_input(self, writes: list[Write]) -> None:
        """Applies the writes of a recorded event ``input`` before the next tick.

        Raises:
            SceneError: The method cannot meter the work of inputs.
        """
        method = self.setup.method
        if not method.meters_inputs:
            raise SceneError(
                f"method '{method.name}' cannot meter the work of inputs; use 'implicit'"
            )
        self._open_session().inputs.append(writes)

    @property
    def setups(self) -> tuple[RunSetup, ...]:
        """The setup of each hand."""
        return self.setup, *self._others

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self.setup.scene

    @property
    def period(self) -> float:
        """T in s."""
        return self.setup.period

    @property
    def session(self) -> Session:
        """Resources of the run; they remain readable after the bridge was left.

        Raises:
            HapticBridgeError: The bridge was never opened.
        """
        if self._session is None:
            raise HapticBridgeError(_NOT_OPEN)
        return self._session

    def _open_session(self) -> Session:
        if self._session is None or not self._session.is_open:
            raise HapticBridgeError(_NOT_OPEN)
        return self._session

    @property
    def ledger(self) -> Ledger:
        """Energies so far, by port; of several hands, those at the first one's."""
        return Ledger.from_state(self.session.kernel.bound.state)

    def latest_records(self, count: int) -> NDArray[np.void]:
        """Returns copies of the newest ``count`` ticks' records (``TICK_DTYPE``), oldest first.

        Each tick has a record per hand, in order.
        """
        return self.session.stream.latest(count)

    def conditions(self) -> tuple[str, ...]:
        """Returns the conditions on device and method as sentences, once the bridge is open.

        Those of several hands begin with the hand's grip.
        """
        return tuple(
            f"{setup.scene.grip}: {sentence}" if setup.scene.has_several_hands else sentence
            for setup, own in zip(self.setups, self.session.hand_parameters, strict=True)
            for sentence in condition_sentences(setup.info, own, setup.method)
        )

    def summary(self) -> Summary:
        """Returns the summary of the run so far."""
        return self.session.summary()
