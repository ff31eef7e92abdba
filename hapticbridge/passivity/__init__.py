"""Theory of passive haptic display: what device damping a coupling needs, and what it allows."""

from hapticbridge.passivity.bounds import maximum_stiffness as maximum_stiffness
from hapticbridge.passivity.bounds import minimum_damping as minimum_damping
from hapticbridge.passivity.bounds import stiffest_coupling as stiffest_coupling
from hapticbridge.passivity.delay import coupled_stability_limit as coupled_stability_limit
from hapticbridge.passivity.grid import CouplingGrid as CouplingGrid
from hapticbridge.passivity.matrix import matrix_margin as matrix_margin
from hapticbridge.passivity.quantization import QuantizationLimit as QuantizationLimit
from hapticbridge.passivity.quantization import quantization_limit as quantization_limit
from hapticbridge.passivity.spectrum import damping_spectrum as damping_spectrum
from hapticbridge.passivity.spectrum import damping_spectrum_of as damping_spectrum_of
from hapticbridge.passivity.virtual_mass import (
    environment_minimum_damping as environment_minimum_damping,
)
from hapticbridge.passivity.virtual_mass import minimum_mass as minimum_mass
