"""Stability maps of the rendering methods, theory drawn over measurement.

Read ``base`` first, then one map, such as ``coupling``: its rig, its points, the evaluation of one
point, the reading of its table and its picture stand in one file.

To add a map, write such a file, which ends with

    NAME = StabilityMap(
        name="name",
        doc=__doc__,  # begins with "Map NAME: its subject."
        default_points=100,
        points=points,
        evaluate=evaluate,
        summarize=summarize,
        draw=draw,
        sentences=sentences,
    )

and add ``NAME`` to ``_IN_ORDER`` below.
"""

from hapticbridge.lab.maps.base import MapFiles as MapFiles
from hapticbridge.lab.maps.base import StabilityMap as StabilityMap
from hapticbridge.lab.maps.base import run_map as run_map
from hapticbridge.lab.maps.contact import CONTACT
from hapticbridge.lab.maps.coupling import COUPLING
from hapticbridge.lab.maps.device import DEVICE
from hapticbridge.lab.maps.geometry import GEOMETRY
from hapticbridge.lab.maps.rate import RATE
from hapticbridge.lab.maps.restitution import RESTITUTION
from hapticbridge.lab.maps.rotation import ROTATION
from hapticbridge.lab.maps.tool_mass import TOOL_MASS

_IN_ORDER = (COUPLING, TOOL_MASS, GEOMETRY, CONTACT, ROTATION, RATE, DEVICE, RESTITUTION)

MAPS = {each.name: each for each in _IN_ORDER}
"""The maps by name, in the recommended order of reading."""
