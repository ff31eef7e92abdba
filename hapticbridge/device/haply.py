"""Haply Inverse3 and related devices: three translations with force, through the maker's service.

A VerseGrip that is paired adds its buttons and its orientation. It has no motors, so its three
rotations are ``sensed``: the tool turns with it, and the hand does not feel the torque. The option
``turn=0`` leaves them out. A grip that is not listed any more is a lost device, and so is one that
stays listed and sends no new orientation (``GRIP_SILENCE``).

The service answers each message with the device's state when the message arrived. So each tick
sends a force, and its answer is read in the next tick. As with the Falcon, one message carries the
force and requests the state. The force that responds to a sample acts as many whole ticks later as
an answer takes. At most ``MAX_UNDER_WAY`` messages wait for answers. If the service is slower than
the loop, only the newest force waits and older ones are dropped, so nothing queues up.

The service filters forces. Its force gate and its damping are set when the device is opened, the
force gate by the option ``force_gate``. The gain that disables the gate is not documented; 0 is
sent. Its oscillation damper and its global force scale cannot be set from here and are reported to
the user.

The protocol is that of service 3.5, as documented by the maker: JSON over a WebSocket on port
10001. On connection the service sends an inventory, then exactly one state per received message. A
force lasts for its message; without messages the device idles. Lengths in m, forces in N.

    {"session_id": 7, "inverse3": [{"device_id": "049D", "config": {...}, "state": {...}}]}
    {"inverse3": [{"device_id": "049D", "commands": {"set_cursor_force": {"vector": {...}}}}]}

Services before 3.5 list no filters in the configuration and use the key ``values`` for the force.

Positions are in the service's right-handed frame, whose axes depend on the preset and basis chosen
there. The driver has not been verified on hardware.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    AXES,
    TIMING,
    DeviceInfo,
    calling_on_error,
    checked_number,
    checked_period,
    released,
    stated_numbers,
    stated_switch,
    usual_delay,
)
from hapticbridge.device.driver import Driver, FoundDevice, Notify, ignore_message, select_device
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.transport.websocket import (
    MISSING,
    Link,
    WebSocketLink,
    decoded,
    websocket_client,
)
from hapticbridge.device.watchdog import SILENCE, SilenceDetector
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.files import install_command
from hapticbridge.kernel.pose import Quaternion, canonical
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

# Messages of the Inverse Service

SERVICE = "the Inverse Service"
"""Name of the service in messages."""

FARTHEST = 10.0
"""Largest plausible coordinate in m; no arm is that long."""

GRIPS = ("wireless_verse_grip", "verse_grip")
"""Keys under which VerseGrips are listed, the wireless ones first; the first grip is used."""

BUTTONS = ("a", "b", "c")
"""Bits 0, 1 and 2 of a sample's buttons. A wired grip has one ``button``, which is bit 0."""

ROUNDING = 0.02
"""Largest deviation of a quaternion's norm from 1 that counts as rounding, without unit. The
maker's example has multiples of 2⁻¹⁴; a larger one is another kind of number."""

_ID = re.compile(r"[0-9A-Za-z_-]{1,64}")  # part of a profile's file name


@dataclass(frozen=True, slots=True)
class Listed:
    """A device of the inventory.

    Attributes:
        device_id: Identifier of the device in the service.
        kind: ``inverse3``, ``minverse`` or another type.
        force_key: Key of a force in messages.
        filters: Previous settings of the service's filters, by name; None if it has none.
        is_scaled: True if the service scales the cursor's position.
    """

    device_id: str
    kind: str
    force_key: str
    filters: Mapping[str, float | None] | None
    is_scaled: bool


@dataclass(frozen=True, slots=True)
class State:
    """State of one device.

    Attributes:
        position: Position of the cursor in m.
        buttons: Bit 0 is a, bit 1 b, bit 2 c.
        orientation: Unit quaternion of the VerseGrip in the frame of the position; None without a
            grip, or before it has sent one.
        has_grip: True if a VerseGrip is listed.
    """

    position: tuple[float, float, float]
    buttons: int
    orientation: Quaternion | None = None
    has_grip: bool = False


def inventory(message: str) -> list[Listed]:
    """Returns the devices listed in the service's first message."""
    content = decoded(message, SERVICE)
    if "session_id" not in content and "inverse3" not in content:
        raise DeviceError(f"{SERVICE} sent no list of devices first: {message!r:.60}")
    return [_listed(entry) for entry in _entries(content, "inverse3")]


def state_of(message: str, device_id: str) -> State:
    """Returns a device's state from a state message.

    Raises:
        DeviceError: The message is not a state message, or a number is invalid.
        DeviceLost: The device is no longer listed.
    """
    content = decoded(message, SERVICE)
    for entry in _entries(content, "inverse3"):
        if entry.get("device_id") == device_id:
            grip = _grip(content)
            return State(
                _vector(_part(entry, "state"), "cursor_position"),
                _buttons(grip or {}),
                _orientation(grip or {}),
                has_grip=grip is not None,
            )
    raise DeviceLost(f"the device '{device_id}' is gone: {SERVICE} does not list it any more")


def first_message(listed: Listed, gate_gain: float) -> str:
    """Returns the first message: session name, gain of the force gate, and zero force."""
    device: dict[str, Any] = {"device_id": listed.device_id}
    if listed.filters is not None:
        device["configure"] = {"force_gate": {"gain": gate_gain}, "damping": {"scalar": 0.0}}
    zero = dict.fromkeys("xyz", 0.0)
    device["commands"] = {"set_cursor_force": {listed.force_key: zero}}
    session = {"configure": {"profile": {"name": "hapticbridge"}}}
    return json.dumps({"session": session, "inverse3": [device]})


def refuse_scaled(listed: Listed) -> None:
    """Raises DeviceError for a device whose positions the service scales."""
    if listed.is_scaled:
        raise DeviceError(
            f"{SERVICE} scales the positions of {listed.device_id}, so force times motion would "
            "not be work; set the scale of its mount and transform to 1"
        )


def describe_filters(listed: Listed, gate_gain: float) -> str:
    """Returns a sentence for the user on the service's force filters."""
    if listed.filters is None:
        return (
            f"{SERVICE} is older than 3.5: its force filters stay as they are, and the certificate "
            "does not account for them"
        )
    before = ", ".join(
        f"{name} was {'unknown' if value is None else f'{value:g}'}"
        for name, value in listed.filters.items()
    )
    return (
        f"{SERVICE}: force_gate.gain set to {gate_gain:g}, damping.scalar to 0 ({before}); its "
        "oscillation damper cannot be switched off, and its setting devices/force_scale must be 1"
    )


def force_message(listed: Listed, force: Sequence[float]) -> str:
    """Returns the message that commands a force of three finite numbers in N."""
    x, y, z = force
    return (
        f'{{"inverse3":[{{"device_id":{json.dumps(listed.device_id)},"commands":'
        f'{{"set_cursor_force":{{"{listed.force_key}":{{"x":{x!r},"y":{y!r},"z":{z!r}}}}}}}}}]}}'
    )


def _listed(entry: dict[str, Any]) -> Listed:
    device_id = entry.get("device_id")
    if not isinstance(device_id, str) or not _ID.fullmatch(device_id):
        raise DeviceError(f"{SERVICE} lists a device without a device_id: {entry!r:.60}")
    config = entry.get("config")
    config = config if isinstance(config, dict) else {}
    raw = config.get("filters")
    filters = None
    if isinstance(raw, dict):
        filters = {
            f"{name}.{field}": _number(raw.get(name), field)
            for name, field in (("force_gate", "gain"), ("damping", "scalar"))
        }
    mount, transform = config.get("mount"), _part(entry, "state").get("transform")
    return Listed(
        device_id=device_id,
        kind=str(config.get("type") or "inverse3"),
        force_key="values" if filters is None else "vector",
        filters=filters,
        is_scaled=_is_scaled(mount) or _is_scaled(transform),
    )


def _is_scaled(place: object) -> bool:
    scale = place.get("scale") if isinstance(place, dict) else None
    return isinstance(scale, dict) and any(_number(scale, axis) != 1.0 for axis in "xyz")


def _entries(content: dict[str, Any], key: str) -> list[dict[str, Any]]:
    entries = content.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DeviceError(f"{SERVICE} lists invalid devices under '{key}': {entries!r:.60}")
    return entries


def _part(entry: dict[str, Any], key: str) -> dict[str, Any]:
    part = entry.get(key, {})
    return part if isinstance(part, dict) else {}


def _number(where: object, key: str) -> float | None:
    value = where.get(key) if isinstance(where, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if abs(value) < 1e300 else math.inf


def _vector(where: dict[str, Any], key: str) -> tuple[float, float, float]:
    x, y, z = (_number(where.get(key), axis) for axis in "xyz")
    if x is None or y is None or z is None or not all(abs(v) < FARTHEST for v in (x, y, z)):
        raise DeviceError(f"{SERVICE} reports no position: {key} = {where.get(key)!r:.60}")
    return x, y, z


def _grip(content: dict[str, Any]) -> dict[str, Any] | None:
    """Returns the state of the first VerseGrip; None if none is listed."""
    for name in GRIPS:
        entries = content.get(name)
        if isinstance(entries, list) and entries and isinstance(entries[0], dict):
            return _part(entries[0], "state")
    return None


def _buttons(grip: dict[str, Any]) -> int:
    pressed = _part(grip, "buttons")
    bits = sum(1 << bit for bit, key in enumerate(BUTTONS) if pressed.get(key) is True)
    return bits | (grip.get("button") is True)


def _orientation(grip: dict[str, Any]) -> Quaternion | None:
    """Returns a grip's orientation, of unit length; None if it has sent none yet."""
    if "orientation" not in grip:
        return None
    numbers = [_number(grip["orientation"], axis) for axis in "wxyz"]
    if numbers == [0.0] * 4:
        return None
    size = math.hypot(*(math.nan if number is None else number for number in numbers))
    if not abs(size - 1.0) < ROUNDING:
        raise DeviceError(
            f"{SERVICE} reports no orientation of the VerseGrip: {grip['orientation']!r:.60}"
        )
    w, x, y, z = (float(number or 0.0) / size for number in numbers)
    return canonical((w, x, y, z))


# Measured timing of the service

UNDER_WAY = 2
"""Number of messages kept on their way while the rate is measured, as in the loop."""

PACE = 1e-3
"""Time in s between messages while the delay is measured: a period of the loop, so that threads
sleep in between as in the loop."""

_ANSWER_TIME = 0.05
"""Longest wait for an answer in s; a longer pause counts as silence."""


def measured_timing(link: Link, message: str, name: str) -> tuple[float, float]:
    """Measures the rate of states in Hz and the delay of answers in s.

    A message without force is sent each time. It both carries a force and requests the state, so
    both have this delay.

    Raises:
        DeviceLost: The service stopped answering.
    """
    return _rate(link, message, name), _delay(link, message, name)


def _rate(link: Link, message: str, name: str) -> float:
    for _ in range(UNDER_WAY):
        link.send(message)
    _answer(link, name)
    begin = link.now()
    count = 0
    while (now := link.now()) - begin < TIMING:
        link.send(message)
        _answer(link, name)
        count += 1
    for _ in range(UNDER_WAY - 1):
        _answer(link, name)
    return count / (now - begin)


def _delay(link: Link, message: str, name: str) -> float:
    times = []
    end = link.now() + TIMING
    while (begin := link.now()) < end:
        link.send(message)
        _answer(link, name)
        times.append(link.now() - begin)
        link.wait(max(begin + PACE - link.now(), 0.0))  # no answer is due, so this only sleeps
    return usual_delay(times)


def _answer(link: Link, name: str) -> None:
    if link.wait(_ANSWER_TIME) is None:
        raise DeviceLost(
            f"{name}: fell silent while its timing was measured; restart the Inverse Service"
        )


FORCE_LIMIT = 2.0
"""Largest force in N, as in Isaac Lab's driver. The maker publishes no continuous force; the option
``force_limit`` sets a larger one."""

FIRST_ANSWER = 1.0
"""Longest wait in s for the list of devices and for the first state."""

GRIP_SILENCE = 0.5
"""Time in s without a new orientation after which a VerseGrip counts as lost. A shorter one would
end runs where its radio link stalls; in a longer one a hand turns it farther without the tool."""

GRIP_WAY = 0.03
"""Way in m of the handle without which a repeated orientation is no silence. A grip that rests on
the table repeats it; no hand carries one so far without turning it by a step of 2⁻¹⁴."""

MAX_PERIOD = 0.02
"""Longest period of the loop in s. A force lasts only for its message; at a longer period the
device would idle between two ticks."""

MAX_UNDER_WAY = 2
"""Largest number of messages without an answer. With one, the service would idle while its answer
travels."""


class HaplyDevice:
    """An open device of the service, with its filters set and its timing measured.

    The sheet's ``rate`` is the rate of states with two messages always on their way. Its ``delay``
    is the time within which 95 % of the answers to single messages came. Mass, damping, friction
    and resolution are not published; they are unknown unless the user states measured values.

    Args:
        link: Connected link to the service, after the list of devices was read.
        listed: The device.
        force_gate: Gain of the service's force gate, without unit, >= 0.
        turns: True to report the orientation of a VerseGrip, if one is listed.
        numbers: Numbers of the data sheet, by name.
        notify: Receives a description of the service's force filters.

    Raises:
        DeviceError: The service scales positions, or its answer is invalid.
        DeviceLost: The service is gone.
    """

    def __init__(
        self,
        link: Link,
        listed: Listed,
        *,
        force_gate: float = 0.0,
        turns: bool = True,
        numbers: Mapping[str, float] | None = None,
        notify: Notify = ignore_message,
    ) -> None:
        self._link, self._listed = link, listed
        self._name = f"{listed.kind} {listed.device_id}"
        self._is_open, self._is_started = True, False
        self._under_way = self._overtaken = 0
        self._pending: tuple[float, ...] | None = None
        known: dict[str, Any] = {"force_limit": FORCE_LIMIT, **(numbers or {})}
        with calling_on_error(self.close):
            refuse_scaled(listed)
            notify(describe_filters(listed, force_gate))
            first = self._exchange(first_message(listed, force_gate))
            state = state_of(first, listed.device_id)
            self._turns = turns and state.orientation is not None
            if self._turns:
                notify("the VerseGrip turns the tool without torque on the hand")
            elif state.has_grip and turns:
                notify(
                    "the VerseGrip does not turn the tool, because it has sent no orientation yet; "
                    "move it, and start again"
                )
            elif state.has_grip:
                notify("the VerseGrip does not turn the tool")
            rate, delay = measured_timing(link, force_message(listed, (0.0, 0.0, 0.0)), self._name)
            self.info = DeviceInfo(
                name=listed.kind,
                axes=AXES[:3],
                sensed=AXES[3:] if self._turns else (),
                rate=rate,
                delay=delay,
                serial=listed.device_id,
                **known,
            )
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._sample["quaternion"] = (1.0, 0.0, 0.0, 0.0)
        self._watch = SilenceDetector(link.now())
        self._turned: tuple[float, Quaternion | None] = link.now(), None
        self._turned_at = (0.0, 0.0, 0.0)

    def start(self, period: float) -> NDArray[np.void]:
        """Requests the state, without force.

        Raises:
            DeviceError: The period exceeds ``MAX_PERIOD``, or the service reports no position.
            DeviceLost: The service is gone or silent.
        """
        if checked_period(period) > MAX_PERIOD:
            raise DeviceError(
                f"{self._name}: a force holds only for its message, so the rate must be at least "
                f"{1 / MAX_PERIOD:g} Hz, not {1 / period:g} Hz"
            )
        self._take()
        self._pending, self._overtaken = None, 0
        self._turned = self._link.now(), None
        self._fill(self._exchange(force_message(self._listed, (0.0, 0.0, 0.0))))
        self._watch = SilenceDetector(self._link.now())
        self._is_started = True
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the newest state; waits only after a pause of the loop, for a new answer.

        Raises:
            DeviceError: The device was not started, or an answer is not a state.
            DeviceLost: The connection was lost, the device is no longer listed, no answer came for
                ``SILENCE``, or no new orientation of the VerseGrip for ``GRIP_SILENCE``.
        """
        if not self._is_started:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        is_late = self._watch.was_away(self._link.now())
        if is_late:
            self._turned = self._link.now(), None
        newest = self._fresh_answer() if is_late else self._take()
        if newest is not None:
            self._fill(newest)
        if self._watch.is_silent(self._link.now(), is_new=newest is not None):
            raise DeviceLost(
                f"{SERVICE} has not answered for {1e3 * SILENCE:g} ms; check that it runs"
            )
        sample[0] = self._sample[0]
        return int(TickFlag.STALE_SAMPLE) if newest is None else 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Sends a finite force together with the next request; the torque is ignored."""
        force = tuple(wrench[:3].tolist())
        if not all(map(math.isfinite, force)):
            raise DeviceError(f"{self._name}: a force that is not finite was not sent")
        self._overtaken += self._pending is not None
        self._pending = force
        self._send_pending()

    @property
    def remark(self) -> str:
        """Number of forces that a newer one overtook, as a clause; empty if there were none."""
        return (
            f"{self._overtaken} forces were not sent: newer ones came before the "
            "service had answered earlier ones"
            if self._overtaken
            else ""
        )

    def close(self) -> None:
        """Commands zero force, waits up to ``SILENCE`` for the answer, and disconnects."""
        if not self._is_open:
            return
        self._is_open = self._is_started = False
        with released(self._link):  # without messages the device idles
            self._take()
            self._link.send(force_message(self._listed, (0.0, 0.0, 0.0)))
            for _ in range(self._under_way + 1):
                self._link.wait(SILENCE)

    def _take(self) -> str | None:
        """Returns the newest of all waiting answers, after sending a pending force."""
        answers = self._link.take()
        self._under_way = max(self._under_way - len(answers), 0)
        if answers and self._pending is not None:
            self._send_pending()
        return answers[-1] if answers else None

    def _fresh_answer(self) -> str | None:
        """Requests the state without force after a pause of the loop; returns the answer.

        Waiting answers and a pending force are older than the pause and are discarded.
        """
        self._pending = None
        self._take()
        self._link.send(force_message(self._listed, (0.0, 0.0, 0.0)))
        answer = None
        for _ in range(self._under_way + 1):
            if (newer := self._link.wait(SILENCE)) is None:
                break
            answer = newer
        self._under_way = 0
        return answer

    def _send_pending(self) -> None:
        if self._pending is None or self._under_way >= MAX_UNDER_WAY:
            return
        self._link.send(force_message(self._listed, self._pending))
        self._under_way += 1
        self._pending = None

    def _exchange(self, message: str) -> str:
        """Sends a message and returns its answer."""
        self._link.send(message)
        answer = None
        for _ in range(self._under_way + 1):
            answer = self._link.wait(FIRST_ANSWER)
        self._under_way = 0
        if answer is None:
            raise DeviceLost(f"{SERVICE} does not answer within {FIRST_ANSWER:g} s; restart it")
        return answer

    def _fill(self, message: str) -> None:
        state = state_of(message, self._listed.device_id)
        self._sample["position"] = state.position
        self._sample["buttons"] = state.buttons
        if self._turns:
            self._turn(state)

    def _turn(self, state: State) -> None:
        """Takes the orientation of the VerseGrip, which may be gone or silent."""
        if not state.has_grip:
            raise DeviceLost(
                f"the VerseGrip is gone: {SERVICE} does not list it any more; pair it again, or "
                "use the option turn=0"
            )
        now, newest = self._link.now(), state.orientation
        since, last = self._turned
        if newest is not None:
            self._sample["quaternion"] = newest
        if newest is not None and newest != last:
            self._turned, self._turned_at = (now, newest), state.position
        elif now - since > GRIP_SILENCE and (
            newest is None or math.dist(state.position, self._turned_at) > GRIP_WAY
        ):
            raise DeviceLost(
                f"the VerseGrip is listed, but has sent no new orientation for {GRIP_SILENCE:g} s; "
                "wake it (move it, press a button), charge it, or use the option turn=0"
            )


# Discovery of Haply's devices in the maker's service

PLACE = ("localhost", 10001)
"""Default host and port of the service."""

_NUMBERS = ("mass", "damping", "friction", "resolution", "force_limit")


def open_haply(options: Mapping[str, object], notify: Notify) -> HaplyDevice:
    """Connects to the service and opens one of its devices.

    The options are ``service`` (HOST:PORT), ``serial`` (the service's device_id), ``force_gate``,
    ``turn`` (1 or 0), ``log`` (a file for the messages), and numbers of the data sheet.

    Raises:
        DeviceError: The service does not run, lists no such device, or an option is not valid.
        DeviceLost: The service is gone.
    """
    host, port = _place(options.get("service"))
    link = WebSocketLink.open(host, port, SERVICE, HexLog.from_options(options))
    return opened(link, options, notify)


def opened(link: Link, options: Mapping[str, object], notify: Notify) -> HaplyDevice:
    """Opens a device of a connected service; arguments as for ``open_haply``."""
    with calling_on_error(link.close):
        numbers = stated_numbers(options, _NUMBERS)
        force_gate = checked_number("force_gate", options.get("force_gate", 0.0), "")
        turns = stated_switch(options, "turn")
        devices = _devices(link)
        serial = select_device(DRIVER, [_plugged(d) for d in devices], options.get("serial")).serial
        listed = next(device for device in devices if device.device_id == serial)
    return HaplyDevice(
        link, listed, force_gate=force_gate, turns=turns, numbers=numbers, notify=notify
    )


def find(place: tuple[str, int] = PLACE) -> list[FoundDevice]:
    """Lists the devices of the service; empty if it does not run."""
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
    """Returns a sentence on whether the service runs."""
    if websocket_client() is None:
        return f"{MISSING}: {install_command('haply')}"
    try:
        WebSocketLink.open(*place, SERVICE, HexLog("")).close()
    except DeviceError as error:
        return f"{error}"
    return f"{SERVICE} runs at {place[0]}:{place[1]}"


def _devices(link: Link) -> list[Listed]:
    message = link.wait(FIRST_ANSWER)
    if message is None:
        raise DeviceError(f"{SERVICE} sent no list of devices within {FIRST_ANSWER:g} s")
    return inventory(message)


def _plugged(device: Listed) -> FoundDevice:
    return FoundDevice(
        driver="haply",
        name=device.kind,
        serial=device.device_id,
        path=SERVICE,
        transport="service",
    )


def _place(service: object) -> tuple[str, int]:
    """Returns host and port of HOST:PORT; both are optional."""
    if service is None:
        return PLACE
    host, _, port = str(service).rpartition(":") if ":" in str(service) else (service, "", PLACE[1])
    try:
        number = int(port)
    except ValueError:
        number = 0
    if not 0 < number < 65536:
        raise DeviceError(f"service is '{service}'; it must be HOST:PORT, port 1 to 65535")
    return str(host) or PLACE[0], number


DRIVER = Driver(
    name="haply",
    about="Haply Inverse3, Inverse3x and Minverse through the maker's Inverse Service",
    ids=(),
    transport="service",
    axes="x, y, z; a VerseGrip's rx, ry, rz are sensed without a motor",
    force=f"{FORCE_LIMIT:g} N, or more with force_limit",
    rate="1 kHz",
    on_stall="the maker's service ends the force; the time until then is not documented",
    options={
        "service": str,
        "serial": str,
        **dict.fromkeys(("force_gate", "turn", *_NUMBERS), float),
        "log": str,
    },
    open=open_haply,
    find=find,
    medium=medium,
    products="a device of the Inverse Service",
)
