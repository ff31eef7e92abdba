"""3D Systems Touch, Touch X and Phantom through the maker's library OpenHaptics.

The library is not part of this project; users obtain it from the maker. Its own thread exchanges
samples and forces with the device at about 1 kHz, in the compiled callback of ``servo``. A sample
is up to one servo tick old when it is read, and a force acts in the next servo tick at the latest;
the sheet's delay is both. The firmware's own delay is not documented.

The device's frame is x to the right, y away from the user, z up, with the library's origin. The
stylus turns about three axes without motors. They are ``sensed``, and ``turn=0`` leaves them out.
With them, the tool turns with the stylus, and the hand does not feel the torque.

Mass, damping and friction differ between units and are unknown until ``identify`` has measured
them. The driver has not been verified on hardware.
"""

from __future__ import annotations

import atexit
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    AXES,
    TIMING,
    DeviceInfo,
    calling_on_error,
    checked_period,
    checked_rotation,
    stated_numbers,
    stated_switch,
)
from hapticbridge.device.driver import Driver, FoundDevice, Notify, UsbId, ignore_message
from hapticbridge.device.touch.servo import (
    BY_ENCODER_RESET,
    BY_INKWELL,
    BY_ITSELF,
    CALIBRATED,
    CALIBRATION_STYLE,
    CALLBACK,
    FILES,
    FORCE_OUTPUT,
    MAX_CONTINUOUS_FORCE,
    MAX_FORCE,
    MAX_FORCE_CLAMPING,
    MAX_WORKSPACE,
    MODEL,
    NEEDS_UPDATE,
    NO_DEVICE,
    SERIAL_NUMBER,
    TOP_PRIORITY,
    Hd,
    Servo,
    ServoSample,
)
from hapticbridge.device.transport import usb as usb_search
from hapticbridge.device.watchdog import SILENCE, SilenceDetector, watchdog_time
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

MEASURED = ("mass", "damping", "friction", "resolution")
"""Numbers of the data sheet that are known only from a measurement."""

FARTHEST = 10.0
"""Largest plausible coordinate in m."""

FULL_SHARE = 0.25
"""Share of the watchdog's time at full force, without unit; over the rest the force fades to zero.
At a smaller share short stalls of an ordinary kernel are felt as a dip; at a larger one the force
ends as a step."""

CALIBRATION_TIME = 0.5
"""Longest wait in s for a calibration that needs no hand; a Touch in its inkwell takes some
milliseconds."""

LAST_TICKS = 0.005
"""Time in s for the callback to send zero force before the motors are switched off: five servo
ticks."""

_FROM_LIBRARY = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from the library's axes (x right, y up, z towards the user) to the device's."""


class Waiting(Protocol):
    """Time of the driver, injected by tests."""

    def now(self) -> float:
        """Returns the time in s."""

    def sleep(self, seconds: float) -> None:
        """Waits."""


class RealWaiting:
    """The machine's own time."""

    def now(self) -> float:
        """Implements ``Waiting.now``."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Implements ``Waiting.sleep``."""
        time.sleep(seconds)


class TouchDevice:
    """An open device of OpenHaptics, calibrated, with its servo thread running.

    The sheet's ``rate`` is the measured rate of servo ticks, its ``delay`` two of them. The force
    limit is the lower of the library's and the user's or the model's.

    Args:
        hd: The library.
        config: Name of the device in the maker's setup program; empty for its default.
        turns: True to report the stylus' orientation.
        numbers: Numbers of the data sheet, by name.
        notify: Receives a description of the device.
        waiting: Time in which the servo thread runs.

    Attributes:
        info: Its data sheet.
        servo: The memory shared with the servo thread.

    Raises:
        DeviceError: The device cannot be opened or calibrated, or its largest force is unknown.
    """

    def __init__(
        self,
        hd: Hd,
        config: str = "",
        *,
        turns: bool = True,
        numbers: Mapping[str, float] | None = None,
        notify: Notify = ignore_message,
        waiting: Waiting | None = None,
    ) -> None:
        self._hd, self._time = hd, waiting or RealWaiting()
        self._turns, self._name = turns, config or "Touch"
        self._task, self._is_running, self._is_started = 0, False, False
        hd.errors()
        self._id = int(hd["hdInitDevice"](config.encode() or None))
        self._is_open = self._id != NO_DEVICE
        atexit.register(self.close)  # the servo thread must not outlive the memory it shares
        with calling_on_error(self.close):
            hd.refuse_errors(f"the device '{config or 'default'}' of OpenHaptics cannot be opened")
            if not self._is_open:
                raise DeviceError(f"OpenHaptics opens no device '{config or 'default'}'")
            hd["hdMakeCurrentDevice"](self._id)
            self._name = hd.text(MODEL) or self._name
            serial = hd.text(SERIAL_NUMBER)
            known: dict[str, Any] = dict(numbers or {})
            limit, continuous = self._limits(known)
            self.servo = Servo(hd, self._id, limit)
            self._start_thread()
            self._calibrate()
            rate = self._measured_rate()
            self.info = DeviceInfo(
                name=self._name,
                axes=AXES[:3],
                sensed=AXES[3:] if turns else (),
                **{name: known[name] for name in MEASURED if name in known},
                force_limit=limit,
                rate=rate,
                delay=2.0 / rate,
                serial=serial,
                reach=self._reach(),
            )
        lasting = f", {continuous:.3g} N of it for long" if continuous else ""
        notify(
            f"{self._name}: limit {limit:.3g} N{lasting}; calibrated; its stylus "
            + ("turns the tool without torque on the hand" if turns else "does not turn the tool")
        )
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._sample["quaternion"] = (1.0, 0.0, 0.0, 0.0)
        self._seen = 0
        self._watch = SilenceDetector(self._time.now())

    def start(self, period: float) -> NDArray[np.void]:
        """Sets the watchdog, switches the motors on without force, and reads the pose.

        Raises:
            DeviceError: The period is not valid, or the device reports no pose.
            DeviceLost: The servo thread stands still, or the library reports an error.
        """
        ticks = watchdog_time(checked_period(period)) * (self.info.rate or 0.0)
        hold = max(round(FULL_SHARE * ticks), 1)
        self.servo.watch(hold, max(round(ticks) - hold, 1))
        self.servo.send((0.0, 0.0, 0.0))
        self._hd.errors()
        self.servo.forget()
        self._hd["hdEnable"](MAX_FORCE_CLAMPING)
        self._hd["hdEnable"](FORCE_OUTPUT)
        self._hd.refuse_errors(f"{self._name}: its force cannot be switched on")
        self._fill(self._next_sample())
        self._watch = SilenceDetector(self._time.now())
        self._is_started = True
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the pose of the newest servo tick.

        Raises:
            DeviceError: The device was not started, or reports an invalid pose.
            DeviceLost: The library reported an error, lost the calibration, or gave no new sample
                for ``SILENCE``.
        """
        if not self._is_started:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        self._refuse_faults()
        newest = self.servo.newest()
        is_new = newest.ticks != self._seen
        if is_new:
            self._fill(newest)
        if self._watch.is_silent(self._time.now(), is_new=is_new):
            raise DeviceLost(
                f"{self._name}: OpenHaptics' servo thread has given no sample for "
                f"{1e3 * SILENCE:g} ms; check its cable and its power"
            )
        sample[0] = self._sample[0]
        return 0 if is_new else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a finite force from the next servo tick on; the torque is ignored."""
        x, y, z = wrench[:3].tolist()
        if not all(map(math.isfinite, (x, y, z))):
            raise DeviceError(f"{self._name}: a force that is not finite was not sent")
        self.servo.send((x, z, -y))  # to the library's axes

    @property
    def faded(self) -> int:
        """Number of servo ticks in which the watchdog lowered the force."""
        return self.servo.faded

    def close(self) -> None:
        """Commands zero force, switches the motors off, and releases the device."""
        atexit.unregister(self.close)
        if not self._is_open:
            return
        self._is_open = self._is_started = False
        if self._is_running:
            self.servo.send((0.0, 0.0, 0.0))
            self._time.sleep(LAST_TICKS)
        self._hd["hdDisable"](FORCE_OUTPUT)
        if self._is_running:
            self._hd["hdStopScheduler"]()
            self._hd["hdUnschedule"](self._task)
        self._hd["hdDisableDevice"](self._id)

    def _limits(self, known: Mapping[str, float]) -> tuple[float, float]:
        """Returns the largest force and the largest lasting force in N; the latter 0 if unknown."""
        most, lasting = (self._hd.numbers(each, 1) for each in (MAX_FORCE, MAX_CONTINUOUS_FORCE))
        stated = [known["force_limit"]] if "force_limit" in known else []
        stated += [most[0]] if most and 0.0 < most[0] < math.inf else []
        if not stated:
            raise DeviceError(
                f"the largest force of {self._name} is unknown to its library; set it with "
                "force_limit="
            )
        return min(stated), lasting[0] if lasting and 0.0 < lasting[0] < math.inf else 0.0

    def _reach(self) -> float | None:
        """Returns the distance in m of the workspace's farthest corner from the origin."""
        ends = self._hd.numbers(MAX_WORKSPACE, 6)
        if ends is None:
            return None
        reach = 1e-3 * math.hypot(*(max(abs(ends[i]), abs(ends[i + 3])) for i in range(3)))
        return reach if 0.0 < reach < FARTHEST else None

    def _start_thread(self) -> None:
        hd = self._hd
        self._task = hd["hdScheduleAsynchronous"](
            CALLBACK(self.servo.callback.address), self.servo.address, TOP_PRIORITY
        )
        hd["hdStartScheduler"]()
        self._is_running = True
        hd.refuse_errors(f"{self._name}: OpenHaptics' servo thread cannot be started")
        self._next_sample()

    def _calibrate(self) -> None:
        """Calibrates the device if it can do so by itself.

        Raises:
            DeviceError: It needs the user's hand; the message says what to do.
        """
        hd = self._hd
        state = int(hd["hdCheckCalibration"]())
        styles = hd.integer(CALIBRATION_STYLE)
        end = self._time.now() + CALIBRATION_TIME
        while state == NEEDS_UPDATE and self._time.now() < end:
            hd["hdUpdateCalibration"](BY_ITSELF if styles & BY_ITSELF else styles)
            self._time.sleep(0.1 * CALIBRATION_TIME)
            hd.errors()
            state = int(hd["hdCheckCalibration"]())
        self.servo.forget()
        if state == CALIBRATED:
            return
        if styles & BY_INKWELL:
            remedy = "put the stylus into its inkwell and start again"
        elif styles & BY_ENCODER_RESET:
            remedy = "hold the arm in its reset position, run the maker's calibration, start again"
        else:
            remedy = "move the arm through its whole workspace and start again"
        raise DeviceError(f"{self._name} is not calibrated: {remedy}")

    def _measured_rate(self) -> float:
        first, begin = self._next_sample(), self._time.now()
        self._time.sleep(TIMING)
        last = self.servo.newest()
        return (last.ticks - first.ticks) / (self._time.now() - begin) or 1.0

    def _next_sample(self) -> ServoSample:
        """Waits for a sample of a later servo tick.

        Raises:
            DeviceLost: None comes within ``SILENCE``.
        """
        before, end = self.servo.newest().ticks, self._time.now() + SILENCE
        while (newest := self.servo.newest()).ticks == before:
            if self._time.now() > end:
                raise DeviceLost(
                    f"{self._name}: OpenHaptics' servo thread does not run; check the cable and "
                    "the power of the device"
                )
            self._time.sleep(1e-3)
        return newest

    def _refuse_faults(self) -> None:
        if code := self.servo.error:
            raise DeviceLost(f"{self._name} has ended its force: {self._hd.cause(code)}")
        if not self.servo.is_calibrated:
            raise DeviceLost(f"{self._name} has lost its calibration; start again")

    def _fill(self, newest: ServoSample) -> None:
        self._seen = newest.ticks
        position = 1e-3 * newest.position
        if not (np.abs(position) < FARTHEST).all():
            raise DeviceError(
                f"{self._name} reports an impossible position: {position.tolist()} m; each "
                f"must be within {FARTHEST:g} m"
            )
        self._sample["position"] = _FROM_LIBRARY @ position
        self._sample["buttons"] = newest.buttons & 0xFFFF
        if self._turns:
            turned = newest.transform.reshape(4, 4).T[:3, :3]  # column by column
            frame = _FROM_LIBRARY @ turned @ _FROM_LIBRARY.T
            self._sample["quaternion"] = checked_rotation(frame.ravel().tolist(), self._name)


# Discovery of the maker's devices

_NUMBERS = (*MEASURED, "force_limit")


def open_touch(
    options: Mapping[str, object], notify: Notify, waiting: Waiting | None = None
) -> TouchDevice:
    """Loads the library and opens one of its devices.

    The options are ``library`` (its file), ``config`` (the device's name in the maker's setup),
    ``turn`` (1 or 0), and numbers of the data sheet.

    Raises:
        DeviceError: The library or the device cannot be opened, or an option is not valid.
        DeviceLost: The device is gone.
    """
    numbers = stated_numbers(options, _NUMBERS)
    turns = stated_switch(options, "turn")
    return TouchDevice(
        Hd(FILES.located(options.get("library"))),
        str(options.get("config", "")),
        turns=turns,
        numbers=numbers,
        notify=notify,
        waiting=waiting,
    )


def find() -> list[FoundDevice]:
    """Lists the devices on USB by the kernel's word, because the library only opens them."""
    try:
        Hd(FILES.located())
        problem = None
    except DeviceError as error:
        problem = str(error)
    return [
        replace(device, problem=problem, lacks_permission=False)
        for device in usb_search.find(DRIVER)
    ]


def medium() -> str:
    """Returns a sentence on whether the library was found."""
    try:
        return f"OpenHaptics' library was found: {Hd(FILES.located()).path}"
    except DeviceError as error:
        return str(error)


DRIVER = Driver(
    name="touch",
    about="3D Systems Touch, Geomagic and Phantom (Omni) through the maker's library (OpenHaptics)",
    ids=(UsbId(0x2988, 0x0302, "3D Systems Touch"), UsbId(0x2988, 0x0304, "3D Systems Touch")),
    vendor=0x2988,
    subsystem="tty",
    transport="library",
    axes="x, y, z; the stylus' rx, ry, rz are sensed without a motor",
    force="the library's limit (3.3 N on a Touch, 7.9 N on a Touch X)",
    rate="1 kHz, in the library's own thread",
    on_stall="the library's thread fades a force that the program does not renew to zero within "
    "20 ms; if the machine stands still, the device's own behaviour is not documented",
    options={
        "library": str,
        "config": str,
        **dict.fromkeys(("turn", *_NUMBERS), float),
    },
    open=open_touch,
    find=find,
    medium=medium,
    products="a device of OpenHaptics",
)
"""Driver of the maker's devices. Those on FireWire, Ethernet or a parallel port are opened too, but
not listed: only the maker's setup program knows them, by the name that ``config`` takes."""
