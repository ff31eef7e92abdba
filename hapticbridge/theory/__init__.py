"""Theory of passive haptic display, without MuJoCo.

Device damping: ``transfer`` holds the sampled coupling and a transmission line, ``spectrum`` the
damping needed at each frequency, ``bounds`` its supremum (also with delay) and the damping that
each method adds. ``sampled_loop`` finds the same limit in the time domain with the worst hand.
``virtual_mass`` treats the tool's integrator. ``z_width`` adds the limits by quantisation, by
friction and of a free device.

Reference mechanics: ``rigid_body`` moves a body by four integrators of known energy and a mass
behind the coupling; ``impact`` is Routh's method with three laws of restitution.
"""

from hapticbridge.theory.bounds import effective_damping as effective_damping
from hapticbridge.theory.bounds import law_damping as law_damping
from hapticbridge.theory.bounds import maximum_stiffness as maximum_stiffness
from hapticbridge.theory.bounds import minimum_damping as minimum_damping
from hapticbridge.theory.bounds import stiffest_coupling as stiffest_coupling
from hapticbridge.theory.bounds import worst_frequency as worst_frequency
from hapticbridge.theory.impact import Impact as Impact
from hapticbridge.theory.impact import ImpactBody as ImpactBody
from hapticbridge.theory.impact import Mode as Mode
from hapticbridge.theory.impact import resolve_impact as resolve_impact
from hapticbridge.theory.rigid_body import ParticleMotion as ParticleMotion
from hapticbridge.theory.rigid_body import Rotation as Rotation
from hapticbridge.theory.rigid_body import drive_mass as drive_mass
from hapticbridge.theory.rigid_body import exact_mass_response as exact_mass_response
from hapticbridge.theory.rigid_body import integrate_particle as integrate_particle
from hapticbridge.theory.rigid_body import integrate_rotation as integrate_rotation
from hapticbridge.theory.sampled_loop import LoopMotion as LoopMotion
from hapticbridge.theory.sampled_loop import SampledLoop as SampledLoop
from hapticbridge.theory.sampled_loop import WorstHand as WorstHand
from hapticbridge.theory.sampled_loop import stability_limit as stability_limit
from hapticbridge.theory.spectrum import damping_spectrum as damping_spectrum
from hapticbridge.theory.spectrum import damping_spectrum_of as damping_spectrum_of
from hapticbridge.theory.transfer import CouplingGrid as CouplingGrid
from hapticbridge.theory.transfer import (
    transmission_line_spectrum as transmission_line_spectrum,
)
from hapticbridge.theory.transfer import (
    transmission_line_stiffness as transmission_line_stiffness,
)
from hapticbridge.theory.virtual_mass import (
    environment_minimum_damping as environment_minimum_damping,
)
from hapticbridge.theory.virtual_mass import minimum_mass as minimum_mass
from hapticbridge.theory.z_width import LimitLine as LimitLine
from hapticbridge.theory.z_width import QuantizationLimit as QuantizationLimit
from hapticbridge.theory.z_width import ZWidth as ZWidth
from hapticbridge.theory.z_width import free_device_damping as free_device_damping
from hapticbridge.theory.z_width import free_device_stiffness as free_device_stiffness
from hapticbridge.theory.z_width import quantization_limit as quantization_limit
from hapticbridge.theory.z_width import z_width as z_width
