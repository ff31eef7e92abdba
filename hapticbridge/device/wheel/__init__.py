"""Force-feedback wheels and sticks through the force feedback of Linux's input devices.

``device`` is the driver, ``evdev`` the kernel's events, effects and requests.
"""
