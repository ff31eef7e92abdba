"""3D Systems Touch, Touch X and Phantom devices, through the maker's library OpenHaptics.

``device`` is the driver, ``servo`` the library's functions and the compiled callback that the
library's own thread runs.
"""
