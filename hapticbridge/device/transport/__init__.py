"""What carries bytes to devices, and what finds them: HID, USB, WebSocket.

``hid``, ``usb`` and ``websocket`` carry; ``hid_search`` and ``usb_search`` (``usb_bus``) find.
``hid_requests``, ``hid_descriptor`` and ``hid_layout`` are a HID device's account of itself,
``hex_log`` keeps what went over the wire, ``usb_context`` ends libusb in the right order.
"""
