"""Simulated device in a simulated hand.

``device`` is the driver, ``dynamics`` its exact compiled step, ``hand`` the parameters of the hand.
"""
