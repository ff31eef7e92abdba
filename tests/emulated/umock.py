"""An emulated device under umockdev's preload library: hidapi, libusb and libudev are real.

The library sends every read, write and ioctl at a device node to a socket, as three machine words
(what, and two arguments); the answer is the result, before which the client's memory may be read
and written. It does not catch ``poll``, so the nodes are pipes: a hidraw node holds one byte per
report that waits (readable), a usbfs node is full until a transfer can be reaped (writable).

References:
    umockdev 0.17, src/ioctl_tree.c and src/libumockdev-preload.c.
"""

from __future__ import annotations

import os
import socket
from pathlib import Path

from emulated.front_end import FrontEnd
from emulated.hid_device import HidDevice
from emulated.umock_client import Client
from emulated.umock_hidraw import HidrawClient
from emulated.umock_sysfs import add, remove
from emulated.umock_usbfs import UsbfsClient
from emulated.usb_device import UsbDevice


class Umock(FrontEnd):
    """A device plugged into the test bed that ``UMOCKDEV_DIR`` names.

    Args:
        device: The model.
    """

    def __init__(self, device: UsbDevice) -> None:
        self._root = Path(os.environ["UMOCKDEV_DIR"])
        self._device = device
        self._nodes = add(self._root, device)
        self._listeners: dict[int, tuple[socket.socket, str]] = {}
        self._clients: dict[int, Client] = {}
        for node in self._nodes.all():
            path = self._root / "ioctl" / node
            path.parent.mkdir(parents=True, exist_ok=True)
            listener = socket.socket(socket.AF_UNIX)
            listener.bind(str(path))
            listener.listen(8)
            self._listeners[listener.fileno()] = (listener, node)

    def files(self) -> list[int]:
        return [*self._listeners, *self._clients]

    def serve(self, file: int, now: float) -> None:
        if file in self._listeners:
            listener, node = self._listeners[file]
            connection, _ = listener.accept()
            pipe = self._root / node
            client: Client
            if node == self._nodes.usb:
                client = UsbfsClient(connection, pipe, self._device)
            else:
                assert isinstance(self._device, HidDevice)
                is_alone = not any(isinstance(one, HidrawClient) for one in self._clients.values())
                client = HidrawClient(connection, pipe, self._device, is_alone=is_alone)
            self._clients[connection.fileno()] = client
        elif not self._clients[file].serve(now):
            self._clients.pop(file).close()

    def settle(self, now: float) -> float | None:
        due = self._device.poll(now)
        readers = [one for one in self._clients.values() if isinstance(one, HidrawClient)]
        if readers and isinstance(self._device, HidDevice):
            while (report := self._device.take_report()) is not None:
                # one pipe stands for the node, so one program reads: who else opened it only writes
                readers[0].feed(report)
        return due

    def unplug(self) -> None:
        """Takes the nodes away; who has one open is told that the device is gone.

        The connections stay until the clients close them: the library would abort a client that is
        not answered.
        """
        for listener, _ in self._listeners.values():
            listener.close()
        self._listeners = {}
        remove(self._root, self._nodes)
        for client in self._clients.values():
            client.lose_device()
