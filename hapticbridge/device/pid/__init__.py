"""USB force-feedback sticks (class PID).

``driver`` is the device. ``reports`` finds its reports in its descriptor, ``effects`` applies
forces, ``stick`` reads it, and ``sheet`` makes its scale and data sheet.
"""
