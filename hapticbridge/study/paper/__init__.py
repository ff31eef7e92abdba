"""Brown & Colgate 1997, equation by equation: curves, numbers, and second routes to them.

``walk`` has the parts in their order. Each is a module that returns a ``section`` with its
``check``s; ``page`` writes them.
"""
