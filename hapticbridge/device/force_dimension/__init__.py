"""Force Dimension devices (omega, delta, sigma) through the maker's own library."""
