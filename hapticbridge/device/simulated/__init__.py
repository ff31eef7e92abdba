"""Simulated device in a simulated hand.

``driver`` is the device, ``handheld`` its compiled step, ``sampled_axis`` the exact solution of one
axis. ``hand`` and ``scene_hand`` define the hand.
"""
