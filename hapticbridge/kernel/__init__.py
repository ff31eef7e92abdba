"""Compiled arithmetic of a tick around MuJoCo's step.

Read ``tick`` first: the work before and after MuJoCo's step. ``state`` lists the sub-records of the
kernel's state, their writing modules, and binds them to a model and the ``parameters`` of a run.
``handle`` moves the handle, ``law`` evaluates the coupling law, ``ledger`` keeps the energies.
``hands`` is the tick of several hands that hold one scene.
``tick_guard`` refuses samples and limits the force; ``passivity_controller`` observes the energy at
the device. ``lossless`` and ``compared_methods`` hold one rendering method each, or one group of
them. ``mujoco_c`` gives access to MuJoCo's functions and memory; ``codes`` are names and numbers.
"""
