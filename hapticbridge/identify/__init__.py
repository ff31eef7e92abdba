"""Identification of a device's mechanics from small motions.

Read ``identification`` first. ``experiment`` moves one axis by the force of ``excitation``.
``weak_form`` turns the run into linear equations and ``fit`` solves them with intervals
(``estimate``, ``axis_fit``). ``resolution`` finds the encoder's step, and ``measured_profile``
stores the result for later runs. ``wall`` and ``swing`` try virtual walls on the device,
``measured_width`` compares them with theory.
"""

from hapticbridge.identify.fit import AxisFit as AxisFit
from hapticbridge.identify.fit import Estimate as Estimate
from hapticbridge.identify.fit import fit_axis as fit_axis
from hapticbridge.identify.identify import Identification as Identification
from hapticbridge.identify.identify import identify as identify
