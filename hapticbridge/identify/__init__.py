"""What a device is, measured by moving it a little.

Read ``identification`` first. ``experiment`` moves one axis by the force of ``excitation``;
``weak_form`` makes linear equations of the run, ``fit`` solves them with intervals (``estimate``,
``axis_fit``), ``resolution`` finds the encoder's step, and ``measured_profile`` keeps it all for
later runs. ``wall`` and ``swing`` try walls on the device itself, ``measured_width`` holds them
against theory.
"""

from hapticbridge.identify.axis_fit import AxisFit as AxisFit
from hapticbridge.identify.estimate import Estimate as Estimate
from hapticbridge.identify.fit import fit_axis as fit_axis
from hapticbridge.identify.identification import Identification as Identification
from hapticbridge.identify.identification import identify as identify
