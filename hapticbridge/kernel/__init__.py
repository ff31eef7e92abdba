"""The arithmetic of a tick, compiled, around MuJoCo's step.

Read ``tick`` first: the work before and after MuJoCo's step, on the record of ``state``. ``state``
binds that record to a model and to the ``parameters`` of a run. ``handle`` moves the handle,
``coupling`` computes the wrench, ``ledger`` the energies. ``guard`` watches samples and limits the
force; ``passivity_controller`` observes the energy at the device. ``lossless`` and
``compared_methods`` hold what single rendering methods add. ``mujoco_c`` lends MuJoCo's functions
and memory; ``codes`` are plain data.
"""
