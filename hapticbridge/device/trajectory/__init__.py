"""Devices whose motion is given beforehand.

``motion`` is poses over time, ``motion_csv`` reads them from a file, ``driver`` follows them.
"""
