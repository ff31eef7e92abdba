"""Haply's Inverse3 through the maker's service.

``device`` is the driver, ``messages`` the JSON messages of the service.
"""
