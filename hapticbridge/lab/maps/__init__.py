"""Stability maps of the rendering methods, theory drawn over measurement.

Read ``base`` first, then one map, such as ``coupling``: its rig, its points, the evaluation of one
point, the reading of its table, its picture and its twins stand in one file. ``twins`` records a
run that fails and its safe twin.

To add a map, write such a file, with ``DEFAULT_POINTS`` and the functions that ``StabilityMap``
names, and add it to ``_IN_ORDER`` below. Its docstring begins with "Map NAME: its subject."
``tests/test_lab_maps_twins.py`` needs its port at fault in ``PORTS``, and in ``DIFFERENCES`` the
value in which its twins differ.
"""

from hapticbridge.lab.maps import (
    contact,
    coupling,
    device,
    geometry,
    rate,
    restitution,
    rotation,
    tool_mass,
)
from hapticbridge.lab.maps.base import MapFiles as MapFiles
from hapticbridge.lab.maps.base import StabilityMap as StabilityMap
from hapticbridge.lab.maps.base import run_map as run_map

_IN_ORDER = (coupling, tool_mass, geometry, contact, rotation, rate, device, restitution)

MAPS = {each.name: each for each in map(StabilityMap.from_module, _IN_ORDER)}
"""The maps by name, in the recommended order of reading."""
