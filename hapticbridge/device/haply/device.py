"""Haply Inverse3 and its kin: three translations with force, through the maker's own service.

The service answers each message with the state it had when the message came. So a force goes out in
each tick, and its answer is read at the next: force and question go together, as with the Falcon,
and the force that answers a sample acts as many whole ticks later as an answer needs to come back.
At most ``MOST_UNDER_WAY`` messages wait for their answers; where the service is slower than the
loop, the newest force waits for its turn and older ones are left out, so nothing queues up.

The service filters forces. Its force gate and its damping are set when the device is opened, the
first by the option ``force_gate`` (what gain switches the gate off is nowhere said; 0 is sent); its
oscillation damper and its global force scale cannot be set from here, and are named to the user.

Positions are in the service's own frame, right-handed; which way its axes point depends on the
preset and basis chosen there. No real device has moved under this code yet.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    USUAL_SPEED_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_number,
    checked_period,
    stated_numbers,
)
from hapticbridge.device.family import Driver, FoundDevice, Notify, ignore_message, select_device
from hapticbridge.device.haply import messages
from hapticbridge.device.haply.messages import SERVICE, Listed
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.transport.websocket import EXTRA, Link, WebSocketLink, websocket_client
from hapticbridge.device.watchdog import SILENCE, SilenceDetector
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.record import SAMPLE_DTYPE, TickFlag

# How fast a service answers, measured before the loop begins.

TIME = 0.1
"""In s: how long each of the two measurements takes."""

UNDER_WAY = 2
"""Messages kept under way while the rate is measured, as in the loop."""

SHARE = 0.95
"""Share of answers that came within the delay, no unit. The longest are the host's own stalls,
which the loop counts as missed deadlines."""

PACE = 1e-3
"""In s, from message to message while the delay is measured: a loop's period, so that threads sleep
in between as they will in the loop."""

_ANSWER_TIME = 0.05  # s, longer is silence


def measured_timing(link: Link, message: str, name: str) -> tuple[float, float]:
    """Returns at what rate states are delivered, and within what time they come.

    A message carries a force and asks for the state, so both are as old as each other; see
    ``timing``, where the same holds.

    Args:
        link: To a service; no message is under way.
        message: One without force.
        name: What errors call the device.

    Returns:
        The rate in Hz and the delay in s.

    Raises:
        DeviceLost: It fell silent.
    """
    return _rate(link, message, name), _delay(link, message, name)


def _rate(link: Link, message: str, name: str) -> float:
    for _ in range(UNDER_WAY):
        link.send(message)
    _answer(link, name)
    begin = link.now()
    count = 0
    while (now := link.now()) - begin < TIME:
        link.send(message)
        _answer(link, name)
        count += 1
    for _ in range(UNDER_WAY - 1):
        _answer(link, name)
    return count / (now - begin)


def _delay(link: Link, message: str, name: str) -> float:
    times = []
    end = link.now() + TIME
    while (begin := link.now()) < end:
        link.send(message)
        _answer(link, name)
        times.append(link.now() - begin)
        link.wait(max(begin + PACE - link.now(), 0.0))  # nothing comes: it only sleeps
    times.sort()
    return times[math.ceil(SHARE * len(times)) - 1]


def _answer(link: Link, name: str) -> None:
    if link.wait(_ANSWER_TIME) is None:
        raise DeviceLost(f"{name}: fell silent while its timing was measured")


FORCE_LIMIT = 2.0
"""In N: what Isaac Lab's driver limits itself to. The maker publishes no continuous force; more is
to be asked for with the option ``force_limit``."""

FIRST_ANSWER = 1.0
"""In s: longest wait for the list of devices and for the first state."""

LONGEST_PERIOD = 0.02
"""In s. A force holds only for its message; slower, the device falls idle between two ticks."""

MOST_UNDER_WAY = 2
"""Messages without an answer yet. One would leave the service idle while its answer travels."""


class HaplyDevice:
    """A device of the service that is open: its filters are set, its timing has been measured.

    The sheet's ``rate`` is how often states came with two messages always under way, its ``delay``
    the time within which 95 % of the answers to single messages came. Mass, damping, friction and
    resolution are not published; who measured them gives them.

    Args:
        link: To the service, connected; the list of devices has been read from it.
        listed: The device.
        force_gate: Gain of the service's force gate, without unit, >= 0.
        numbers: Of the data sheet, by name.
        tell: Told what the service does to forces.

    Attributes:
        held_back: Forces that were left out because the service was slower than the loop.

    Raises:
        DeviceError: The service scales positions, or does not answer as it should.
        DeviceLost: It is gone.
    """

    def __init__(
        self,
        link: Link,
        listed: Listed,
        *,
        force_gate: float = 0.0,
        numbers: Mapping[str, float] | None = None,
        tell: Notify = ignore_message,
    ) -> None:
        self._link, self._listed = link, listed
        self._name = f"{listed.kind} {listed.device_id}"
        self._is_open, self._is_started = True, False
        self._under_way = self.held_back = 0
        self._pending: tuple[float, ...] | None = None
        known: dict[str, float | None] = {
            "mass": None, "damping": None, "friction": None, "resolution": None,
            "force_limit": FORCE_LIMIT, **(numbers or {}),
        }  # fmt: skip
        try:
            messages.refuse_scaled(listed)
            tell(messages.told_filters(listed, force_gate))
            self._ask(messages.first_message(listed, force_gate))
            rate, delay = measured_timing(
                link, messages.force_message(listed, (0.0, 0.0, 0.0)), self._name
            )
            self.info = DeviceInfo(
                name=listed.kind,
                axes=("x", "y", "z"),
                rotational_inertia=None,
                rotational_damping=None,
                torque_limit=USUAL_TORQUE_LIMIT,
                speed_limit=USUAL_SPEED_LIMIT,
                rate=rate,
                delay=delay,
                is_prescribed=False,
                is_real=True,
                duration=None,
                serial=listed.device_id,
                **known,  # type: ignore[arg-type]
            )
        except BaseException:
            self.close()
            raise
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._sample["quaternion"] = (1.0, 0.0, 0.0, 0.0)
        self._watch = SilenceDetector(link.now())

    def start(self, period: float) -> NDArray[np.void]:
        """Asks for the state, without force.

        Args:
            period: The loop's period in s, at most ``LONGEST_PERIOD``.

        Raises:
            DeviceError: The period is out of range, or the service reports no position.
            DeviceLost: It is gone or silent.
        """
        if checked_period(period) > LONGEST_PERIOD:
            raise DeviceError(
                f"{self._name}: a force holds only for its message, so the rate must be at least "
                f"{1 / LONGEST_PERIOD:g} Hz, not {1 / period:g} Hz"
            )
        self._take()
        self._pending, self.held_back = None, 0
        self._fill(self._ask(messages.force_message(self._listed, (0.0, 0.0, 0.0))))
        self._watch = SilenceDetector(self._link.now())
        self._is_started = True
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Reports the newest state that has come.

        Waits for none, but for the answer to a new question after the loop stood still.

        Args:
            sample: Shape (1,), ``SAMPLE_DTYPE``, filled in place.

        Returns:
            0, or ``TickFlag.STALE_SAMPLE`` where the sample repeats the last one.

        Raises:
            DeviceError: ``start`` has not been called, or what came is no state.
            DeviceLost: The connection has dropped, the device is not listed any more, or nothing
                was answered for ``SILENCE``.
        """
        if not self._is_started:
            raise DeviceError(f"{self._name} is read before it was started")
        is_late = self._watch.was_away(self._link.now())
        newest = self._asked_anew() if is_late else self._take()
        if newest is not None:
            self._fill(newest)
        if self._watch.is_silent(self._link.now(), is_new=newest is not None):
            raise DeviceLost(f"{SERVICE} has not answered for {1e3 * SILENCE:g} ms")
        sample[0] = self._sample[0]
        return int(TickFlag.STALE_SAMPLE) if newest is None else 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Sends a force, and with it the next question; the torque is left out.

        Args:
            wrench: Shape (6,), in the service's frame.

        Raises:
            DeviceError: The force is not finite.
            DeviceLost: The connection has dropped.
        """
        force = tuple(wrench[:3].tolist())
        if not all(map(math.isfinite, force)):
            raise DeviceError(f"{self._name}: a force that is not finite was not sent")
        self.held_back += self._pending is not None
        self._pending = force
        self._send_pending()

    def close(self) -> None:
        """Commands zero force, waits for its answer up to ``SILENCE``, and ends the connection."""
        if not self._is_open:
            return
        self._is_open = self._is_started = False
        try:
            self._take()
            self._link.send(messages.force_message(self._listed, (0.0, 0.0, 0.0)))
            for _ in range(self._under_way + 1):
                self._link.wait(SILENCE)
        except DeviceLost:
            pass  # who sends no forces any more leaves the device idle
        finally:
            self._link.close()

    def _take(self) -> str | None:
        """Takes all answers, sends a force that waited for one; returns the newest answer."""
        answers = self._link.take()
        self._under_way = max(self._under_way - len(answers), 0)
        if answers and self._pending is not None:
            self._send_pending()
        return answers[-1] if answers else None

    def _asked_anew(self) -> str | None:
        """Asks for the state without force, after the loop stood still; returns the answer.

        What waits to be read answers a question from before that, and a force that still waits to
        be sent is as old.
        """
        self._pending = None
        self._take()
        self._link.send(messages.force_message(self._listed, (0.0, 0.0, 0.0)))
        answer = None
        for _ in range(self._under_way + 1):
            if (newer := self._link.wait(SILENCE)) is None:
                break
            answer = newer
        self._under_way = 0
        return answer

    def _send_pending(self) -> None:
        if self._pending is None or self._under_way >= MOST_UNDER_WAY:
            return
        self._link.send(messages.force_message(self._listed, self._pending))
        self._under_way += 1
        self._pending = None

    def _ask(self, message: str) -> str:
        """Sends a message and waits for its answer."""
        self._link.send(message)
        answer = None
        for _ in range(self._under_way + 1):
            answer = self._link.wait(FIRST_ANSWER)
        self._under_way = 0
        if answer is None:
            raise DeviceLost(f"{SERVICE} does not answer")
        return answer

    def _fill(self, message: str) -> None:
        state = messages.state(message, self._listed.device_id)
        self._sample["position"] = state.position
        self._sample["buttons"] = state.buttons


# Haply's Inverse3 and its kin: finding them in the maker's service, and opening one.

PLACE = ("localhost", 10001)
"""Where the service listens unless its configuration says otherwise."""

_NUMBERS = ("mass", "damping", "friction", "resolution", "force_limit")


def open_haply(options: Mapping[str, object], tell: Notify) -> HaplyDevice:
    """Connects to the service and opens one of its devices.

    Args:
        options: ``service`` (HOST:PORT), ``serial`` (the service's device_id), ``force_gate``,
            ``log`` (a file for the messages), and numbers of the data sheet.
        tell: Told what the service does to forces.

    Raises:
        DeviceError: The service does not run, lists no such device, or an option is not valid.
        DeviceLost: It is gone.
    """
    host, port = _place(options.get("service"))
    link = WebSocketLink.open(host, port, SERVICE, HexLog.asked(options))
    return opened(link, options, tell)


def opened(link: Link, options: Mapping[str, object], tell: Notify) -> HaplyDevice:
    """Opens a device of a service that is connected; see ``open_haply``."""
    try:
        numbers = stated_numbers(options, _NUMBERS)
        force_gate = checked_number("force_gate", options.get("force_gate", 0.0), "")
        devices = _devices(link)
        serial = select_device(FAMILY, [_plugged(d) for d in devices], options.get("serial")).serial
        listed = next(device for device in devices if device.device_id == serial)
    except BaseException:
        link.close()
        raise
    return HaplyDevice(link, listed, force_gate=force_gate, numbers=numbers, tell=tell)


def find(place: tuple[str, int] = PLACE) -> list[FoundDevice]:
    """Lists the devices that the service has; empty where it does not run."""
    try:
        link = WebSocketLink.open(*place, SERVICE, HexLog(""))
    except DeviceError:
        return []
    try:
        return [_plugged(device) for device in _devices(link)]
    except DeviceError:
        return []
    finally:
        link.close()


def medium(place: tuple[str, int] = PLACE) -> str:
    """Says in a sentence whether the service runs."""
    if websocket_client() is None:
        return EXTRA
    try:
        WebSocketLink.open(*place, SERVICE, HexLog("")).close()
    except DeviceError as error:
        return f"{error}"
    return f"{SERVICE} runs at {place[0]}:{place[1]}"


def _devices(link: Link) -> list[Listed]:
    message = link.wait(FIRST_ANSWER)
    if message is None:
        raise DeviceError(f"{SERVICE} sent no list of devices within {FIRST_ANSWER:g} s")
    return messages.inventory(message)


def _plugged(device: Listed) -> FoundDevice:
    return FoundDevice(
        family="haply",
        name=device.kind,
        serial=device.device_id,
        path=SERVICE,
        vendor=0,
        product=0,
        transport="service",
        problem=None,
    )


def _place(service: object) -> tuple[str, int]:
    """Returns host and port of HOST:PORT; either may be missing."""
    if service is None:
        return PLACE
    host, _, port = str(service).rpartition(":") if ":" in str(service) else (service, "", PLACE[1])
    try:
        number = int(port)
    except ValueError:
        number = 0
    if not 0 < number < 65536:
        raise DeviceError(f"service = '{service}': must be HOST:PORT, port 1 to 65535")
    return str(host) or PLACE[0], number


FAMILY = Driver(
    name="haply",
    about="Haply Inverse3, Inverse3x and Minverse through the maker's Inverse Service",
    ids=(),
    transport="service",
    axes="x, y, z",
    force=f"{FORCE_LIMIT:g} N unless force_limit says more",
    rate="1 kHz",
    on_stall="the maker's service lets it idle; after how long is not documented",
    options=("service", "serial", "force_gate", *_NUMBERS, "log"),
    open=open_haply,
    find=find,
    medium=medium,
    sought="a device of the Inverse Service",
)
