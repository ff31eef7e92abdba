"""Theory of passive haptic display: what device damping a coupling needs, and what it allows."""

from hapticbridge.passivity.bounds import maximum_stiffness as maximum_stiffness
from hapticbridge.passivity.bounds import minimum_damping as minimum_damping
from hapticbridge.passivity.bounds import stiffest_coupling as stiffest_coupling
