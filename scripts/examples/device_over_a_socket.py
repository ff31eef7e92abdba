"""A device behind a socket, whose reading never waits."""

import math
import socket
import struct
import threading
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

import hapticbridge as hb

NUMBER = struct.Struct("<d")  # force in N to the handle, position in m from it


def emulate(link: socket.socket) -> None:
    """Answers each force with the position of a handle that a hand swings."""
    position = velocity = time = 0.0
    while True:
        data, bridge = link.recvfrom(64)
        pull, time = NUMBER.unpack(data)[0] + 0.5 * math.cos(6.0 * time), time + 1e-3
        velocity += 1e-3 * (pull - 2.0 * velocity) / 0.6
        position += 1e-3 * velocity
        link.sendto(NUMBER.pack(position), bridge)


class Handle:
    """One axis over UDP; a serial port is read in the same way."""

    info = hb.DeviceInfo(
        name="handle", axes=("x",), force_limit=10.0, damping=2.0, delay=2e-3, is_real=False
    )

    def start(self, _period: float) -> NDArray[np.void]:
        """Opens the link; nothing else of a device may wait."""
        self.link, self.position = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), 0.0
        self.link.connect(hardware.getsockname())
        self.link.setblocking(False)
        return np.array([((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)], hb.SAMPLE_DTYPE)

    def read(self, sample: NDArray[np.void]) -> int:
        """Takes all positions that have arrived, and keeps the newest."""
        flags: int = hb.TickFlag.STALE_SAMPLE
        with suppress(BlockingIOError):  # nothing more is there
            while True:
                (self.position,), flags = NUMBER.unpack(self.link.recv(64)), 0
        sample[0] = ((self.position, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)
        return flags

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Sends the force along x; one that finds no room is left out."""
        with suppress(BlockingIOError):
            self.link.send(NUMBER.pack(wrench[0]))

    def close(self) -> None:
        """Ends the force, then the link; a second call does nothing."""
        if self.link.fileno() >= 0:
            self.write(np.zeros(6))
            self.link.close()


hardware = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
hardware.bind(("127.0.0.1", 0))
threading.Thread(target=emulate, args=(hardware,), daemon=True).start()
with hb.Bridge("virtual_wall", Handle()) as bridge:
    summary = bridge.run(duration=2.0)
print(f"{summary.peak_force:.2f} N at the wall: {summary.environment}")
