"""Simulated device in a simulated hand.

``device`` is the driver, ``dynamics`` the hand and the exact compiled step.
"""
