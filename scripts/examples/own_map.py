"""A stability map of your own: stiffness against tool mass, active or passive, as text."""

import warnings
from typing import Any

import hapticbridge as hb
from hapticbridge.sweep import grid, sweep


def verdict(point: dict[str, Any]) -> dict[str, str]:
    """Runs a wall with a method that does not solve the spring; returns what came of it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns that the method may kick
        scene = hb.load_scene("virtual_wall", mass=point["mass"])
        coupling = {"stiffness": point["stiffness"], "damping": 0.0}
        with hb.Bridge(
            scene, coupling=coupling, method=point["method"], clock=hb.SimulatedClock()
        ) as bridge:
            return {"environment": bridge.run(duration=1.0).environment}


if __name__ == "__main__":
    axes = {"stiffness": [1000.0, 2000.0, 4000.0], "mass": [0.05, 0.2]}
    table = sweep(verdict, grid(method=["implicitfast", "lossless"], **axes), workers=2)
    for row in range(len(table)):
        method, environment = (str(table.texts(name)[row]) for name in ("method", "environment"))
        stiffness, mass = (float(table.numbers(name)[row]) for name in axes)
        print(f"{method:<13} K = {stiffness:4.0f} N/m, {mass:.2f} kg: {environment}")
