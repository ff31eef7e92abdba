"""The Novint Falcon: three translations with force, over USB.

Its replies answer the packet before: force and question go out together, and while one reply waits
in the serial bridge the next question is under way. So one packet goes out in each tick, at the
loop's rate, and what has come by then is read. A packet is answered, and its force acts, when it
arrives; so from a sample to the force that answers it as many whole ticks pass as a reply needs to
come back: two at 1 kHz, because the bridge holds a reply for up to 1 ms.

The device's frame: x to the right, y away from the user, z up, in m from the middle of the
workspace, 0.125 m before the base. Axes, signs and bits are as libnifalcon's source has them: no
real Falcon has moved under this code yet.
"""

from __future__ import annotations

import array

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.data_sheet import USUAL_TORQUE_LIMIT, DeviceInfo, checked_period
from hapticbridge.device.falcon.boot import Link, ask
from hapticbridge.device.falcon.motion import (
    BELIEVED,
    FORCE_LIMIT,
    MOTION_DTYPE,
    PLACE,
    SPEED_LIMIT,
    believe,
    command,
    resolution,
)
from hapticbridge.device.falcon.packets import SIZE, ReplyStream, Request
from hapticbridge.device.falcon.start import (
    LONGEST_PERIOD,
    ask_anew,
    bring_up,
    home,
    insist,
    silent,
)
from hapticbridge.device.falcon.timing import measured_timing
from hapticbridge.device.plugged import Tell, tell_nobody
from hapticbridge.device.silence import SILENCE, SilenceWatch
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.jit import direct
from hapticbridge.tick import SAMPLE_DTYPE, TickFlag


class FalconDevice:
    """A Falcon that is open: it speaks, has found its zeros, and its timing has been measured.

    The sheet's ``rate`` is how often replies were delivered with two questions always under way,
    its ``delay`` the time within which 95 % of 0.1 s of replies came back, asked at all phases of
    the bridge's timer (``timing``). Mass, damping and friction are not known of any unit;
    who measured them gives them. The resolution follows from the geometry in the middle of the
    workspace.

    Args:
        link: To the Falcon.
        name: What errors call it.
        firmware: File with its program, for one that has none; None: it must have it.
        mass, damping, friction: At the grip in kg, N s/m and N, or None.
        tell: Told what the user should know or do.

    Raises:
        DeviceError: It has no program and none was named, does not take it, or was not homed.
    """

    def __init__(
        self,
        link: Link,
        *,
        name: str = "falcon",
        firmware: str | None = None,
        mass: float | None = None,
        damping: float | None = None,
        friction: float | None = None,
        tell: Tell = tell_nobody,
    ) -> None:
        self._link, self._name = link, name
        self._stream = ReplyStream()
        self._is_open, self._is_started = True, False
        try:
            bring_up(link, self._stream, name, firmware, tell)
            home(link, self._stream, name, tell)
            rate, delay = measured_timing(link, self._stream, name)
            self.info = DeviceInfo(
                name="falcon",
                axes=("x", "y", "z"),
                mass=mass,
                damping=damping,
                rotational_inertia=None,
                rotational_damping=None,
                friction=friction,
                resolution=resolution(),
                force_limit=FORCE_LIMIT,
                torque_limit=USUAL_TORQUE_LIMIT,
                speed_limit=SPEED_LIMIT,
                rate=rate,
                delay=delay,
                is_prescribed=False,
                is_real=True,
                duration=None,
            )
        except BaseException:
            self.close()
            raise
        self._motion = np.zeros(1, MOTION_DTYPE)
        self._last = np.zeros(1, SAMPLE_DTYPE)
        self._packet = array.array("B", bytes(SIZE))
        self._bytes = np.frombuffer(self._packet, np.uint8)
        self._watch = SilenceWatch(link.now())
        self._asked = self._asked_before = self._sampled_after = 0.0

    def start(self, period: float) -> NDArray[np.void]:
        """Asks for the pose, without force, and compiles what the loop will call.

        Args:
            period: The loop's period in s, at most 0.02.

        Raises:
            DeviceError: The period is out of range, no grip has its encoders, or it is gone.
        """
        if checked_period(period) > LONGEST_PERIOD:
            raise DeviceError(
                f"{self._name}: is asked once a tick, so the rate must be at least "
                f"{1 / LONGEST_PERIOD:g} Hz, not {1 / period:g} Hz"
            )
        motion, reply, sample = self._motion, self._stream.reply, self._last
        self._believe = direct(believe, motion, reply, sample, 0.0)
        self._command = direct(command, motion, np.zeros(6), self._bytes)
        motion[0] = np.zeros((), MOTION_DTYPE)
        motion["position"] = PLACE
        if not ask(self._link, self._stream, Request.GREEN, SILENCE):
            raise silent(self._name)
        if self._believe(motion, reply, sample, np.inf) != BELIEVED:
            raise DeviceError(
                f"{self._name}: encoders at {reply['encoders'][0].tolist()} are no position of the "
                "grip; switch its power off and on, so that it is homed again"
            )
        now = self._link.now()
        self._watch = SilenceWatch(now)
        self._asked = self._asked_before = self._sampled_after = now
        self._is_started = True
        return sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports the newest reply's pose and buttons (1 right, 2 forward, 4 centre, 8 left).

        What cannot be is not believed and counts as nothing new: encoders that no grip position
        has, or a jump faster than 3 m/s. Waits only after the loop stood still (``ask_anew``).

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Returns:
            0, or ``TickFlag.STALE_SAMPLE`` where the sample repeats the last one.

        Raises:
            DeviceError: It was not started, is gone, or gave nothing to believe for 50 ms.
        """
        if not self._is_started:
            raise DeviceError(f"{self._name} is read before it was started")
        found = 0
        for packet in self._link.take():
            found += self._stream.feed(packet)
        if self._watch.was_away(self._link.now()):
            self._asked = self._asked_before = ask_anew(self._link, self._stream, self._name)
            found = 1
        now = self._link.now()
        is_believed = False
        if found:
            # a reply may be to the last question or the one before: no older than that is its pose
            elapsed, self._sampled_after = now - self._sampled_after, self._asked_before
            verdict = self._believe(self._motion, self._stream.reply, self._last, elapsed)
            is_believed = verdict == BELIEVED
        if self._watch.is_silent(now, is_new=is_believed):
            raise silent(self._name)
        sample[:] = self._last
        return 0 if is_believed else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Sends a force, and with it the next question; the torque is left out.

        What is not taken in time is left out; but no force at all is sent until it is taken.

        Args:
            wrench: Shape (6,), in the device's frame.

        Raises:
            DeviceLost: It is gone, or does not take that it is to give no force.
        """
        self._command(self._motion, wrench, self._bytes)
        self._asked_before, self._asked = self._asked, self._link.now()
        if not self._link.write(self._packet) and not wrench.any():
            insist(self._link, self._packet, self._name)

    def close(self) -> None:
        """Commands zero force, puts the lights out and lets the device go."""
        if not self._is_open:
            return
        self._is_open = self._is_started = False
        try:
            for _ in range(2):  # the first reply may be to a question of the loop's
                ask(self._link, self._stream, 0, SILENCE)
        except DeviceLost:
            pass  # whoever pulled the plug also took the force away
        finally:
            self._link.close()
