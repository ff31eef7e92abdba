"""Transports to devices, and their discovery: HID, USB, WebSocket."""
