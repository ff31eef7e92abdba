"""Devices that exist only as programs, and the front ends that plug them into real software."""
