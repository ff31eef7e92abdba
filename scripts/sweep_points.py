"""Closed loops that ``bench_sweep`` runs: a module, so that workers of a cluster can import it."""

from __future__ import annotations

from functools import cache

from hapticbridge import Coupling
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.device.trajectory import read_motion
from hapticbridge.lab.maps.base import loop_in
from hapticbridge.rendering import IMPLICIT
from hapticbridge.scene.load import scene_path

COUPLING = Coupling(2400, 0.5, 2.4, 5e-4)
PERIOD = 1e-3


@cache
def motion_of(scene: str) -> Motion:
    """Returns the hand path beside a scene, read once a process."""
    return read_motion(scene_path(scene).with_suffix(".csv"))


def one_run(scene: str, ticks: int) -> int:
    """Runs one closed loop in a loop kept per thread; returns its ticks."""
    device = SimulatedDevice(path=motion_of(scene))
    return loop_in(scene).run(device, COUPLING, IMPLICIT, period=PERIOD, ticks=ticks).ticks


def sweep_point(point: dict[str, float | str]) -> dict[str, int]:
    """Runs one closed loop of a sweep."""
    return {"ticks": one_run(str(point["scene"]), int(point["ticks"]))}
