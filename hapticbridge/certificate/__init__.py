"""Device damping required by a coupling, and the default coupling.

``damping`` computes the requirement with substeps, rate and delay; ``conditions`` compares it with
the device's damping; ``default`` chooses the stiffest coupling that leaves a margin.
"""

from hapticbridge.certificate.conditions import Condition as Condition
from hapticbridge.certificate.conditions import condition_sentences as condition_sentences
from hapticbridge.certificate.conditions import damping_margin as damping_margin
from hapticbridge.certificate.conditions import device_conditions as device_conditions
from hapticbridge.certificate.conditions import is_certified as is_certified
from hapticbridge.certificate.conditions import is_run_certified as is_run_certified
from hapticbridge.certificate.conditions import needed_on_axes as needed_on_axes
from hapticbridge.certificate.conditions import run_conditions as run_conditions
from hapticbridge.certificate.damping import needed_damping as needed_damping
from hapticbridge.certificate.default import NEEDED_SHARE as NEEDED_SHARE
from hapticbridge.certificate.default import UNKNOWN_DAMPING as UNKNOWN_DAMPING
from hapticbridge.certificate.default import assumed_damping as assumed_damping
from hapticbridge.certificate.default import default_coupling as default_coupling
