"""What the kernel's functions return, the flags they set, and MuJoCo's kinds of constraints."""

from __future__ import annotations

OK, BAD_SAMPLE, BAD_RESULT, HALF_DONE, RING_FULL = 0, 1, 2, 3, 4
"""Go on; the device's sample is not finite; the simulation's result is not finite; go on, and of
MuJoCo's step only the second half is left to do (``kernel.ahead``); the record found no room."""

JUMPED, BACKWARDS, STRETCHED, TWISTED, GAVE_ENERGY = 11, 12, 13, 14, 15
"""Why a tick is refused before it is computed (``kernel.watch``): the device's pose jumped, time
ran backwards, the coupling is too long or turned too far, the device was given too much energy."""

FORCE_LIMITED, SLEW_LIMITED, RAMPING, CONTROLLER_ACTIVE, CONTACT, CLUTCH = 4, 8, 16, 32, 64, 128
STALE_SAMPLE, TRIP, MIDPOINT, RESEATED = 256, 512, 1024, 2048
"""Bits of ``TickFlag``: the compiler cannot read an enumeration."""

FORCE_OFF, CLUTCHED = 1 << 40, 1 << 41
"""Commands that hold as long as their bit is set in ``commanded``: no force, though the handle
follows the device; or a clutch, as if a button for it were held."""

EQUALITY, LIMIT_JOINT, LIMIT_TENDON, CONTACT_PYRAMIDAL = 0, 3, 4, 6
"""Kinds of constraint rows (``mjtConstraint``), likewise."""

LARGEST_CONTROL = 1e10
"""mjMAXVAL, in N and N m. Beyond it the run has diverged anyway."""
