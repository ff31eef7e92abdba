"""What a device is, measured by moving it a little."""

from hapticbridge.identify.axis_fit import AxisFit as AxisFit
from hapticbridge.identify.estimate import Estimate as Estimate
from hapticbridge.identify.fit import fit_axis as fit_axis
from hapticbridge.identify.identification import Identification as Identification
from hapticbridge.identify.identification import identify as identify
