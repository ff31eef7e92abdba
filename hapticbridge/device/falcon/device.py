"""Novint Falcon: three translations with force, over USB.

A packet carries the force and requests the encoders; its reply comes one packet later. While one
reply waits in the serial bridge, the next request is on its way. So each tick sends one packet and
reads the replies that have arrived. A packet is answered, and its force acts, on arrival. From a
sample to the resulting force therefore as many whole ticks pass as a reply takes: two at 1 kHz,
because the bridge holds a reply for up to 1 ms.

The device's frame: x to the right, y away from the user, z up, in m from the middle of the
workspace, 0.125 m before the base. Axes, signs and bits follow libnifalcon's source. The driver has
not been verified on hardware.
"""

from __future__ import annotations

import array
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    TIMING,
    DeviceInfo,
    calling_on_error,
    checked_period,
    released,
    stated_numbers,
    usual_delay,
)
from hapticbridge.device.driver import Driver, Notify, UsbId, ignore_message, select_device
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
    MAX_PERIOD,
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
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.transport.usb import UsbLink, find
from hapticbridge.device.watchdog import SILENCE, SilenceDetector
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

# Measured timing of a Falcon

UNDER_WAY = 2
"""Number of requests kept on their way while the rate is measured, so that one waits when a reply
leaves."""

PACE = 1.07e-3
"""Time in s between requests while the delay is measured. It is slightly longer than the bridge's
timer of 1 ms, so that the requests sweep over all its phases."""

TRIES = 3
"""Number of measurements before a Falcon counts as silent. A reply can be lost on the serial line,
and a busy host can stall for longer than the timeout."""

_ANSWER_TIME = 0.05
"""Longest wait for a reply in s; a longer pause counts as silence."""


def measured_timing(link: Link, stream: ReplyStream, name: str) -> tuple[float, float]:
    """Measures the rate of deliveries in Hz and the delay of replies in s.

    The rate is measured with ``UNDER_WAY`` requests always on their way; replies that arrive
    together are one delivery. The delay is the time from a single request to its reply that the
    share ``device.base.ON_TIME`` of the replies meets. A packet both requests the encoders and
    carries the force, so both have this delay. With one packet per tick the force acts after the
    delay, rounded up to whole ticks, beyond the one tick for which it is held.

    Raises:
        DeviceLost: The device stopped replying.
    """
    for _ in range(TRIES):
        rate = _rate(link, stream)
        if rate is not None and (delay := _delay(link, stream)) is not None:
            return rate, delay
    raise DeviceLost(
        f"{name}: fell silent while its timing was measured; check its cable and its power"
    )


def _rate(link: Link, stream: ReplyStream) -> float | None:
    """Measures the rate in Hz; None if a reply is missing."""
    for _ in range(UNDER_WAY):
        send_question(link)
    begin = last = link.now()
    deliveries = 0
    while last - begin < TIMING:
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
        answers(link, stream, 2 * PACE)  # drain the last replies
    return (deliveries - 1) / (last - begin)


def _delay(link: Link, stream: ReplyStream) -> float | None:
    """Measures the delay in s; None if a reply is missing."""
    times = []
    end = link.now() + TIMING
    while (begin := link.now()) < end:
        if not ask(link, stream, 0, _ANSWER_TIME):
            return None
        times.append(link.now() - begin)
        while (left := begin + PACE - link.now()) > 0:
            link.wait(left)
            link.take()  # the bridge reports its status every millisecond
    return usual_delay(times)


class FalconDevice:
    """An open Falcon: booted, homed, and with measured timing.

    The sheet's ``rate`` is the rate of deliveries with two requests always on their way. Its
    ``delay`` is the time within which 95 % of the replies in 0.1 s came back, over all phases of
    the bridge's timer (``measured_timing``). Mass, damping and friction are unknown unless the user
    states measured values. The resolution follows from the geometry in the middle of the workspace.

    Args:
        link: Link to the Falcon.
        name: Name of the device in messages.
        firmware: Firmware file for a device without firmware; None if it has its firmware.
        numbers: Mass, damping and friction at the grip in kg, N s/m and N, by name, where known.
        notify: Receives messages for the user.

    Raises:
        DeviceError: The device has no firmware and no file was named, it refuses the firmware, or
            it was not homed.
    """

    def __init__(
        self,
        link: Link,
        *,
        name: str = "falcon",
        firmware: str | None = None,
        numbers: Mapping[str, float] | None = None,
        notify: Notify = ignore_message,
    ) -> None:
        self._link, self._name = link, name
        self._stream = ReplyStream()
        self._is_open, self._is_started = True, False
        with calling_on_error(self.close):
            bring_up(link, self._stream, name, firmware, notify)
            home(link, self._stream, name, notify)
            rate, delay = measured_timing(link, self._stream, name)
            known: dict[str, Any] = dict(numbers or {})
            self.info = DeviceInfo(
                name="falcon",
                axes=("x", "y", "z"),
                resolution=resolution(),
                force_limit=FORCE_LIMIT,
                speed_limit=SPEED_LIMIT,
                rate=rate,
                delay=delay,
                **known,
            )
        self._motion = np.zeros(1, MOTION_DTYPE)
        self._last = np.zeros(1, SAMPLE_DTYPE)
        self._packet = array.array("B", bytes(SIZE))
        self._bytes = np.frombuffer(self._packet, np.uint8)
        self._watch = SilenceDetector(link.now())
        self._requested = self._requested_before = self._sample_time = 0.0

    def start(self, period: float) -> NDArray[np.void]:
        """Reads the pose, without force, and compiles the functions of the loop.

        Raises:
            DeviceError: The period is longer than 0.02 s, the encoders match no position of the
                grip, or the device is gone.
        """
        if checked_period(period) > MAX_PERIOD:
            raise DeviceError(
                f"{self._name}: is polled once per tick, so the rate must be at least "
                f"{1 / MAX_PERIOD:g} Hz, not {1 / period:g} Hz"
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
                f"{self._name}: encoder counts {reply['encoders'][0].tolist()} match no position "
                "of the grip; switch its power off and on to home it again"
            )
        now = self._link.now()
        self._watch = SilenceDetector(now)
        self._requested = self._requested_before = self._sample_time = now
        self._is_started = True
        return sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the pose and buttons of the newest reply (1 right, 2 forward, 4 centre, 8 left).

        Impossible replies count as no reply: encoders that match no position of the grip, or a jump
        faster than 3 m/s. The call waits only after a pause of the loop (``ask_anew``).

        Raises:
            DeviceError: The device was not started, is gone, or sent no valid reply for 50 ms.
        """
        if not self._is_started:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        replies = 0
        for packet in self._link.take():
            replies += self._stream.feed(packet)
        if self._watch.was_away(self._link.now()):
            self._requested = self._requested_before = ask_anew(
                self._link, self._stream, self._name
            )
            replies = 1
        now = self._link.now()
        is_believed = False
        if replies:
            # the reply answers the last request or the one before, so its pose is at most that old
            elapsed, self._sample_time = now - self._sample_time, self._requested_before
            verdict = self._believe(self._motion, self._stream.reply, self._last, elapsed)
            is_believed = verdict == BELIEVED
        if self._watch.is_silent(now, is_new=is_believed):
            raise silent(self._name)
        sample[:] = self._last
        return 0 if is_believed else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Sends a force together with the next request; the torque is ignored.

        A packet that is not accepted in time is dropped, except for zero force, which is repeated.

        Raises:
            DeviceLost: The device is gone, or does not accept zero force.
        """
        self._command(self._motion, wrench, self._bytes)
        self._requested_before, self._requested = self._requested, self._link.now()
        if not self._link.write(self._packet) and not wrench.any():
            insist(self._link, self._packet, self._name)

    def close(self) -> None:
        """Commands zero force, switches the lights off and releases the device."""
        if not self._is_open:
            return
        self._is_open = self._is_started = False
        with released(self._link):
            for _ in range(2):  # the first reply may answer a request of the loop
                ask(self._link, self._stream, 0, SILENCE)


# Discovery of a Falcon


def open_falcon(options: Mapping[str, object], notify: Notify, backend: Any = None) -> FalconDevice:
    """Finds and opens a Falcon; ``options`` are those of ``DRIVER``."""
    numbers = stated_numbers(options, _NUMBERS)
    firmware = str(options["firmware"]) if options.get("firmware") else None
    if firmware is not None:
        read_firmware(firmware)  # report a wrong file name before anything moves
    plugged = select_device(DRIVER, find(DRIVER, backend), options.get("serial"))
    log = HexLog.from_options(options)
    link = UsbLink.open(
        plugged, DRIVER, read_from=READ_FROM, write_to=WRITE_TO, backend=backend, log=log
    )
    device = FalconDevice(
        link, name=str(plugged), firmware=firmware, numbers=numbers, notify=notify
    )
    device.info = replace(device.info, serial=plugged.serial)
    return device


_NUMBERS = ("mass", "damping", "friction")

DRIVER = Driver(
    name="falcon",
    about="Novint Falcon",
    ids=(UsbId(0x0403, 0xCB48, "Novint Falcon"),),
    transport="usb",
    axes="x, y, z",
    force="8 N",
    rate="1 kHz",
    options={"serial": str, "firmware": str, **dict.fromkeys(_NUMBERS, float), "log": str},
    open=open_falcon,
    on_stall="the last force stays on: no watchdog is known, so keep a hand on its power switch",
)
