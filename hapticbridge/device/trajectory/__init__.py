"""Devices with a prescribed motion.

``motion`` holds poses over time, ``motion_csv`` reads them from a file, ``driver`` follows them.
"""
