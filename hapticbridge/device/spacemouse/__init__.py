"""3Dconnexion SpaceMouse: input without force.

``driver`` is the device, ``reports`` what it sends, ``ids`` which products are one.
"""
