"""Workloads by name, any scene with a hand path among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hapticbridge.lab.chart import contact_bodies, free_bodies, peg, scene_run
from hapticbridge.lab.chart.workload import Workload


@dataclass(frozen=True, slots=True)
class Extent:
    """Time steps of a chart that a workload depends on.

    Attributes:
        grid: Longest period T in s; runs are compared at its multiples.
        finest: Shortest period T in s.
    """

    grid: float
    finest: float


def open_workload(name: str, extent: Extent) -> Workload:
    """Returns a workload by its name, or by that of a scene.

    Raises:
        HapticBridgeError: There is no such scene, or it has no hand path.
    """
    grid, finest = extent.grid, extent.finest
    known: dict[str, Callable[[], Workload]] = {
        "point_mass": lambda: free_bodies.DrivenMass(scene_run.COUPLING, grid, finest),
        "peg_in_hole": lambda: peg.PegInHole(peg.COUPLING, grid, finest),
        "rod_impact": lambda: contact_bodies.RodImpact(contact_bodies.ROD_COUPLING, grid),
        "sliding_block": lambda: contact_bodies.SlidingBlock(
            contact_bodies.BLOCK_COUPLING, grid, finest
        ),
        "spinning_body": lambda: free_bodies.SpinningBody(free_bodies.COUPLING, grid, finest),
    }
    if name in known:
        return known[name]()
    return scene_run.SceneMotion(name, scene_run.COUPLING, grid, finest)
