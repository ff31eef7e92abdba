"""Dissipation in a hole over clearance and friction, on all cores or on a dask cluster.

python sweep_on_dask.py [SCHEDULER]      # such as tcp://host:8786
"""

import sys
from typing import Any

import hapticbridge as hb
from hapticbridge.sweep import grid, sweep


def dissipated(point: dict[str, Any]) -> dict[str, float]:
    """Returns the energy in J that the peg scene took in three seconds."""
    with hb.Bridge(hb.load_scene("peg_in_hole", **point), clock=hb.SimulatedClock()) as bridge:
        bridge.run(duration=3.0)
        return {"joules": -bridge.ledger.environment_energy}


if __name__ == "__main__":
    points = grid(clearance=[1e-4, 2e-4], friction=[0.2, 0.4])
    scheduler = sys.argv[1] if len(sys.argv) > 1 else None
    table = sweep(dissipated, points, workers=scheduler)
    for clearance, friction, joules in zip(
        *(table.numbers(name) for name in ("clearance", "friction", "joules")), strict=True
    ):
        print(f"{1e3 * clearance:.1f} mm, friction {friction:.1f}: {1e6 * joules:.3g} µJ")
