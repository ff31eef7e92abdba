"""3D Systems Touch, Touch X and Phantom devices, through the maker's library OpenHaptics.

``device`` is the driver, ``hd`` the library's functions and codes, ``servo`` the compiled callback
that the library's own thread runs.
"""
