"""Force Dimension devices (omega, delta, sigma) through the maker's library.

``device`` is the driver, ``dhd`` the library's functions and models.
"""
