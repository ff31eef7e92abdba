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
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import USUAL_TORQUE_LIMIT, DeviceInfo, checked_period, stated_numbers
from hapticbridge.device.falcon.kinematics import (
    BELIEVED,
    FORCE_LIMIT,
    MOTION_DTYPE,
    PLACE,
    SPEED_LIMIT,
    believe,
    command,
    resolution,
)
from hapticbridge.device.falcon.protocol import (
    LONGEST_PERIOD,
    READ_FROM,
    SIZE,
    WRITE_TO,
    Link,
    ReplyStream,
    Request,
    answers,
    ask,
    ask_anew,
    bring_up,
    home,
    insist,
    read_firmware,
    send_question,
    silent,
)
from hapticbridge.device.family import Driver, Notify, UsbId, ignore_message, select_device
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.transport.usb import UsbLink, find
from hapticbridge.device.watchdog import SILENCE, SilenceDetector
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.jit import direct
from hapticbridge.record import SAMPLE_DTYPE, TickFlag

# How fast a Falcon answers, measured on the unit before the loop begins.

TIME = 0.1
"""In s: how long each of the two measurements takes."""

UNDER_WAY = 2
"""Questions kept under way while the rate is measured: one is there when a reply leaves."""

PACE = 1.07e-3
"""In s: from question to question while the delay is measured. A little more than the bridge's
timer of 1 ms, so that the questions sweep over all its phases."""

SHARE = 0.95
"""Share of replies that came back within the delay, no unit. The longest are the host's own stalls,
which the loop counts as missed deadlines."""

TRIES = 3
"""How often the timing is measured before a Falcon counts as silent: a reply can be lost on the
serial line, and a busy host can stall for as long as one is waited for."""

_ANSWER_TIME = 0.05  # s, longer is silence


def measured_timing(link: Link, stream: ReplyStream, name: str) -> tuple[float, float]:
    """Returns at what rate replies are delivered, and within what time they come.

    The rate is deliveries per second with ``UNDER_WAY`` questions always asked; several replies
    that came together are one delivery. The delay is the time from a question to its reply that
    ``SHARE`` of the replies kept, one question at a time.

    A question asks for the encoders and carries the force, so both are as old as each other: where
    the loop sends one per tick, the force that answers a sample acts the delay later, rounded up to
    whole ticks, beyond the one tick for which it is held.

    Args:
        link: To a Falcon that speaks.
        stream: Takes its replies.
        name: What errors call it.

    Returns:
        The rate in Hz and the delay in s.

    Raises:
        DeviceLost: It fell silent.
    """
    for _ in range(TRIES):
        rate = _rate(link, stream)
        if rate is not None and (delay := _delay(link, stream)) is not None:
            return rate, delay
    raise DeviceLost(f"{name}: fell silent while its timing was measured")


def _rate(link: Link, stream: ReplyStream) -> float | None:
    """Measures the rate in Hz; None where a reply did not come."""
    for _ in range(UNDER_WAY):
        send_question(link)
    begin = last = link.now()
    deliveries = 0
    while last - begin < TIME:
        found = answers(link, stream, _ANSWER_TIME)
        if not found:
            return None
        last = link.now()
        if deliveries == 0:
            begin = last  # time counts from the first delivery
        deliveries += 1
        for _ in range(found):
            send_question(link)
    for _ in range(UNDER_WAY):
        answers(link, stream, 2 * PACE)  # the last ones, which nobody waited for
    return (deliveries - 1) / (last - begin)


def _delay(link: Link, stream: ReplyStream) -> float | None:
    """Measures the delay in s; None likewise."""
    times = []
    end = link.now() + TIME
    while (begin := link.now()) < end:
        if not ask(link, stream, 0, _ANSWER_TIME):
            return None
        times.append(link.now() - begin)
        while (left := begin + PACE - link.now()) > 0:
            link.wait(left)
            link.take()  # the bridge reports its status every millisecond
    times.sort()
    return times[math.ceil(SHARE * len(times)) - 1]


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
        tell: Notify = ignore_message,
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
        self._watch = SilenceDetector(link.now())
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
        self._watch = SilenceDetector(now)
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


# Novint's Falcon: finding one among what is plugged in.


def open_falcon(options: Mapping[str, object], tell: Notify, backend: Any = None) -> FalconDevice:
    """Finds a Falcon and opens it.

    Args:
        options: Those of ``FAMILY``: names of files and numbers in SI units.
        tell: Told what the user should know or do.
        backend: A pyusb backend; None takes libusb.

    Raises:
        DeviceError: There is none, it cannot be opened, is lost, or an option is not valid.
    """
    numbers = stated_numbers(options, _NUMBERS)
    firmware = str(options["firmware"]) if options.get("firmware") else None
    if firmware is not None:
        read_firmware(firmware)  # a wrong name is said before anything moves
    plugged = select_device(FAMILY, find(FAMILY, backend), options.get("serial"))
    log = HexLog.asked(options)
    link = UsbLink.open(
        plugged, FAMILY, read_from=READ_FROM, write_to=WRITE_TO, backend=backend, log=log
    )
    device = FalconDevice(link, name=str(plugged), firmware=firmware, tell=tell, **numbers)
    device.info = replace(device.info, serial=plugged.serial)
    return device


_NUMBERS = ("mass", "damping", "friction")

FAMILY = Driver(
    name="falcon",
    about="Novint Falcon",
    ids=(UsbId(0x0403, 0xCB48, "Novint Falcon"),),
    transport="usb",
    axes="x, y, z",
    force="8 N",
    rate="1 kHz",
    options=("serial", "firmware", *_NUMBERS, "log"),
    open=open_falcon,
    on_stall="the last force stays on: no watchdog is known, so keep a hand on its power switch",
)
