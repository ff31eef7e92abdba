"""Client of the page's socket: sends what a browser would, and what none would."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import viser
import zstandard
from waiting import PATIENCE
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from hapticbridge.view.window import Address


class Hand:
    """A connection to a page.

    Attributes:
        socket: The connection.
        elements: Of the page, by their labels: uuid and what they were made with.
        values: To which the page has set its elements since, by uuid.
    """

    def __init__(self, socket: Connection) -> None:
        self.socket = socket
        self.elements: dict[str, dict[str, Any]] = {}
        self.values: dict[str, Any] = {}

    def read(self, seconds: float) -> list[dict[str, Any]]:
        """Returns what the page sends within a time, and notes its elements."""
        found: list[dict[str, Any]] = []
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            with contextlib.suppress(TimeoutError):
                frame = self.socket.recv(timeout=left)
                assert isinstance(frame, bytes)
                size, packed = (int.from_bytes(frame[i : i + 8], "little") for i in (0, 8))
                inner = zstandard.ZstdDecompressor().decompress(
                    frame[16 : 16 + packed], max_output_size=size
                )
                found += msgspec.msgpack.decode(inner)["messages"]
        for message in found:
            label = message.get("props", {}).get("label")
            if label:
                self.elements[label] = message
            if message["type"] == "GuiUpdateMessage" and "value" in message["updates"]:
                self.values[message["uuid"]] = message["updates"]["value"]
        return found

    def shows(self, label: str, value: Any) -> bool:
        """Tells whether the page has set an element to a value since it was made."""
        self.read(0.02)
        return bool(self.values.get(self.find(label)["uuid"]) == value)

    def find(self, label: str) -> dict[str, Any]:
        """Returns an element once the page has told of it."""
        end = time.monotonic() + PATIENCE
        while label not in self.elements:
            assert time.monotonic() < end, f"the page has no {label}: {list(self.elements)}"
            self.read(0.2)
        return self.elements[label]

    def send(self, label: str, **updates: Any) -> None:
        """Sends what a browser sends when an element is changed; unlike one, anything."""
        self.say(type="GuiUpdateMessage", uuid=self.find(label)["uuid"], updates=updates)

    def introduce(self) -> None:
        """Sends the camera; before that a page listens to nobody."""
        zero, one = (0.0, 0.0, 0.0), {"fov": 1.0, "near": 0.01, "far": 10.0}
        pose = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": zero, "look_at": zero}
        size = {"image_height": 100, "image_width": 100, "up_direction": (0.0, 0.0, 1.0)}
        self.say(type="ViewerCameraMessage", **one, **pose, **size)

    def say(self, **message: Any) -> None:
        """Sends any message."""
        self.socket.send(msgspec.msgpack.encode(message))


@contextlib.contextmanager
def hand(url: str) -> Iterator[Hand]:
    """Connects to a page."""
    version = [Subprotocol(f"viser-v{viser.__version__}")]
    page, _, token = url.partition("/?token=")
    host = page.removeprefix("http://")
    cookie = {"Cookie": Address(0, token).cookie(host).partition(";")[0]}
    with connect(
        f"ws://{host}/", subprotocols=version, max_size=None, additional_headers=cookie
    ) as socket:
        found = Hand(socket)
        found.introduce()
        yield found


def said(page: Hand, word: str) -> str:
    """Returns what the page says with a word in it, once it does."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        for message in page.read(0.2):
            for part in (message.get("updates", {}), message.get("props", {})):
                text = str(part.get("_markdown", ""))
                if word in text:
                    return text
    raise AssertionError(f"the page never said {word}")
