"""Checks and simplification of a scene.

``case`` runs a scene through its motion as a bridge would; ``observe`` records it. ``inventory``
counts the parts of the model. ``findings`` is the table of the rules that tell what is wrong, each
with its place in the files. The rules stand by subject in ``mass_faults``, ``geometry_faults``,
``constraint_faults``, ``contact_faults`` and ``run_faults``; those that a run shows too stand
with the scene.
``cost`` measures the time of a tick. ``lean`` tries the edits of ``simplify`` on a ``version`` of
the scene and compares its motion and its forces (``perception``) with the original;
``lean_output`` writes the result.
"""
