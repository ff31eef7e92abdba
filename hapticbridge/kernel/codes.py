"""What the kernel's functions return, the flags they set, and MuJoCo's kinds of constraints."""

from __future__ import annotations

# What the bridge adds to a scene, by name.

HANDLE = "handle"
"""Name of the mocap body, and of its site, that the bridge adds to a scene."""

WELD_NAME = "handle_weld"
"""Name of the equality constraint that joins the grip to the handle, where a method wants one."""

COUPLING_ACTUATORS = tuple(
    f"coupling_{kind}_{axis}" for kind in ("force", "torque") for axis in ("x", "y", "z")
)
"""Names of the six actuators that couple the grip to the handle, in the order of a wrench."""


# The ways in which a wrench reaches the tool, as the kernel counts them.

COUPLED, HELD, WELD, DIRECT, LOSSLESS = 0, 1, 2, 3, 4
"""How the wrench reaches the tool (``scheme``): by the coupling's actuators, which compute it while
MuJoCo steps; by the same actuators as the wrench of the tick before, held; by an equality
constraint; not at all, because the tool has no mass and is where the handle is; or half by the
actuators and half carried over from the step before (``kernel.lossless``)."""


def has_law(scheme: int) -> bool:
    """Returns whether the coupling law gives the wrench."""
    return scheme in (COUPLED, HELD, LOSSLESS)


def laws_per_tick(scheme: int, substeps: int) -> int:
    """Returns how often per tick the wrench on the tool is computed."""
    return 1 if scheme == HELD else substeps


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
