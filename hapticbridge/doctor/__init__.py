"""Diagnosis of a machine's ability to hold a rate.

Read ``diagnosis``: the bridge's clock, a bare sleep loop (``wakeups``) and, if possible,
``cyclictest`` take turns. ``machine`` inspects the system, and one verdict follows.
"""

from hapticbridge.doctor.diagnosis import Diagnosis as Diagnosis
from hapticbridge.doctor.diagnosis import diagnose as diagnose
