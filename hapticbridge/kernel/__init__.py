"""The arithmetic of a tick, compiled, around MuJoCo's step.

Read ``step`` and ``after`` first, what is done before MuJoCo's step and after it, with ``layout``,
the one record that both work on. ``state`` binds it to a model and to the ``parameters`` of a run;
``native`` and ``addresses`` lend it MuJoCo's functions and memory. Before the step act ``watch``,
``account``, ``handle``, ``tuning`` and ``mocap``; after it ``ports``, ``wrench``, ``meter`` and
``publish``. Some methods have more of their own: ``lossless`` (``midpoint``,
``balanced_velocity``, ``nearness``, ``tree``), ``weld``, ``direct``. ``ahead`` is the half of a
step that runs before its sample, ``simulation`` whole ticks without the interpreter. ``names``,
``codes``, ``scheme`` and ``guarding`` are plain data.
"""
