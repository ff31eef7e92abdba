"""Simulated device in a simulated hand."""
