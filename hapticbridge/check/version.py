"""A version of a scene under simplification."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.check.case import samples_of
from hapticbridge.check.observe import Playback, Setting, rehearse
from hapticbridge.device import Motion
from hapticbridge.scene import Scene, SceneSource, compile_scene


@dataclass(slots=True)
class SceneVariant:
    """A version of a scene.

    Attributes:
        source: Scene source whose specification belongs to this draft alone and may be changed.
        grip: Name of the site on the tool.
        setting: Coupling and rate.
    """

    source: SceneSource
    grip: str
    setting: Setting

    @property
    def spec(self) -> mujoco.MjSpec:
        """MuJoCo's specification, without handle and coupling."""
        return self.source.spec

    def copy(self) -> SceneVariant:
        """Returns a draft with a specification of its own."""
        return SceneVariant(self.with_spec(self.spec.copy()), self.grip, self.setting)

    def with_spec(self, spec: mujoco.MjSpec) -> SceneSource:
        """Returns the source with another specification."""
        return replace(self.source, spec=spec)

    def compiled(self) -> Scene:
        """Returns the scene with handle and coupling.

        Raises:
            SceneError: It does not compile or cannot be coupled to a device.
        """
        return compile_scene(self.source, self.grip, warns=False)

    def samples(self, motion: Motion) -> NDArray[np.void]:
        """Returns the motion sampled at this draft's rate."""
        return samples_of(motion, self.setting.period)

    def rehearsed(self, motion: Motion) -> Playback:
        """Compiles the scene and leads it through a motion.

        Raises:
            SceneError: It does not compile, or a result is not finite.
        """
        return rehearse(self.compiled(), self.samples(motion), self.setting)


def name_everything(spec: mujoco.MjSpec) -> None:
    """Names every unnamed body, joint and geom, so that a later edit finds it.

    Ids change as soon as an earlier element is deleted. The name of a joint or geom starts with its
    body's name.
    """
    for kind, elements in (("body", spec.bodies), ("joint", spec.joints), ("geom", spec.geoms)):
        taken = {element.name for element in elements}
        for number, element in enumerate(elements):
            if not element.name:
                stem = f"{kind}_{number}" if kind == "body" else f"{element.parent.name}_{kind}"
                numbered = (f"{stem}_{k}" for k in itertools.count(2))
                free = (name for name in itertools.chain([stem], numbered) if name not in taken)
                element.name = next(free)
                taken.add(element.name)


def model_of(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a copy of a specification, without checks of its start."""
    return spec.copy().compile()


def census(model: mujoco.MjModel) -> tuple[int, ...]:
    """Counts the elements that MuJoCo drops together with a body, joint or geom they refer to."""
    kinds = (
        "sensor",
        "actuator",
        "eq",
        "tendon",
        "pair",
        "exclude",
        "tuple",
        "skin",
        "flex",
        "site",
        "cam",
        "light",
    )
    return tuple(int(getattr(model, f"n{kind}")) for kind in kinds)
