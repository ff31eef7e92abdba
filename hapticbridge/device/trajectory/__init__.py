"""Devices whose motion is given beforehand."""
