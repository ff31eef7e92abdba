"""Feel a MuJoCo scene through a haptic device, and know under which conditions it cannot kick back.

with hapticbridge.Bridge("peg_in_hole", "simulated", recording="run.mcap") as bridge:
    summary = bridge.run(duration=10.0)
report = hapticbridge.audit("run.mcap")

Read ``bridge`` first, the loop, then ``kernel.tick``, its arithmetic. ``scene`` and ``device`` are
joined by the ``coupling``; ``theory`` has its bounds. ``recording`` keeps a run and ``audit``
judges it a second time. Imports go one way, from ``errors`` to ``cli``.
"""

from typing import TYPE_CHECKING

from hapticbridge.audit import audit as audit  # beside it stands the package of that name
from hapticbridge.lazy import lazy_exports

if TYPE_CHECKING:
    __version__: str
    from hapticbridge import theory as theory
    from hapticbridge.audit import AuditReport as AuditReport
    from hapticbridge.clock import RealClock as RealClock
    from hapticbridge.clock import SimulatedClock as SimulatedClock
    from hapticbridge.coupling import Coupling as Coupling
    from hapticbridge.demand.guard import Limits as Limits
    from hapticbridge.device import Device as Device
    from hapticbridge.device import DeviceInfo as DeviceInfo
    from hapticbridge.device import open_device as open_device
    from hapticbridge.errors import CouplingError as CouplingError
    from hapticbridge.errors import DeviceError as DeviceError
    from hapticbridge.errors import DeviceLost as DeviceLost
    from hapticbridge.errors import HapticBridgeError as HapticBridgeError
    from hapticbridge.errors import RecordingError as RecordingError
    from hapticbridge.errors import SafetyTrip as SafetyTrip
    from hapticbridge.errors import SceneError as SceneError
    from hapticbridge.kernel.record import SAMPLE_DTYPE as SAMPLE_DTYPE
    from hapticbridge.kernel.record import TickFlag as TickFlag
    from hapticbridge.program.device_loop import DeviceLoop as DeviceLoop
    from hapticbridge.program.device_loop import Handle as Handle
    from hapticbridge.program.device_loop import Surface as Surface
    from hapticbridge.recording import read_recording as read_recording
    from hapticbridge.recording import repair as repair
    from hapticbridge.run.bridge import Bridge as Bridge
    from hapticbridge.run.hands import Grasp as Grasp
    from hapticbridge.run.hands import GripAxis as GripAxis
    from hapticbridge.run.options import BridgeOptions as BridgeOptions
    from hapticbridge.run.options import Workspace as Workspace
    from hapticbridge.run.summary import Summary as Summary
    from hapticbridge.scene import Scene as Scene
    from hapticbridge.scene import load_scene as load_scene
    from hapticbridge.scene import scene_names as scene_names
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
