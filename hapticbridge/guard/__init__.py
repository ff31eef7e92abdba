"""Safety guard between the computed wrench and the motor.

Read ``limits`` first, the user's limits; then ``guarding``, the kernel's parameters. ``start``
holds the checks before force is enabled, ``trip`` the reasons of a stop. The kernel does the
arithmetic.
"""

from hapticbridge.guard.guarding import CONTROLLERS as CONTROLLERS
from hapticbridge.guard.guarding import button_mask as button_mask
from hapticbridge.guard.guarding import guarding_for as guarding_for
from hapticbridge.guard.limits import UNLIMITED as UNLIMITED
from hapticbridge.guard.limits import USUAL_ENERGY as USUAL_ENERGY
from hapticbridge.guard.limits import USUAL_STRETCH as USUAL_STRETCH
from hapticbridge.guard.limits import Limits as Limits
from hapticbridge.guard.limits import limits_for as limits_for
from hapticbridge.guard.start import refuse_simulated_time as refuse_simulated_time
from hapticbridge.guard.start import refuse_stretched_start as refuse_stretched_start
from hapticbridge.guard.start import wait_until_still as wait_until_still
from hapticbridge.guard.trip import trip_reason as trip_reason
from hapticbridge.guard.trip import with_remedy as with_remedy
