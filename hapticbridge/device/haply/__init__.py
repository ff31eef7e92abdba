"""Haply's Inverse3 and its kin, through the maker's service.

``driver`` is the device, ``messages`` what is said to the service; ``finding`` and ``timing`` come
before the loop.
"""
