"""How one point of a chart is simulated: method, time steps, contacts, solver."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.rendering import Method
from hapticbridge.scene import Scene

OWN = "hapticbridge"
"""The bridge itself, in its compiled loop around MuJoCo; other engines carry their own names, and
MuJoCo as any other engine is called ``mujoco``."""

SPRING = "_spring"
"""How the name of an engine ends that solves the coupling as a spring of its own."""

SHIPPED = "as shipped"
"""The contact setting that the scene's file names."""

PYRAMIDAL = "pyramidal cone"
SOFT = "soft"
DIRECT = "direct"

CONTACTS: dict[str, tuple[float, float] | None] = {
    SHIPPED: None,
    "2 steps": (2.0, 1.0),
    "damped": (0.5, 8.0),
    SOFT: None,
    DIRECT: None,
    PYRAMIDAL: None,
}
"""Contact settings by name; a pair is (timeconst in time steps, dampratio). ``2 steps`` is what the
shipped scenes have at 1 kHz, ``damped`` the setting that ``scene.contact_rule`` calls strict."""

SOFT_SOLREF = (0.02, 1.0)
"""MuJoCo's default: timeconst in s and dampratio."""

DIRECT_SOLREF = (-1e6, -2e3)
"""Contact stiffness and damping given directly, in 1/s² and 1/s, as MuJoCo's negative solref: that
of timeconst 1 ms and dampratio 1, four times as stiff as ``2 steps`` at 1 kHz. MuJoCo raises a time
constant below two steps, this it leaves. In one of twenty random hands a peg in its hole then
creates 0.5 mJ, 9 % of the slack, where ``2 steps`` creates nothing."""

SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
"""Impedance of the named settings, that of the shipped scenes and MuJoCo's default."""

_GIVEN = {SOFT: SOFT_SOLREF, DIRECT: DIRECT_SOLREF}


@dataclass(frozen=True, slots=True)
class Setting:
    """Everything that is chosen at a point.

    Attributes:
        method: How the tool is rendered; its integrator is MuJoCo's.
        period: T in s, one tick.
        substeps: MuJoCo steps per tick.
        contact: One of ``CONTACTS``.
        iterations: The most that MuJoCo's solver may take; None as the scene says.
        engine: Who simulates; another than ``OWN`` is set as its documentation advises, and
            holds the coupling's force as method ``explicit`` does, unless its name ends with
            ``SPRING``.
    """

    method: Method
    period: float
    substeps: int = 1
    contact: str = SHIPPED
    iterations: int | None = None
    engine: str = OWN

    @property
    def timestep(self) -> float:
        """MuJoCo's time step h in s."""
        return self.period / self.substeps

    @property
    def label(self) -> str:
        """The setting in words, what is usual left out."""
        law = "own spring" if self.engine.endswith(SPRING) else "held force"
        who = self.method.name if self.engine == OWN else f"{self.engine}, {law}"
        parts = [who, f"{1e3 * self.period:g} ms"]
        if self.substeps > 1:
            parts.append(f"{self.substeps} substeps")
        if self.contact != SHIPPED:
            parts.append(f"contact: {self.contact}")
        if self.iterations is not None:
            plural = "" if self.iterations == 1 else "s"
            parts.append(f"{self.iterations} solver iteration{plural}")
        return ", ".join(parts)


def who(setting: Setting) -> str:
    """Returns the method's name, or the engine's where it is another."""
    return setting.method.name if setting.engine == OWN else setting.engine


@dataclass(frozen=True, slots=True, eq=False)
class ShippedOptions:
    """What of a scene a setting changes, as its file says it."""

    solref: NDArray[np.float64]
    solimp: NDArray[np.float64]
    cone: int
    iterations: int

    @classmethod
    def of(cls, model: mujoco.MjModel) -> ShippedOptions:
        """Keeps what the scene's file says."""
        return cls(
            model.geom_solref.copy(),
            model.geom_solimp.copy(),
            int(model.opt.cone),
            int(model.opt.iterations),
        )

    def chosen(self, setting: Setting) -> dict[str, str | int]:
        """Returns contacts and solver of a point as MuJoCo gets them, for a table."""
        solref, solimp = _different(self.solref), _different(self.solimp)
        in_steps = CONTACTS[setting.contact]
        if in_steps is not None:
            solref = _numbers((in_steps[0] * setting.timestep, in_steps[1]))
        elif setting.contact in _GIVEN:
            solref = _numbers(_GIVEN[setting.contact])
        if setting.contact not in (SHIPPED, PYRAMIDAL):
            solimp = _numbers(SOLIMP)
        is_pyramidal = setting.contact == PYRAMIDAL or self.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
        return {
            "solref": solref,
            "solimp": solimp,
            "cone": "pyramidal" if is_pyramidal else "elliptic",
            "solver_iterations": (
                self.iterations if setting.iterations is None else setting.iterations
            ),
        }

    def apply(self, scene: Scene, setting: Setting) -> None:
        """Gives the scene's model the contacts and the solver that a setting asks for."""
        model = scene.model
        model.geom_solref[:] = self.solref
        model.geom_solimp[:] = self.solimp
        model.opt.cone = (
            mujoco.mjtCone.mjCONE_PYRAMIDAL if setting.contact == PYRAMIDAL else self.cone
        )
        model.opt.iterations = self.iterations if setting.iterations is None else setting.iterations
        in_steps = CONTACTS[setting.contact]
        if in_steps is not None:
            model.geom_solref[:] = (in_steps[0] * setting.timestep, in_steps[1])
            model.geom_solimp[:] = SOLIMP
        elif setting.contact in _GIVEN:
            model.geom_solref[:] = _GIVEN[setting.contact]
            model.geom_solimp[:] = SOLIMP


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


def _different(rows: NDArray[np.float64]) -> str:
    """Returns the rows that differ, in words."""
    return " / ".join(dict.fromkeys(_numbers(row) for row in rows.tolist()))
