"""The methods that render a rigid tool, behind one interface.

A method decides how the coupling's wrench reaches the tool: which integrator MuJoCo uses and which
gains its actuators get. The tick's arithmetic is the kernel's in every method.
"""

from __future__ import annotations

from dataclasses import dataclass

from hapticbridge.coupling import Coupling
from hapticbridge.errors import SceneError, choices
from hapticbridge.scene import Scene


@dataclass(frozen=True, slots=True)
class Method:
    """A way to render.

    Attributes:
        name: What ``--method`` and the recording's metadata call it.
        discretization: How the coupling's damper is discretised, as the bounds call it.
        about: One sentence.
    """

    name: str
    discretization: str
    about: str


IMPLICIT = Method(
    name="implicit",
    discretization="backward",
    about="the coupling as actuators under MuJoCo's discrete integrator: implicit in position and "
    "velocity, solved together with the contacts, passive behind the coupling",
)

METHODS = {method.name: method for method in (IMPLICIT,)}


def method_named(name: str) -> Method:
    """Returns a method by its name.

    Raises:
        SceneError: There is no such method; lists those that exist.
    """
    if name not in METHODS:
        raise SceneError(f"no method is called '{name}'; methods: {choices(METHODS)}")
    return METHODS[name]


def prepare(scene: Scene, coupling: Coupling, period: float, substeps: int) -> None:
    """Makes a scene render a coupling by ``implicit``: gains, timestep, and the scene reset.

    Args:
        scene: Changed in place.
        coupling: What the user should feel.
        period: T in s.
        substeps: MuJoCo steps per tick.

    Raises:
        SceneError: Period or substeps are out of range.
    """
    scene.set_timestep(period, substeps)
    scene.set_coupling(coupling)
    scene.reset()
