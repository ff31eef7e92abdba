"""Run of a scene without device and guard: its coupling, rate and contact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco

from hapticbridge.coupling import Coupling
from hapticbridge.demand.loop_setting import required_damping
from hapticbridge.demand.methods import default_method, unguarded_parameters
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.scene import Scene


@dataclass(frozen=True, slots=True)
class RunPoint:
    """Coupling and rate at which a scene is run.

    Attributes:
        coupling: Requested K and B.
        period: T in s.
        substeps: MuJoCo steps per tick.
        contact: ``rigid``, the default of a run, or ``scene``, MuJoCo's own.
    """

    coupling: Coupling
    period: float = 1e-3
    substeps: int = 1
    contact: Literal["rigid", "scene"] = "rigid"

    @property
    def needed_damping(self) -> float:
        """Device damping in N s/m required by the default method."""
        method = default_method(self.substeps)
        used = method.law_coupling(self.coupling, self.period / self.substeps)
        return required_damping(used, self.period, method.law_evaluations(self.substeps))


def rehearsal_parameters(scene: Scene, setting: RunPoint) -> RunParameters:
    """Resets a scene for the default method, and returns the parameters.

    Raises:
        SceneError: A value is out of range.
    """
    substeps = setting.substeps
    method = default_method(substeps, has_several_hands=scene.has_several_hands)
    method = method.with_contact(setting.contact)
    parameters = unguarded_parameters(scene, setting.coupling, setting.period, substeps, method)
    # an error inside the C function would end the process; the first step in Python raises instead
    mujoco.mj_step(scene.model, scene.data)
    scene.reset()
    return parameters
