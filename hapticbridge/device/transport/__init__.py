"""Transports to devices, and their discovery: HID, USB, WebSocket.

``hid``, ``usb`` and ``websocket`` carry data; ``hid_search`` and ``usb_search`` (with ``usb_bus``)
find devices. ``hid_requests``, ``hid_descriptor`` and ``hid_layout`` read a HID device's own
description. ``hex_log`` records the transferred bytes. ``usb_context`` ends libusb in the right
order.
"""
