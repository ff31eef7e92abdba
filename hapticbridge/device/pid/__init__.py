"""USB force-feedback sticks of the class PID (physical interface device).

``device`` is the driver, ``reports`` the layout of its HID reports, read from its descriptor.
"""
