"""Suites for programs built on hapticbridge.

``device_contract`` is what every device must fulfil, for authors of devices.
"""
