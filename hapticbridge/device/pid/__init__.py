"""USB force-feedback sticks of the class PID.

``driver`` is the device; ``reports`` finds its reports in its own descriptor, ``effects`` pushes
it, ``stick`` reads it, ``sheet`` says what is known, stated and assumed of it.
"""
