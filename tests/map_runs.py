"""A map at few points, for what its boundary says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from hapticbridge.lab.maps.base import Point, StabilityMap, run_map


def boundary_of(
    module: ModuleType, folder: Path, count: int, keep: Callable[[Point], bool] = bool
) -> Mapping[str, Any]:
    """Draws a map at those of its points that are kept, none of which may fail."""
    drawn = StabilityMap.from_module(module)
    few = replace(drawn, points=lambda n: [point for point in drawn.points(n) if keep(point)])
    with ThreadPoolExecutor(2) as executor:
        files = run_map(few, folder, points=count, workers=executor)
    assert files.failed == 0
    assert files.picture.exists()
    return files.finding.boundary
