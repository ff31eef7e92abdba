"""What carries bytes to devices, and what finds them: HID, USB, WebSocket."""
