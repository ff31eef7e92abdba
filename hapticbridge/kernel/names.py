"""What the bridge adds to a scene, by name."""

from __future__ import annotations

HANDLE = "handle"
"""Name of the mocap body, and of its site, that the bridge adds to a scene."""

WELD_NAME = "handle_weld"
"""Name of the equality constraint that joins the grip to the handle, where a method wants one."""

COUPLING_ACTUATORS = tuple(
    f"coupling_{kind}_{axis}" for kind in ("force", "torque") for axis in ("x", "y", "z")
)
"""Names of the six actuators that couple the grip to the handle, in the order of a wrench."""
