"""Other physics engines on the same work, behind one small interface."""

from hapticbridge.study.engines.base import Contacts as Contacts
from hapticbridge.study.engines.base import Engine as Engine
from hapticbridge.study.engines.base import Setting as Setting
from hapticbridge.study.engines.base import Simulation as Simulation
from hapticbridge.study.engines.base import Wrench as Wrench
from hapticbridge.study.engines.from_scene import task_from_scene as task_from_scene
from hapticbridge.study.engines.library import Engines as Engines
from hapticbridge.study.engines.library import available_engines as available_engines
from hapticbridge.study.engines.library import engine_names as engine_names
from hapticbridge.study.engines.library import open_engine as open_engine
from hapticbridge.study.engines.task import Body as Body
from hapticbridge.study.engines.task import Pose as Pose
from hapticbridge.study.engines.task import Shape as Shape
from hapticbridge.study.engines.task import Task as Task
from hapticbridge.study.engines.task import Velocity as Velocity
from hapticbridge.study.engines.task import composed as composed
