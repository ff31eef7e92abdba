"""Brown & Colgate 1997, equation by equation: curves, numbers, and second routes to them.

``walk`` lists the parts in their order. Each part is a function that returns a ``section`` with its
checks.
"""
