"""The workloads by name; any scene with a hand path is one too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hapticbridge.study.chart import (
    driven_mass,
    peg,
    rod_impact,
    scene_motion,
    sliding_block,
    spinning_body,
)
from hapticbridge.study.chart.workload import Workload


@dataclass(frozen=True, slots=True)
class Extent:
    """What a chart's time steps mean to a workload.

    Attributes:
        grid: Longest period T in s, at whose multiples runs are compared.
        finest: Shortest in s.
    """

    grid: float
    finest: float


def open_workload(name: str, extent: Extent) -> Workload:
    """Returns a workload by its name, or that of a scene.

    Raises:
        HapticBridgeError: There is no such scene, or it has no hand path.
    """
    grid, finest = extent.grid, extent.finest
    known: dict[str, Callable[[], Workload]] = {
        "point_mass": lambda: driven_mass.DrivenMass(scene_motion.COUPLING, grid, finest),
        "peg_in_hole": lambda: peg.PegInHole(peg.COUPLING, grid, finest),
        "rod_impact": lambda: rod_impact.RodImpact(rod_impact.COUPLING, grid),
        "sliding_block": lambda: sliding_block.SlidingBlock(sliding_block.COUPLING, grid, finest),
        "spinning_body": lambda: spinning_body.SpinningBody(spinning_body.COUPLING, grid, finest),
    }
    if name in known:
        return known[name]()
    return scene_motion.SceneMotion(name, scene_motion.COUPLING, grid, finest)
