"""The Inverse Service as its documentation describes it, with handles that have mechanics.

Written from docs.haply.co (3.5.x), not from the driver: an inventory on connection, one state per
message, forces that hold until the next message and lapse when none comes, and filters.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from emulated.handle import Handle
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import DeviceLost

LAPSE = 0.1
"""Time in s. "If you stop sending them, the device returns to idle"; the time is not documented."""

CENTRE = np.array([0.0, -0.12, 0.15])
"""First position of the cursor in m, as in the documentation's example."""


class Inverse:
    """One device of the service.

    Attributes:
        force: What the motors give, in N.
        gate_gain: Of the force gate.
        damping: Of the service's damping filter, in N s/m.
        position: What to report in the place of the handle's position, or None.
    """

    def __init__(self, device_id: str, mechanics: SimulatedDevice, resolution: float) -> None:
        self.device_id, self.resolution = device_id, resolution
        self.handle = Handle(mechanics)
        self.force = np.zeros(3)
        self.gate_gain, self.damping = 0.3, 0.0
        self.position: Any = None
        self._expires = float("inf")

    def advance(self, now: float) -> None:
        if now >= self._expires:
            self._move(self._expires)
            self.force, self._expires = np.zeros(3), float("inf")
        self._move(now)

    def command(self, force: dict[str, float], now: float) -> None:
        self.force = np.array([force[axis] for axis in "xyz"])
        self._expires = now + LAPSE

    def _move(self, now: float) -> None:
        self.handle.force[:3] = self.force - self.damping * self.handle.velocity()[:3]
        self.handle.advance(now)

    def state(self) -> dict[str, Any]:
        position = CENTRE + self.handle.pose()[0]
        if self.resolution:
            position = self.resolution * np.round(position / self.resolution)
        return {
            "cursor_position": _vector(position) if self.position is None else self.position,
            "cursor_velocity": _vector(self.handle.velocity()[:3]),
            "current_cursor_force": _vector(self.force),
            "control_domain": "cartesian",
            "control_mode": "force",
        }

    def config(self) -> dict[str, Any]:
        return {
            "type": "inverse3",
            "port": "COM12",
            "gravity_compensation": {"enabled": True, "scaling_factor": 1.0},
            "handedness": "right",
            "preset": "defaults",
            "basis": {"permutation": "XYZ"},
            "mount": {"scale": {"x": 1, "y": 1, "z": 1}},
            "filters": {
                "force_gate": {"gain": self.gate_gain},
                "damping": {"scalar": self.damping},
            },
        }


class HaplyService:
    """The service with its devices.

    Args:
        devices: Mechanics by device_id.
        resolution: Step of the reported position in m.

    Attributes:
        is_old: Whether it is of before 3.5: no filters, and forces are called ``values``.
        spoil: Messages by their number (from 1) that are answered with something else.
        messages: How many it has got; ``profile``: what the client calls itself.
        buttons: What the grip's buttons are; ``orientation``: its quaternion, None if it has none.
        grip: Under which key it is listed; empty for no grip.
    """

    def __init__(self, devices: dict[str, SimulatedDevice], resolution: float = 0.0) -> None:
        self.devices = {name: Inverse(name, d, resolution) for name, d in devices.items()}
        self.is_old = False
        self.spoil: dict[int, str] = {}
        self.messages, self.profile = 0, ""
        self.buttons = {"a": False, "b": False, "c": False}
        self.orientation: Any = None
        self.grip = "wireless_verse_grip"
        self.forces: list[list[float]] = []

    def advance(self, now: float) -> None:
        for device in self.devices.values():
            device.advance(now)

    def inventory(self) -> str:
        entries = []
        for device in self.devices.values():
            config = device.config()
            if self.is_old:
                del config["filters"]
            entries.append(
                {"device_id": device.device_id, "config": config, "state": device.state(),
                 "status": {}}
            )  # fmt: skip
        return json.dumps({"session_id": 7, "inverse3": entries})

    def answer(self, message: str, now: float) -> str:
        self.messages += 1
        told = json.loads(message)
        if "session" in told:
            self.profile = told["session"]["configure"]["profile"]["name"]
        self.advance(now)
        for entry in told.get("inverse3", ()):
            device = self.devices[entry["device_id"]]
            configure = entry.get("configure", {})
            device.gate_gain = configure.get("force_gate", {}).get("gain", device.gate_gain)
            device.damping = configure.get("damping", {}).get("scalar", device.damping)
            command = entry["commands"]["set_cursor_force"]
            force = command.get("values" if self.is_old else "vector")
            if force is not None:  # a key that it does not know it does not obey
                device.command(force, now)
                self.forces.append([force[axis] for axis in "xyz"])
        if self.messages in self.spoil:
            return self.spoil[self.messages]
        entries = [{"device_id": d.device_id, "state": d.state()} for d in self.devices.values()]
        held: dict[str, Any] = {"buttons": self.buttons}
        if self.grip == "verse_grip":  # the wired one has a single button
            held = {"button": self.buttons["a"], "hall": 0}
        if self.orientation is not None:
            held["orientation"] = self.orientation
        grips = {self.grip: [{"device_id": "61576", "state": held}]} if self.grip else {}
        return json.dumps({"inverse3": entries, **grips})


class VirtualLink:
    """A connection to the service in virtual time: the methods of ``WebSocketLink``.

    Args:
        service: The service.
        travel: Time in s of a message each way.
        work: Time in s that the service takes for each message, one after the other.

    Attributes:
        clock: Time in s of the service and of the connection.
        last_sent: The last message.
        is_dropped: Whether the connection has dropped; ``is_silent``: whether answers get lost.
    """

    def __init__(self, service: HaplyService, travel: float = 1e-4, work: float = 5e-5) -> None:
        self.service = service
        self.clock = 0.0
        self.is_dropped = self.is_closed = self.is_silent = False
        self.last_sent = ""
        self._travel, self._work, self._free = travel, work, 0.0
        self._there: deque[tuple[float, str]] = deque()
        self._back: deque[tuple[float, str]] = deque([(0.0, service.inventory())])
        service.advance(0.0)

    def advance(self, now: float) -> None:
        while self._there and self._there[0][0] <= now:
            arrival, message = self._there.popleft()
            begin = max(arrival, self._free)
            self._free = begin + self._work
            answer = self.service.answer(message, begin)
            if not self.is_silent:
                self._back.append((self._free + self._travel, answer))
        self.clock = max(self.clock, now)
        self.service.advance(self.clock)

    def now(self) -> float:
        return self.clock

    def send(self, message: str) -> None:
        if self.is_dropped:
            raise DeviceLost("the connection has dropped")
        self.last_sent = message
        self._there.append((self.clock + self._travel, message))

    def take(self) -> list[str]:
        found = []
        while self._back and self._back[0][0] <= self.clock:
            found.append(self._back.popleft()[1])
        if self.is_dropped and not found:
            raise DeviceLost("the connection has dropped")
        return found

    def wait(self, timeout: float) -> str | None:
        end = self.clock + timeout
        while not (self._back and self._back[0][0] <= self.clock):
            if self.clock >= end:
                return None
            due = [queue[0][0] for queue in (self._there, self._back) if queue]
            self.advance(min([end, *(time for time in due if time > self.clock)]))
        return self._back.popleft()[1]

    def close(self) -> None:
        self.is_closed = True


class VirtualTime:
    """The same as a clock's and a loop's time: ``now`` is a number."""

    def __init__(self, link: VirtualLink) -> None:
        self._link = link

    @property
    def now(self) -> float:
        return self._link.clock

    @now.setter
    def now(self, now: float) -> None:
        self._link.advance(now)

    def advance(self, now: float) -> None:
        self._link.advance(now)


@contextmanager
def serving(service: HaplyService) -> Iterator[tuple[int, threading.Event]]:
    """Runs the service as a real WebSocket server; yields its port, and what drops connections."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.server import ServerConnection, serve

    drop = threading.Event()

    def handle(connection: ServerConnection) -> None:
        try:
            connection.send(service.inventory())
            for message in connection:
                if drop.is_set():
                    return
                connection.send(service.answer(str(message), time.monotonic()))
        except ConnectionClosed:
            return

    with serve(handle, "localhost", 0, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server.socket.getsockname()[1], drop
        finally:
            server.shutdown()
            thread.join(2.0)


def _vector(values: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))
