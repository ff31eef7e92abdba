"""Haply's Inverse3 and related devices, through the maker's service.

``driver`` is the device and ``messages`` the protocol of the service. ``finding`` and ``timing``
run before the loop.
"""
