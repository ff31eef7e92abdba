"""Where methods fail: stability maps, theory drawn over measurement.

Read ``stability_map`` first, then one map with what belongs to it, as ``coupling``,
``coupling_runs`` and ``coupling_picture``: its points and words, what happens at each, how that is
drawn. ``rigs``, ``bisection``, ``verdicts`` and ``palette`` are what maps share.
"""

from hapticbridge.study.maps.contact import CONTACT
from hapticbridge.study.maps.coupling import COUPLING
from hapticbridge.study.maps.device import DEVICE
from hapticbridge.study.maps.geometry import GEOMETRY
from hapticbridge.study.maps.rate import RATE
from hapticbridge.study.maps.restitution import RESTITUTION
from hapticbridge.study.maps.rotation import ROTATION
from hapticbridge.study.maps.stability_map import MapFiles as MapFiles
from hapticbridge.study.maps.stability_map import StabilityMap as StabilityMap
from hapticbridge.study.maps.stability_map import run_map as run_map
from hapticbridge.study.maps.tool_mass import TOOL_MASS

_IN_ORDER = (COUPLING, TOOL_MASS, GEOMETRY, CONTACT, ROTATION, RATE, DEVICE, RESTITUTION)

MAPS = {each.name: each for each in _IN_ORDER}
"""The maps by name, in the order in which they are best read."""
