"""Other physics engines on the same work, behind one small interface.

Each engine lists its ``settings`` with their values and the page of its manual that advises each. A
chart writes them into its table, its JSON and its page, ``scripts/bench engines`` prints them. The
manuals' addresses, and what the tuned numbers do to a settled peg, are in the engines' modules,
beside the constants. Two settings depart from a manual, and their notes state it. PhysX's
tolerances are those of a clearance and not of an object. Bullet's direct solver is marked
experimental.

| engine | contacts and solver | coupling |
|---|---|---|
| ``mujoco`` | soft, two timesteps; Newton; ``implicitfast`` | held force |
| ``mujoco_warp`` | the same, single precision | held force |
| ``newton_xpbd`` | positions, 50 iterations, single precision | held force |
| ``newton_steel`` | impulses, 200 iterations, single precision | held force |
| ``ode`` | direct solver, contact layer of 0.1 µm | held force |
| ``ode_spring`` | the same | soft joints, solved with the contacts |
| ``physx`` | TGS, 20 iterations, single precision | held force |
| ``physx_spring`` | the same | drives of a joint, solved with the contacts |
| ``pybullet`` | sequential impulses, at most 200 iterations | held force |
| ``pybullet_dantzig`` | direct solver | held force |
| ``drake_point`` | SAP, compliant points | held force |
| ``drake_hydroelastic`` | SAP, compliant tool against rigid shapes | held force |
"""
