"""Force Dimension's devices, through the maker's library.

``driver`` is the device, ``library`` the maker's functions, ``models`` what is known of each kind
beforehand, ``finding`` how one is opened.
"""
