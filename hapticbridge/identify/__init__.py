"""Identification of a device's mechanics from small motions.

Read ``identify`` first. It moves one axis by the force of ``excitation``, ``fit`` solves for mass,
damping, friction and delay with intervals, and the result becomes a profile for later runs.
``z_width`` tries virtual walls on the device and compares them with theory.
"""

from hapticbridge.identify.fit import AxisFit as AxisFit
from hapticbridge.identify.fit import Estimate as Estimate
from hapticbridge.identify.fit import fit_axis as fit_axis
from hapticbridge.identify.identify import Identification as Identification
from hapticbridge.identify.identify import identify as identify
