"""Force Dimension's devices, through the maker's library."""
