"""Theory of passive haptic display, without MuJoCo.

``bounds`` holds the central results. ``sampled_loop`` confirms them in the time domain, and
``z_width`` combines all limits of a device.
"""

from hapticbridge.passivity.bounds import maximum_stiffness as maximum_stiffness
from hapticbridge.passivity.bounds import minimum_damping as minimum_damping
from hapticbridge.passivity.bounds import stiffest_coupling as stiffest_coupling
from hapticbridge.passivity.compensation import felt_damping as felt_damping
from hapticbridge.passivity.compensation import law_damping as law_damping
from hapticbridge.passivity.compensation import needed_for_felt as needed_for_felt
from hapticbridge.passivity.delay import coupled_stability_limit as coupled_stability_limit
from hapticbridge.passivity.free_device import free_device_damping as free_device_damping
from hapticbridge.passivity.free_device import free_device_stiffness as free_device_stiffness
from hapticbridge.passivity.grid import CouplingGrid as CouplingGrid
from hapticbridge.passivity.matrix import matrix_margin as matrix_margin
from hapticbridge.passivity.quantization import QuantizationLimit as QuantizationLimit
from hapticbridge.passivity.quantization import quantization_limit as quantization_limit
from hapticbridge.passivity.sampled_loop import LoopMotion as LoopMotion
from hapticbridge.passivity.sampled_loop import SampledLoop as SampledLoop
from hapticbridge.passivity.spectrum import damping_spectrum as damping_spectrum
from hapticbridge.passivity.spectrum import damping_spectrum_of as damping_spectrum_of
from hapticbridge.passivity.stability import stability_limit as stability_limit
from hapticbridge.passivity.transmission_line import (
    transmission_line_spectrum as transmission_line_spectrum,
)
from hapticbridge.passivity.transmission_line import (
    transmission_line_stiffness as transmission_line_stiffness,
)
from hapticbridge.passivity.virtual_mass import (
    environment_minimum_damping as environment_minimum_damping,
)
from hapticbridge.passivity.virtual_mass import minimum_mass as minimum_mass
from hapticbridge.passivity.worst_frequency import worst_frequency as worst_frequency
from hapticbridge.passivity.worst_hand import WorstHand as WorstHand
from hapticbridge.passivity.z_width import LimitLine as LimitLine
from hapticbridge.passivity.z_width import ZWidth as ZWidth
from hapticbridge.passivity.z_width import z_width as z_width
