"""What a scene models, what that costs, what is wrong with it, and what could go unnoticed.

Read ``case`` first: it leads a scene through its ``motion`` as a bridge would (``rehearsal``) and
keeps what was seen (``observation``). ``inventory`` says what is modelled, ``rules`` what is wrong
(a module of faults per subject, each a ``faults.Fault`` with its place from ``places``), ``cost``
what it takes. ``lean`` then tries to do with less: each edit of ``simplifications`` is made on a
``draft`` and judged by ``trial`` and ``felt``.
"""
