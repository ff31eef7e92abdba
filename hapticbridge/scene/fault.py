"""Faults of a scene, each with its place and remedy, and the numbers in their sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.scene.load import SceneSource
from hapticbridge.scene.scene import Scene
from hapticbridge.scene.source_map import Place, Places

FAILS = {
    "angle unit": True,
    "divergence": True,
    "energy created": True,
    "impossible inertia": True,
    "missing inertia": True,
    "motion not finished": True,
    "MuJoCo warning": True,
    "not passive": True,
    "pump": True,
    "pyramidal cone": True,
    "rate": True,
    "start not finite": True,
    "units": True,
    "unmetered work": True,
    "workspace": True,
    "URDF": False,
    "box edges": False,
    "changed": False,
    "contact sensor": False,
    "creeping friction": False,
    "default contact": False,
    "density of water": False,
    "energy in the slack": False,
    "falling body": False,
    "far grip": False,
    "flex without energy": False,
    "force sensor": False,
    "heavy tool": False,
    "held grip": False,
    "keyframe": False,
    "margin": False,
    "mass ratio": False,
    "mesh faces": False,
    "mesh not convex": False,
    "motor": False,
    "own motion": False,
    "soft contact": False,
    "soft equality": False,
    "soft limit": False,
    "solver iterations": False,
    "starts in contact": False,
    "time step": False,
    "time step matters": False,
    "visual geom with mass": False,
}
"""Kinds of findings, and if a run fails with one. It fails if it does not start, diverges, gets
energy that no guarantee covers, or leaves the device's reach; so probably if the file's units are
wrong. Other findings are notes: the run works, and a change would make it feel better."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One finding on a scene.

    Attributes:
        kind: Name of the kind, one of ``FAILS``.
        place: File, line and element.
        sentence: Description with its numbers.
        change: Text to write at the place.
    """

    kind: str
    place: Place
    sentence: str
    change: str

    @property
    def is_note(self) -> bool:
        """True if a run works without the change; the scene counts as sound."""
        return not FAILS[self.kind]


def number(value: float) -> str:
    """Formats a number with three digits and no exponent: ``2500``, ``0.0375``."""
    if not math.isfinite(value):
        return "infinite"
    return np.format_float_positional(float(f"{value:.3g}"), trim="-")


def length(value: float) -> str:
    """Formats a length given in m: ``375 µm``, ``4.2 mm``, ``3.1 m``."""
    for unit, size in (("m", 1.0), ("mm", 1e-3)):
        if abs(value) >= size:
            return f"{number(value / size)} {unit}"
    return f"{number(1e6 * value)} µm"


def weight(mass: float) -> str:
    """Formats a mass given in kg: ``1.2 kg``, ``35 g``."""
    return f"{number(mass)} kg" if mass >= 0.1 else f"{number(1e3 * mass)} g"


def numbers(values: Iterable[float]) -> str:
    """Formats the values of an attribute: ``0.9 0.95 0.001``."""
    return " ".join(f"{value:g}" for value in values)


def others(count: int) -> str:
    """Returns " and N more", or nothing for N = 0."""
    return f" and {count} more" if count > 0 else ""


@dataclass(frozen=True, slots=True, eq=False)
class CompiledScene:
    """A scene with its files, which is all that a rule without a motion needs.

    Attributes:
        source: The scene as its files describe it.
        scene: The scene as it runs, with handle and coupling.
        places: Lines of the files on which elements are written.
    """

    source: SceneSource
    scene: Scene
    places: Places

    @property
    def model(self) -> mujoco.MjModel:
        """Compiled scene with handle, at its running time step."""
        return self.scene.model

    @property
    def step(self) -> float:
        """Time step h in s."""
        return float(self.model.opt.timestep)

    @property
    def tool_bodies(self) -> NDArray[np.bool_]:
        """True for each body of the grip's tree, (nbody,)."""
        tree = self.model.body_treeid[self.model.site(self.scene.grip).bodyid[0]]
        return np.asarray(self.model.body_treeid == tree, dtype=bool)
