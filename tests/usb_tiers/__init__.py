"""Checks that run inside tiers B and C, started by ``emulated.tiers``."""
