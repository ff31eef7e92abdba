"""Haply's Inverse3 and its kin, through the maker's service."""
