"""A version of a scene under way: its specification, and how it is run."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import needed_damping
from hapticbridge.check.motion import samples_of
from hapticbridge.check.rehearsal import Rehearsal, rehearse
from hapticbridge.coupling import Coupling
from hapticbridge.device import Motion
from hapticbridge.rendering import default_method
from hapticbridge.scene import Scene, SceneSource, compile_scene


@dataclass(frozen=True, slots=True)
class Setting:
    """How a scene is run.

    Attributes:
        coupling: K and B that should be felt.
        period: T in s.
        substeps: MuJoCo steps per tick.
    """

    coupling: Coupling
    period: float = 1e-3
    substeps: int = 1

    @property
    def needed_damping(self) -> float:
        """Damping in N s/m that a device needs behind the method that a bridge would take."""
        method = default_method(self.substeps)
        used = method.used(self.coupling, self.period / self.substeps)
        return needed_damping(used, self.period, method.laws(self.substeps))


@dataclass(slots=True)
class Draft:
    """A version of a scene.

    Attributes:
        source: What was read; its specification may be changed, it belongs to the draft alone.
        grip: Name of the site on the tool.
        setting: How it is run.
    """

    source: SceneSource
    grip: str
    setting: Setting

    @property
    def spec(self) -> mujoco.MjSpec:
        """MuJoCo's specification, without handle and coupling."""
        return self.source.spec

    def copy(self) -> Draft:
        """Returns a draft whose specification can be changed by itself."""
        return Draft(self.with_spec(self.spec.copy()), self.grip, self.setting)

    def with_spec(self, spec: mujoco.MjSpec) -> SceneSource:
        """Returns the source with another specification."""
        return replace(self.source, spec=spec)

    def compiled(self) -> Scene:
        """Returns the scene with handle and coupling.

        Raises:
            SceneError: It does not compile, or cannot be put behind a device.
        """
        return compile_scene(self.source, self.grip, warns=False)

    def samples(self, motion: Motion) -> NDArray[np.void]:
        """Returns the motion at this draft's rate."""
        return samples_of(motion, self.setting.period)

    def rehearsed(self, motion: Motion) -> Rehearsal:
        """Compiles and leads the scene through a motion.

        Raises:
            SceneError: It does not compile, or a result is not finite.
        """
        setting = self.setting
        return rehearse(
            self.compiled(),
            self.samples(motion),
            setting.coupling,
            setting.period,
            setting.substeps,
        )


def name_everything(spec: mujoco.MjSpec) -> None:
    """Names bodies, joints and geoms that have no name, so that an edit can find them again.

    An id would not do: it changes as soon as something before it is deleted. A joint or geom is
    called after its body, so that a reader of its name knows which one it is.
    """
    for kind, elements in (("body", spec.bodies), ("joint", spec.joints), ("geom", spec.geoms)):
        taken = {element.name for element in elements}
        for number, element in enumerate(elements):
            if not element.name:
                stem = f"{kind}_{number}" if kind == "body" else f"{element.parent.name}_{kind}"
                name = (
                    stem
                    if stem not in taken
                    else next(
                        f"{stem}_{k}" for k in itertools.count(2) if f"{stem}_{k}" not in taken
                    )
                )
                element.name = name
                taken.add(name)


def model_of(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a specification on its way: it stays as it is, and its start is not judged."""
    return spec.copy().compile()


def census(model: mujoco.MjModel) -> tuple[int, ...]:
    """Counts what refers to bodies, joints and geoms: MuJoCo leaves it out along with them."""
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
