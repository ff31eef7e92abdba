"""The ways in which a wrench reaches the tool, as the kernel counts them."""

from __future__ import annotations

COUPLED, HELD, WELD, DIRECT, LOSSLESS = 0, 1, 2, 3, 4
"""How the wrench reaches the tool (``scheme``): by the coupling's actuators, which compute it while
MuJoCo steps; by the same actuators as the wrench of the tick before, held; by an equality
constraint; not at all, because the tool has no mass and is where the handle is; or half by the
actuators and half carried over from the step before (``kernel.lossless``)."""
