"""Brown & Colgate 1997, equation by equation: curves, numbers, and second routes to them."""
