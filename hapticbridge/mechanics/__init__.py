"""Reference mechanics without MuJoCo: integrators of known energy, and impact with friction."""

from hapticbridge.mechanics.coupled_mass import CoupledMotion as CoupledMotion
from hapticbridge.mechanics.coupled_mass import drive_mass as drive_mass
from hapticbridge.mechanics.coupled_mass import exact_mass_response as exact_mass_response
from hapticbridge.mechanics.impact import Impact as Impact
from hapticbridge.mechanics.impact import ImpactBody as ImpactBody
from hapticbridge.mechanics.impact import Mode as Mode
from hapticbridge.mechanics.impact import resolve_impact as resolve_impact
from hapticbridge.mechanics.particle import ParticleMotion as ParticleMotion
from hapticbridge.mechanics.particle import integrate_particle as integrate_particle
from hapticbridge.mechanics.rotation import Rotation as Rotation
from hapticbridge.mechanics.rotation import integrate_rotation as integrate_rotation
