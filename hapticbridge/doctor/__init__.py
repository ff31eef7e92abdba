"""Whether this machine holds a rate: measured, and what stands in its way.

Read ``diagnosis``: the bridge's clock and a bare sleep loop (``wakeups``) and, where it can run,
``cyclictest`` take turns, ``machine`` looks at the system, and one verdict follows.
"""

from hapticbridge.doctor.diagnosis import Diagnosis as Diagnosis
from hapticbridge.doctor.diagnosis import diagnose as diagnose
