"""Faults done on purpose to a bridge and its simulated device, and what came of each."""
