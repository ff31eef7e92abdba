"""An emulated USB device behind the kernel's virtual host controller (vhci), by USB/IP's protocol.

The kernel wants a connected stream socket; a socket pair is enough, because the greeting of USB/IP
is between two programs and the kernel takes no part in it.

References:
    Linux, Documentation/usb/usbip_protocol.rst.
"""

from __future__ import annotations

import errno
import socket
import struct
from pathlib import Path

from emulated.emulator_process import FrontEnd
from emulated.usb_device import TO_HOST, Setup, StallError, UsbDevice

_CONTROLLER = Path("/sys/devices/platform/vhci_hcd.0")
_FREE = "004"
_SUBMIT, _UNLINK, _SUBMITTED, _UNLINKED = 1, 2, 3, 4
_HEADER = 48


class Usbip(FrontEnd):
    """A device plugged into the first free port of the virtual controller.

    Args:
        device: The model, of low, full or high speed.
    """

    def __init__(self, device: UsbDevice) -> None:
        self._device = device
        self._tokens: dict[int, int] = {}
        kernel, self._socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._port = _free_port()
        line = f"{self._port} {kernel.fileno()} {0x10000 + self._port} {device.speed}"
        (_CONTROLLER / "attach").write_text(line)
        kernel.close()
        self._is_attached = True

    def files(self) -> list[int]:
        return [self._socket.fileno()] if self._is_attached else []

    def serve(self, file: int, now: float) -> None:
        header = self._bytes(_HEADER)
        if len(header) < _HEADER:
            self._is_attached = False
            return
        command, sequence, _, is_to_host, endpoint = struct.unpack(">5I", header[:20])
        if command == _SUBMIT:
            length = struct.unpack(">i", header[24:28])[0]
            data = b"" if is_to_host else self._bytes(length)
            address = endpoint | (TO_HOST if is_to_host else 0)
            try:
                self._submit(sequence, address, length, data, header[40:48], now)
            except StallError:
                self._reply(sequence, -errno.EPIPE)
        elif command == _UNLINK:
            token = self._tokens.pop(struct.unpack(">I", header[20:24])[0], None)
            is_cancelled = token is not None and self._device.cancel(token)
            status = -errno.ECONNRESET if is_cancelled else 0
            self._send(struct.pack(">5Ii24x", _UNLINKED, sequence, 0, 0, 0, status))

    def settle(self, now: float) -> float | None:
        return self._device.poll(now)

    def unplug(self) -> None:
        (_CONTROLLER / "detach").write_text(str(self._port))
        self._socket.close()
        self._is_attached = False

    def _submit(
        self, sequence: int, address: int, length: int, data: bytes, setup: bytes, now: float
    ) -> None:
        if address & ~TO_HOST == 0:
            answer = self._device.control(Setup(*struct.unpack("<BBHHH", setup)), data, now)
            self._reply(sequence, 0, answer, len(answer) or len(data))
        elif address & TO_HOST:

            def done(answer: bytes | None) -> None:
                self._tokens.pop(sequence, None)
                self._reply(sequence, -errno.EPIPE if answer is None else 0, answer or b"")

            self._tokens[sequence] = self._device.submit_read(address, length, done)
        else:
            self._device.write(address, data, now)
            self._reply(sequence, 0, b"", len(data))

    def _reply(
        self, sequence: int, status: int, data: bytes = b"", length: int | None = None
    ) -> None:
        length = len(data) if length is None else length
        # start frame, packets and errors mean nothing but for isochronous transfers
        head = struct.pack(">5IiiiiI8x", _SUBMITTED, sequence, 0, 0, 0, status, length, 0, -1, 0)
        self._send(head + data)

    def _send(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except OSError:  # the kernel has let go of the device
            self._is_attached = False

    def _bytes(self, count: int) -> bytes:
        """Returns the next bytes of the stream; fewer where it has ended."""
        parts = bytearray()
        while len(parts) < count:
            try:
                part = self._socket.recv(count - len(parts))
            except OSError:
                break
            if not part:
                break
            parts += part
        return bytes(parts)


def _free_port() -> int:
    """Returns a port for devices up to high speed.

    Raises:
        RuntimeError: All are taken.
    """
    for line in (_CONTROLLER / "status").read_text().splitlines()[1:]:
        hub, port, status = line.split()[:3]
        if hub == "hs" and status == _FREE:
            return int(port)
    raise RuntimeError("all ports of the virtual host controller are taken")
