"""The bridge: one pass of its loop is one tick, from the device's pose to the device's wrench.

    device ──sample──▶ handle ──▶ scene stepped by MuJoCo ──▶ wrench, energies ──▶ device, recording

``Bridge._loop`` is the loop; the arithmetic before and after MuJoCo's step is in ``kernel.step``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.certificate import condition_sentences, default_coupling, needed_on_axes
from hapticbridge.clock import Clock, RealClock, period_of
from hapticbridge.coupling import Coupling
from hapticbridge.device import Device, device_for
from hapticbridge.errors import DeviceError, HapticBridgeError, SafetyTrip, SceneError
from hapticbridge.guard import (
    Limits,
    guarding_for,
    limits_for,
    refuse_simulated_time,
    refuse_stretched_start,
    trip_reason,
    wait_until_still,
)
from hapticbridge.inputs import Write, apply_writes, input_writes
from hapticbridge.jit import direct
from hapticbridge.kernel.after import answer_step
from hapticbridge.kernel.ahead import can_split
from hapticbridge.kernel.codes import BAD_RESULT, HALF_DONE, OK, RING_FULL
from hapticbridge.kernel.layout import STATE_DTYPE
from hapticbridge.kernel.parameters import checked_substeps, refuse_substeps
from hapticbridge.kernel.publish import finish_tick, publish
from hapticbridge.kernel.state import Binding
from hapticbridge.kernel.step import before_step
from hapticbridge.ledger import Ledger
from hapticbridge.provenance import attachments, describe_run
from hapticbridge.realtime import (
    Grant,
    check_pace,
    memory_at_rest,
    real_time,
    wants_real_time,
    warn_of_refusals,
)
from hapticbridge.recording.stream import Onlooker, RecordStream
from hapticbridge.rendering import (
    contact_stiffness_of,
    default_method,
    method_named,
    prepare,
    refuse_unknowing,
)
from hapticbridge.scene import Scene, load_scene
from hapticbridge.signals import stopping_on_signals
from hapticbridge.summary import Summary
from hapticbridge.tick import SAMPLE_DTYPE, TICK_DTYPE, TickFlag
from hapticbridge.workspace import Workspace, run_parameters

RECORDER_LOOK = 0.1
"""In s, how often the loop looks whether the recorder still lives: 4 µs each time. A run that is to
be recorded ends with its recorder."""

_NO_FORCE = np.zeros(6)


class Bridge:
    """Joins a device and a scene by a virtual coupling and runs the loop between them.

    Use it as a context manager: entering prepares everything and compiles what must be compiled,
    leaving commands zero force, closes the device and closes the recording.

    Args:
        scene: A loaded scene, a name, or a path to MJCF.
        device: A device, or what ``open_device`` understands.
        coupling: K and B that should be felt; None chooses the stiffest safe one for the device's
            damping (80 % of the bound, a quarter of b used as damping, less where substeps need it;
            for a device of unknown damping, that of the default simulated one).
        rate: Ticks per second, 1 to 1e6.
        substeps: MuJoCo steps per tick, 1 to 100. With more than one the mean of their wrenches
            is sent, and the device needs another damping: ``certificate.needed_damping``.
        method: How the tool is rendered; see ``rendering.METHODS``. None: ``lossless``, or with
            substeps, which that does not take, ``implicit``.
        contact_stiffness: K_c in N/m of method ``direct``; None takes the coupling's stiffness.
        i_know: Accept a method that may kick (``Method.hazard``) on a real device.
        recording: File to write (``.mcap``), or None; an existing file is replaced.
        clock: ``RealClock()`` by default; ``SimulatedClock()`` runs as fast as it goes.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool; None takes ``scale``, which keeps
            power equal on both sides.
        axes: 3 × 3 rotation from the device's frame to the scene's.
        absolute: Take the device's poses as poses in the scene instead of relative to its start.
        limits: Limits on the wrench, within the device's own; None takes these.
        controller: Passivity controller: ``damper``, ``tank`` or ``off``. It acts where the device
            was given more than its damping burns and the scene gives up. None: ``damper`` where the
            device condition does not hold, else ``off``.
        clutch: Number of the device's button, from 0, that lets it move without the handle.
        dead_man: Number of the button that must be held for any force.
        live: Draw a status line on stderr, from the recorder's process.
        onlooker: Who looks at the run from another process, as ``view.Window`` does; it is started
            when the bridge is entered and closed when it is left.
        pipelined: Compute what needs no new sample once the wrench is out, where scene and method
            let it (``kernel.ahead``): the same numbers to the bit, the wrench sooner, the whole
            tick 5 % longer. Between two ticks ``scene.data`` then holds the contacts of the new
            positions, without forces. None: in real time, where a device waits.
        realtime: Ask the system for real time while the loop runs (``realtime.real_time``); what it
            refuses is warned of once, with the command that grants it. None: for a real device.

    Raises:
        HapticBridgeError: An argument is out of range; the message says which and what is valid.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        device: Device | str = "simulated",
        coupling: Coupling | None = None,
        *,
        rate: float = 1000.0,
        substeps: int = 1,
        method: str | None = None,
        contact_stiffness: float | None = None,
        i_know: bool = False,
        recording: str | Path | None = None,
        clock: Clock | None = None,
        scale: float = 1.0,
        force_scale: float | None = None,
        axes: ArrayLike | None = None,
        absolute: bool = False,
        limits: Limits | None = None,
        controller: str | None = None,
        clutch: int | None = None,
        dead_man: int | None = None,
        live: bool = False,
        onlooker: Onlooker | None = None,
        pipelined: bool | None = None,
        realtime: bool | None = None,
    ) -> None:
        self.scene = scene if isinstance(scene, Scene) else load_scene(scene)
        self.period = period_of(rate)
        self._substeps = checked_substeps(substeps)
        self.method = default_method(substeps) if method is None else method_named(method)
        refuse_substeps(self.method.scheme, substeps)
        self._workspace = Workspace.of(scale, force_scale, axes, is_absolute=absolute)
        self._path = Path(recording) if recording is not None else None
        self._is_live, self._onlooker = live, onlooker
        self.clock = clock or RealClock()
        self._is_pipelined = self.clock.name == RealClock.name if pipelined is None else pipelined
        self._grants: tuple[Grant, ...] = ()
        with ExitStack() as refused:
            if isinstance(device, str):
                refuse_simulated_time(device, self.clock)
                device = device_for(self.scene, device)
                refused.callback(device.close)  # else nobody could, if it is refused
            self.device = device
            self.coupling = coupling or default_coupling(
                device.info,
                self.period,
                self._workspace.scale,
                self._workspace.force_scale,
                self.laws,
                self.method,
            )
            self._limits = limits_for(device.info, limits)
            self._guarding = guarding_for(
                device.info,
                self._limits,
                self.period,
                needed=needed_on_axes(
                    device.info,
                    self.used,
                    self.period,
                    self._workspace.scale,
                    self._workspace.force_scale,
                    self.laws,
                    self.method,
                ),
                scale=self._workspace.scale,
                controller=controller,
                clutch=clutch,
                dead_man=dead_man,
                is_absolute=self._workspace.is_absolute,
            )
            refuse_unknowing(self.method, is_real=device.info.is_real, i_know=i_know)
            # refused here already
            contact_stiffness_of(self.method, self.coupling, contact_stiffness)
            refuse_simulated_time(device.info, self.clock)
            self._is_realtime = wants_real_time(realtime, self.clock, is_real=device.info.is_real)
            refused.pop_all()
        self._contact_stiffness = contact_stiffness
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._inputs: deque[list[Write]] = deque()
        self._tick = self._overruns = self._skipped = 0
        self._stopped_by = self._signal = ""
        self._is_open = False

    def __enter__(self) -> Bridge:
        # released in reverse order, whatever one of them does: force, recording, ring, device
        with ExitStack() as resources:
            resources.callback(self.device.close)
            self._prepare(resources)
            resources.callback(self._silence)
            self._resources = resources.pop_all()
        self._is_open = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._is_open = False
        reason = self._stopped_by if error is None else f"{type(error).__name__}: {error}"
        named = {"signal": self._signal} if self._signal else {}
        self._event(
            "stop",
            reason=reason,
            **named,
            overruns=self._overruns,
            skipped=self._skipped,
            dropped=self._stream.dropped,
        )
        self._resources.__exit__(kind, error, traceback)

    def run(
        self, duration: float | None = None, on_tick: Callable[[int], None] | None = None
    ) -> Summary:
        """Runs the loop. Called again, it goes on: the force rises from zero as at the start.

        Args:
            duration: Time to run in s; None runs until the device's motion ends, or for ever
                (Ctrl-C, SIGTERM, SIGHUP and Ctrl-Z stop cleanly).
            on_tick: Called with the tick's number before it, for scripted inputs.

        Returns:
            What the run was; of all ticks so far, if ``run`` is called again.

        Raises:
            SafetyTrip: The guard stopped the run, or the device failed; zero force was commanded
                first, where it still could be.
            HapticBridgeError: The bridge is not open, or the duration is out of range.
        """
        last, reason = self._last_tick(duration), ""
        self._resume()
        with ExitStack() as stack:
            stack.enter_context(stopping_on_signals(self._stop_on_signal))
            if self._is_realtime:
                self._note_grants(stack.enter_context(real_time()))
            try:
                wait_until_still(self.device, self._sample, self.period, self.clock)
                if not self._tick and self._workspace.is_absolute:  # a hand moves while it waits
                    refuse_stretched_start(self._binding.state, self._sample, self._limits)
                self.clock.start(round(self.period * 1e9))
                reason = self._loop(last, on_tick)
            except DeviceError as error:
                reason = f"tick {self._tick}: {error}"
            finally:
                unsent = self._silence()
        if reason or unsent:
            self._trip(reason or unsent)
        self._stopped_by = self._stopped_by or "duration"
        return self.summary()

    def _loop(self, last: int, on_tick: Callable[[int], None] | None) -> str:
        """The ticks, until the last; returns why the kernel refused one, or nothing."""
        state, row = self._binding.state, self._binding.row
        model, data, substeps = self.scene.model, self.scene.data, range(self._substeps)
        stream, records, cursors = self._stream, self._stream.rows, self._stream.cursors
        sample, wrench = self._sample, state["wrench_on_device"][0]
        outside = state["outside"]
        before, answer, finish = self._before_step, self._answer_step, self._finish_tick
        read_device, write_device = self.device.read, self.device.write
        wait, now, hand_over = self.clock.wait, self.clock.now, self._publish
        inputs, read = self._inputs, 0
        whole_step, second_half, first_half = (
            self.method.step,
            mujoco.mj_step2,
            mujoco.mj_fwdPosition,
        )
        is_ahead = self._is_pipelined and can_split(model, self.method.scheme)
        next_look, looks = self._tick, max(round(RECORDER_LOOK / self.period), 1)
        while self._tick != last and not self._stopped_by:
            if self._tick >= next_look:
                stream.look()
                next_look += looks
            deadline, wake, skipped = wait()
            if on_tick is not None:
                on_tick(self._tick)
            if inputs:
                self._apply_inputs()
            news = outside[0] = read_device(sample)
            read_before, read = read, now()
            elapsed = 1e-9 * (read - read_before)
            for substep in substeps:
                code = before(state, sample, row, substep, elapsed)
                if code not in (OK, HALF_DONE):
                    return trip_reason(code, self._tick)
                step = second_half if code == HALF_DONE else whole_step
                step(model, data)
                code = answer(state, row, substep)
            if code != OK:
                return trip_reason(code, self._tick)
            write_device(wrench)
            write = now()
            if is_ahead:
                first_half(model, data)
            flags = news | stream.lost | (self._overrun(skipped) if skipped else 0)
            stream.lost = 0
            code = finish(
                state, row, records, cursors, deadline, wake, read, write, flags, is_ahead
            )
            if code == BAD_RESULT:
                return trip_reason(code, self._tick)
            while code == RING_FULL and stream.makes_room(may_wait=not self._stopped_by):
                is_taken = hand_over(row, records, cursors, deadline, wake, read, write, flags)
                code = OK if is_taken else RING_FULL
            self._tick += 1
        return ""

    def stop(self, by: str = "caller") -> None:
        """Ends the run after the present tick; may be called from ``on_tick`` or a thread.

        Args:
            by: Who wants it, for the summary and the recording's event ``stop``; not empty.
        """
        self._stopped_by = by or "caller"

    def _silence(self) -> str:
        """Commands zero force; returns why that failed, or nothing."""
        try:
            self.device.write(_NO_FORCE)
        except DeviceError as error:
            return f"zero force could not be sent: {error}"
        return ""

    def _note_grants(self, grants: tuple[Grant, ...]) -> None:
        """Says once what was refused, and records what was granted."""
        if not self._tick:
            warn_of_refusals(self._grants + grants)
        answers = {grant.name: grant.sentence for grant in self._grants + grants}
        self._event("real_time", **answers)

    def _stop_on_signal(self, name: str) -> None:
        self._stopped_by, self._signal = "signal", name

    def set_input(
        self,
        *,
        ctrl: Mapping[str, ArrayLike] | None = None,
        mocap: Mapping[str, ArrayLike] | None = None,
        joint_force: Mapping[str, ArrayLike] | None = None,
        body_wrench: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Changes inputs of the scene from the next tick on; recorded, so the run can be repeated.

        Move mocap bodies slowly: MuJoCo damps their welds and contacts against rest, so a fast
        move can create energy, and the environment is then called active.

        Args:
            ctrl: Control per actuator of the scene.
            mocap: Pose (x, y, z[, qw, qx, qy, qz]) in m per mocap body of the scene.
            joint_force: Generalised force per joint, in N or N m per degree of freedom.
            body_wrench: (force, torque) in N and N m per body, world frame, at its centre of mass.

        Raises:
            SceneError: A name does not exist or has the wrong count of numbers.
        """
        self.repeat_input(
            input_writes(
                self.scene.model,
                ctrl=ctrl,
                mocap=mocap,
                joint_force=joint_force,
                body_wrench=body_wrench,
            )
        )

    def repeat_input(self, writes: list[Write]) -> None:
        """As ``set_input``, with the writes that a recording's event ``input`` holds."""
        if not self.method.meters_inputs:
            raise SceneError(
                f"method '{self.method.name}' cannot meter the work of inputs; use 'implicit'"
            )
        self._inputs.append(writes)

    @property
    def used(self) -> Coupling:
        """The coupling whose law gives the wrench; ``coupling`` is what should be felt."""
        return self.method.used(self.coupling, self.period / self._substeps)

    @property
    def rendered(self) -> Coupling:
        """``coupling``, but for damping below what the method can show; ``Method.rendered``."""
        return self.method.rendered(self.used, self.period / self._substeps)

    @property
    def laws(self) -> int:
        """How often per tick the wrench on the tool is computed."""
        return self.method.laws(self._substeps)

    @property
    def ledger(self) -> Ledger:
        """Energies so far, per port."""
        return Ledger.of(self._binding.state)

    def latest_records(self, count: int) -> NDArray[np.void]:
        """Returns copies of the newest records (``TICK_DTYPE``), oldest first."""
        return self._stream.latest(count)

    def conditions(self) -> tuple[str, ...]:
        """Returns what is to be said of device and method, one sentence each; known once open."""
        return condition_sentences(self.device.info, self.parameters, self.method)

    def summary(self) -> Summary:
        """Returns what the run was so far."""
        return Summary.of(
            self._binding.state,
            self.parameters,
            self.device.info,
            self.method,
            self.coupling,
            ticks=self._tick,
            overruns=self._overruns,
            skipped=self._skipped,
            dropped=self._stream.dropped,
            stopped_by=self._stopped_by,
            recording=self._path,
        )

    def _prepare(self, resources: ExitStack) -> None:
        """Compiles the kernel, puts the scene to its start, and opens the recording."""
        if self._tick or self._is_open:
            raise HapticBridgeError("a bridge is entered once; make a new one for another run")
        self.scene.claim()
        resources.callback(self.scene.release)
        scene, clock, method = self.scene, self.clock, self.method
        felt = prepare(scene, self.coupling, self.period, self._substeps, method)
        self._stream = RecordStream(
            self._path,
            self.period,
            live=self._is_live,
            is_lossless=clock.is_lossless,
            onlooker=self._onlooker,
        )
        resources.callback(self._stream.close)
        self._compile()
        if clock.name == RealClock.name:
            is_real = self.device.info.is_real
            check_pace(scene, method, self.period, self._substeps, is_real=is_real)
        if self._is_realtime:
            self._grants = resources.enter_context(memory_at_rest())
        # last, because from here on the device is held, and its pose counts
        self._sample[:] = self.device.start(self.period)
        info = self.device.info
        self.parameters = run_parameters(
            scene,
            self.coupling,
            method,
            self._sample,
            period=self.period,
            felt=felt,
            substeps=self._substeps,
            info=info,
            limits=self._limits,
            workspace=self._workspace,
            contact_stiffness=self._contact_stiffness,
            guarding=self._guarding,
        )
        self._binding = binding = Binding(scene.model, scene.data, self.parameters)
        refuse_stretched_start(binding.state, self._sample, self._limits)
        if self._stream.is_read:
            meta = describe_run(
                scene, self.parameters, binding, method=method.name, device=info, clock=clock.name
            )
            self._stream.start(meta, attachments(scene))
            self._event("start")

    def _compile(self) -> None:
        """Gets the machine code of the tick ready, so that the first one is not late."""
        state, row, sample = np.zeros(1, STATE_DTYPE), np.zeros(1, TICK_DTYPE), self._sample
        rows, cursors = self._stream.rows, self._stream.cursors
        self._before_step = direct(before_step, state, sample, row, 0, 0.0)
        self._answer_step = direct(answer_step, state, row, 0)
        self._publish = direct(publish, row, rows, cursors, 0, 0, 0, 0, 0)
        self._finish_tick = direct(finish_tick, state, row, rows, cursors, 0, 0, 0, 0, 0, True)

    def _last_tick(self, duration: float | None) -> int:
        if duration is None:
            length = self.device.info.duration
            return -1 if length is None else max(self._tick, round(length / self.period) + 1)
        if not np.isfinite(duration) or duration <= 0:
            raise HapticBridgeError(f"duration is {duration!r} s; it must be finite and > 0")
        return self._tick + max(round(duration / self.period), 1)

    def _resume(self) -> None:
        """Starts the ramp; between two runs zero was commanded and the device may have moved."""
        if not self._is_open:
            raise HapticBridgeError("the bridge is not open; use 'with Bridge(...) as bridge:'")
        self._stopped_by = ""
        if self._tick:
            self._binding.resume()
            self._event("resume")

    def _apply_inputs(self) -> None:
        while self._inputs:
            writes = self._inputs.popleft()
            apply_writes(self.scene.data, writes)
            self._event("input", writes=writes)

    def _overrun(self, skipped: int) -> int:
        self._overruns += 1
        self._skipped += skipped
        return int(TickFlag.OVERRUN)

    def _trip(self, reason: str) -> None:
        self._stopped_by = "trip"
        self._event("trip", reason=reason)
        raise SafetyTrip(reason, self._stream.latest(round(1.0 / self.period)))

    def _event(self, event: str, **details: object) -> None:
        self._stream.event(event, self._tick, self.clock.now(), **details)
