"""Devices with a prescribed motion."""
