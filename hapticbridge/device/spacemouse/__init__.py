"""3Dconnexion SpaceMouse: input without force.

``driver`` is the device, ``reports`` decodes its reports, ``ids`` lists the products.
"""
