"""Other physics engines on the same work, behind one small interface.

Each engine tells its own ``settings``: the value of every one, and the page of its manual that
advises it. A chart writes them into its table, its JSON and its page, ``scripts/bench_engines``
prints them. The manuals' addresses, and what the tuned numbers do to a settled peg, are in the
engines' modules, beside the constants. Two settings depart from what a manual says, and say so:
PhysX's tolerances are those of a clearance and not of an object, and Bullet's direct solver is
marked experimental.

| engine | contacts and solver | coupling |
|---|---|---|
| ``mujoco`` | soft, two timesteps; Newton; ``implicitfast`` | held force |
| ``ode`` | direct solver, contact layer of 0.1 µm | held force |
| ``ode_spring`` | the same | soft joints, solved with the contacts |
| ``physx`` | TGS, 20 iterations, single precision | held force |
| ``physx_spring`` | the same | drives of a joint, solved with the contacts |
| ``pybullet`` | sequential impulses, at most 200 iterations | held force |
| ``pybullet_dantzig`` | direct solver | held force |
| ``drake_point`` | SAP, compliant points | held force |
| ``drake_hydroelastic`` | SAP, compliant tool against rigid shapes | held force |
"""

from hapticbridge.lab.engines.base import Body as Body
from hapticbridge.lab.engines.base import Contacts as Contacts
from hapticbridge.lab.engines.base import Engine as Engine
from hapticbridge.lab.engines.base import Engines as Engines
from hapticbridge.lab.engines.base import Pose as Pose
from hapticbridge.lab.engines.base import Setting as Setting
from hapticbridge.lab.engines.base import Shape as Shape
from hapticbridge.lab.engines.base import Simulation as Simulation
from hapticbridge.lab.engines.base import Task as Task
from hapticbridge.lab.engines.base import Velocity as Velocity
from hapticbridge.lab.engines.base import Wrench as Wrench
from hapticbridge.lab.engines.base import available_engines as available_engines
from hapticbridge.lab.engines.base import composed as composed
from hapticbridge.lab.engines.base import engine_names as engine_names
from hapticbridge.lab.engines.base import open_engine as open_engine
from hapticbridge.lab.engines.from_scene import task_from_scene as task_from_scene
