"""The bridge: one pass of its loop is one tick, from the device's pose to the device's wrench.

    device ──sample──▶ handle ──▶ scene stepped by MuJoCo ──▶ wrench, energies ──▶ device, recording

``Bridge._loop`` is the loop; the arithmetic before and after MuJoCo's step is in ``kernel.step``.
What a bridge is made of is in ``arrangement``, what is open while it runs in ``opened``, and what
can be asked of it meanwhile in ``commanded``.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import mujoco
import numpy as np

from hapticbridge.clock import slept_ns
from hapticbridge.errors import DeviceError, HapticBridgeError, SafetyTrip
from hapticbridge.guard import trip_reason
from hapticbridge.kernel.codes import BAD_RESULT, HALF_DONE, OK, RING_FULL
from hapticbridge.kernel.tick import can_split
from hapticbridge.realtime import Grant, real_time, warn_of_refusals
from hapticbridge.record import TickFlag
from hapticbridge.session import Commanded
from hapticbridge.signals import stopping_on_signals
from hapticbridge.summary import Summary

SUSPENDED_NS = 50_000_000
"""A sleep of the machine longer than this ends the run: nobody knows what became of the hand, of
the device's power, or of who sits there. Reading two clocks differs by microseconds."""

RECORDER_LOOK = 0.1
"""In s, how often the loop looks whether the recorder still lives: 4 µs each time. A run that is to
be recorded ends with its recorder."""

PICTURE_PERIOD = 1 / 30
"""Time in s between two pictures of the scene for an onlooker. Eyes see no more; each costs the
loop one copy of some microseconds, after the wrench is out."""


class Bridge(Commanded):
    """Joins a device and a scene by a virtual coupling and runs the loop between them.

    Use it as a context manager: entering prepares everything and compiles what must be compiled,
    leaving commands zero force, closes the device and closes the recording.
    """

    _slept, _is_timed = 0, False

    def run(
        self, duration: float | None = None, on_tick: Callable[[int], None] | None = None
    ) -> Summary:
        """Runs the loop. Called again, it goes on: the force rises from zero as at the start.

        What is to ``stop`` a run and comes before it ends it before its first tick. Signals are
        heeded while it runs; before and after, they do what they do in any program of Python's.

        Args:
            duration: Time to run in s of the run's clock: deadlines that were skipped are time that
                has passed, pauses without ticks are not. None runs until the device's motion ends,
                which lasts as many ticks as it has samples, or for ever (Ctrl-C, SIGTERM, SIGHUP
                and Ctrl-Z stop cleanly).
            on_tick: Called with the tick's number before it, for scripted inputs.

        Returns:
            What the run was; of all ticks so far, if ``run`` is called again.

        Raises:
            SafetyTrip: The guard stopped the run, or the device failed; zero force was commanded
                first, where it still could be.
            HapticBridgeError: The bridge is not open, or the duration is out of range.
        """
        self._end, self._is_timed = self._end_of(duration), duration is not None
        reason = ""
        self._resume()
        with ExitStack() as stack:
            stack.callback(self._heed_stops)
            stack.enter_context(stopping_on_signals(self.stop_on_signal))
            if self._is_realtime:
                self._note_grants(stack.enter_context(real_time()))
            try:
                self._come_to_rest()
                self.clock.start(round(self.period * 1e9))
                self._slept = slept_ns()
                reason = self._loop(on_tick)
            except DeviceError as error:
                reason = f"tick {self._tick}: {error}"
            finally:
                unsent = self._silence()
        if reason or unsent:
            self._trip(reason or unsent)
        self._stopped_by = self._stopped_by or "duration"
        return self.summary()

    def _loop(  # noqa: PLR0912, PLR0915 - one loop
        self, on_tick: Callable[[int], None] | None
    ) -> str:
        """Runs the ticks until the end; returns why the kernel refused one, or nothing."""
        state, row = self._binding.state, self._binding.row
        model, data, substeps = self.scene.model, self.scene.data, range(self._substeps)
        stream, records, cursors = self._stream, self._stream.rows, self._stream.cursors
        sample, wrench = self._sample, self._binding.wrench_on_device
        outside = self._binding.external_flags
        before, answer, finish = self._before_step, self._answer_step, self._finish_tick
        read_device, write_device = self.device.read, self.device.write
        wait, now, hand_over = self.clock.wait, self.clock.now, self._publish
        inputs, commands, later, read = (
            self._inputs,
            self._commands.waiting,
            self._operator.later,
            0,
        )
        whole_step, second_half, first_half = (
            self.method.step,
            mujoco.mj_step2,
            mujoco.mj_fwdPosition,
        )
        is_ahead = self._is_pipelined and can_split(model, self.method.scheme)
        stops, snapshot = self._stops, self._snapshot
        buttons, mark = sample["buttons"], self._mark_button
        held = mark  # a button that is held from the start on marks nothing
        publish_positions = self._publish_positions
        pictures = max(round(PICTURE_PERIOD / self.period), 1)
        next_picture = self._tick
        next_look, looks = self._tick, max(round(RECORDER_LOOK / self.period), 1)
        while self._tick != self._end and not stops:
            if self._tick >= next_look:
                stream.look()
                next_look += looks
            deadline, wake, skipped = wait()
            if on_tick is not None:
                on_tick(self._tick)
            if inputs or commands or later:
                self._take_changes()
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
            if mark and buttons[0] & mark != held:
                held = buttons[0] & mark
                if held:
                    self._event("mark", by="button")
            if snapshot is not None and self._tick >= next_picture:
                publish_positions(state, cursors, snapshot.head, snapshot.numbers)
                next_picture += pictures
            if is_ahead:
                first_half(model, data)
            flags = news | stream.lost | (self._overrun(skipped) if skipped else 0)
            stream.lost = 0
            code = finish(
                state, row, records, cursors, deadline, wake, read, write, flags, is_ahead
            )
            if code == BAD_RESULT:
                return trip_reason(code, self._tick)
            while code == RING_FULL and stream.makes_room(may_wait=not stops):
                is_taken = hand_over(row, records, cursors, deadline, wake, read, write, flags)
                code = OK if is_taken else RING_FULL
            self._tick += 1
        return ""

    def _note_grants(self, grants: tuple[Grant, ...]) -> None:
        """Says once what was refused, and records what was granted."""
        if not self._tick:
            warn_of_refusals(self._grants + grants)
        answers = {grant.name: grant.sentence for grant in self._grants + grants}
        self._event("real_time", **answers)

    def _end_of(self, duration: float | None) -> int:
        """Returns the tick before which a run ends that misses no deadline; −1: none."""
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
        if self._tick:
            self._binding.resume()
            self._event("resume", reason=self._stopped_by, **self._named_signal())
        self._stopped_by = self._signal = ""

    def _overrun(self, skipped: int) -> int:
        """Counts a missed deadline, and ends the run where the machine was asleep meanwhile.

        A run of so many seconds has so many ticks less; the one that was late is its last if it
        came behind the end.
        """
        self._overruns += 1
        self._skipped += skipped
        if self._is_timed:
            self._end = max(self._end - skipped, self._tick + 1)
        asleep = slept_ns() - self._slept
        if asleep > SUSPENDED_NS:
            self._slept += asleep
            self._event("suspended", seconds=1e-9 * asleep)
            self.stop("suspend of the machine")
        return int(TickFlag.OVERRUN)

    def _trip(self, reason: str) -> None:
        self._stopped_by = "trip"
        self._event("trip", reason=reason)
        raise SafetyTrip(reason, self._stream.latest(round(1.0 / self.period)))
