"""Studies on top of the core: stability maps, charts against other engines, the paper's equations.

``closed_loop`` is the run that most studies make. On it stand ``maps`` (where methods fail),
``chart`` (speed against accuracy, beside other ``engines``) and ``paper`` (the equations of
Brown & Colgate). The core never imports this package.
"""
