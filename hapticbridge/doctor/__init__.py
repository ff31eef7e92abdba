"""Whether this machine holds a rate: measured, and what stands in its way."""

from hapticbridge.doctor.diagnosis import Diagnosis as Diagnosis
from hapticbridge.doctor.diagnosis import diagnose as diagnose
