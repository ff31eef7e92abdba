"""Novint Falcon, over USB."""
