"""Transport of bytes to devices: HID, USB, WebSocket.

``hid``, ``usb`` and ``websocket`` find and open devices and carry their bytes. ``hid_descriptor``
reads the report layout of a HID device. ``trace`` logs the bytes of a session.
"""
