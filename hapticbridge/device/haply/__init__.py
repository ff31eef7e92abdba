"""Haply's Inverse3 and related devices, through the maker's service."""
