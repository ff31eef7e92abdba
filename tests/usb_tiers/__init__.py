"""Checks that run inside a User-Mode Linux, started by ``emulated.tiers``."""
