"""The ways in which a wrench reaches the tool, as the kernel counts them."""

from __future__ import annotations

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
