"""What the kernel's functions return, and the flags they set, as plain integers."""

from __future__ import annotations

OK, BAD_SAMPLE, BAD_RESULT, HALF_DONE, RING_FULL = 0, 1, 2, 3, 4
"""Go on; the device's sample is not finite; the simulation's result is not finite; go on, and of
MuJoCo's step only the second half is left to do (``kernel.ahead``); the record found no room."""

JUMPED, BACKWARDS, STRETCHED, TWISTED, GAVE_ENERGY = 11, 12, 13, 14, 15
"""Why a tick is refused before it is computed (``kernel.watch``): the device's pose jumped, time
ran backwards, the coupling is too long or turned too far, the device was given too much energy."""

CONTACT, TRIP, MIDPOINT = 64, 512, 1024
"""Bits of ``TickFlag``: the compiler cannot read an enumeration."""

LARGEST_CONTROL = 1e10
"""mjMAXVAL, in N and N m. Beyond it the run has diverged anyway."""
