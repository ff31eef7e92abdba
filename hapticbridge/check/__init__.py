"""Checks and simplification of a scene.

``case`` leads a scene through its ``motion`` as a bridge would and keeps an ``observation``.
``inventory`` counts the model's parts. ``rules`` lists the faults; each is a ``faults.Fault`` with
its place in the files. ``cost`` measures the time of a tick. ``lean`` tries the edits of
``simplifications`` on a ``draft``; ``trial`` judges each by its cost and by the force difference of
``felt``.
"""
