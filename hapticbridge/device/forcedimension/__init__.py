"""Force Dimension's devices, through the maker's library.

``driver`` is the device and ``finding`` opens it. ``library`` binds the maker's functions, and
``models`` lists the properties of each device type.
"""
