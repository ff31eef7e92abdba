"""Compiled arithmetic of a tick around MuJoCo's step.

Read ``tick`` first: the work before and after MuJoCo's step, for any number of hands. ``state``
lists the sub-records of the kernel's state, their writing modules, and binds them to a model and
the ``parameters`` of a run.

- Coupling: ``handle`` moves the handle, ``law`` evaluates the coupling law, ``force_level`` limits
  its wrench.
- Energy: ``ledger`` keeps the balance and decides the verdict, ``explicit_bias`` takes back what
  MuJoCo's step would create, ``timing`` sums what late forces may have given.
- Contact: ``rigid_contact`` pays for depenetration from a tank; ``colliders`` and ``box_contact``
  find the points and gaps.
- Safety: ``tick_guard`` refuses samples and has the lever between device and handle,
  ``swing_watch`` finds a device with a late or reversed force, ``passivity_controller`` observes
  the energy at the device.
- Methods: ``lossless`` with ``springs``, ``shown_tool`` for a scene that is slower or another
  program's, ``compared_methods``.
- Base: ``mujoco_c`` gives access to MuJoCo's functions and memory; ``codes`` are names and numbers.
"""
