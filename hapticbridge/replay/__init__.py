"""Recorded runs in pictures.

Read ``stage`` first: it simulates a recording again, tick by tick. ``film`` draws it in a process
of its own, as a picture, a film or numbers.
"""
