"""Identification of a device's mechanics from small motions, and of the walls that it bears."""

from hapticbridge.identify.fit import AxisFit as AxisFit
from hapticbridge.identify.fit import Estimate as Estimate
from hapticbridge.identify.fit import fit_axis as fit_axis
from hapticbridge.identify.identify import Identification as Identification
from hapticbridge.identify.identify import identify as identify
