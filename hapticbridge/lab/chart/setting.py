"""Setting of one point of a chart: method, time steps, contacts, solver."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.demand.methods import Method, method_named
from hapticbridge.errors import StudyError
from hapticbridge.kernel.parameters import StepTimes
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import Scene
from hapticbridge.units import format_count

OWN = "hapticbridge"
"""Name of the bridge itself, in its compiled loop around MuJoCo. Other engines have their own
names; MuJoCo as a peer engine is called ``mujoco``."""

SPRING = "_spring"
"""Ending of the name of an engine that solves the coupling as its own spring."""

SHIPPED = "as shipped"
"""Name of the contact setting in the scene's file."""

PYRAMIDAL = "pyramidal cone"
SOFT = "soft"

CONTACTS: dict[str, tuple[float, float] | None] = {
    SHIPPED: None,
    "2 steps": (2.0, 1.0),
    "damped": (0.5, 8.0),
    SOFT: None,
    PYRAMIDAL: None,
}
"""Contact settings by name; a pair is (timeconst in time steps, dampratio). ``2 steps`` is what the
shipped scenes have at 1 kHz, ``damped`` the setting that ``scene.contacts`` calls strict."""

SOFT_SOLREF = (0.02, 1.0)
"""MuJoCo's default: timeconst in s and dampratio."""

SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
"""Impedance of the named settings, that of the shipped scenes and MuJoCo's default."""


@dataclass(frozen=True, slots=True)
class Setting(StepTimes):
    """All choices at a point.

    Attributes:
        method: Rendering method; its integrator is MuJoCo's.
        period: T in s, one tick.
        substeps: MuJoCo steps per tick.
        contact: One of ``CONTACTS``; a method with rigid contacts leaves it unused.
        iterations: Limit of MuJoCo's solver; None for that of the scene.
        engine: Engine. Any other than ``OWN`` is set as its documentation advises. It holds the
            coupling's force as method ``explicit`` does, unless its name ends with ``SPRING``.
        scene_ticks: Ticks between two results of a slower scene; 0 steps it in every tick.
    """

    method: Method
    period: float
    substeps: int = 1
    contact: str = SHIPPED
    iterations: int | None = None
    engine: str = OWN
    scene_ticks: int = 0

    @property
    def contact_name(self) -> str:
        """Contact by its name: ``rigid``, or one of ``CONTACTS``."""
        return self.method.contact if self.method.is_rigid else self.contact

    @property
    def has_usual_contact(self) -> bool:
        """True if contacts are rigid where the method can, otherwise as in the scene's file."""
        return self.method.is_rigid == self.method.can_be_rigid and self.contact == SHIPPED

    @property
    def label(self) -> str:
        """Setting in words, without the usual values."""
        law = "own spring" if self.engine.endswith(SPRING) else "held force"
        name = self.method.name if self.engine == OWN else f"{self.engine}, {law}"
        parts = [name, f"{1e3 * self.period:g} ms"]
        if self.substeps > 1:
            parts.append(f"{self.substeps} substeps")
        if self.scene_ticks:
            parts.append(f"scene at {1 / self.scene_period:g} Hz")
        if not self.has_usual_contact:
            parts.append(f"contact: {self.contact}")
        if self.iterations is not None:
            parts.append(format_count(self.iterations, "solver iteration"))
        return ", ".join(parts)


def simulator_name(setting: Setting) -> str:
    """Returns the method's name, or the engine's if it is another."""
    return setting.method.name if setting.engine == OWN else setting.engine


@dataclass(frozen=True, slots=True, eq=False)
class ShippedOptions:
    """Properties of a scene that a setting changes, as in its file."""

    solref: NDArray[np.float64]
    solimp: NDArray[np.float64]
    cone: int
    iterations: int

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> ShippedOptions:
        """Keeps the values of the scene's file."""
        return cls(
            model.geom_solref.copy(),
            model.geom_solimp.copy(),
            int(model.opt.cone),
            int(model.opt.iterations),
        )

    def chosen(self, setting: Setting) -> dict[str, str | int]:
        """Returns contacts and solver of a point as MuJoCo receives them, for a table."""
        solref, solimp = _different(self.solref), _different(self.solimp)
        in_steps = CONTACTS[setting.contact]
        if in_steps is not None:
            solref = _numbers((in_steps[0] * setting.timestep, in_steps[1]))
        elif setting.contact == SOFT:
            solref = _numbers(SOFT_SOLREF)
        if setting.contact not in (SHIPPED, PYRAMIDAL):
            solimp = _numbers(SOLIMP)
        is_pyramidal = setting.contact == PYRAMIDAL or self.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
        if setting.method.is_rigid:
            solref, solimp, is_pyramidal = setting.contact_name, setting.contact_name, False
        return {
            "solref": solref,
            "solimp": solimp,
            "cone": "pyramidal" if is_pyramidal else "elliptic",
            "solver_iterations": (
                self.iterations if setting.iterations is None else setting.iterations
            ),
        }

    def apply(self, scene: Scene, setting: Setting) -> None:
        """Sets contacts and solver of the scene's model to those of a setting."""
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
        elif setting.contact == SOFT:
            model.geom_solref[:] = SOFT_SOLREF
            model.geom_solimp[:] = SOLIMP


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


def _different(rows: NDArray[np.float64]) -> str:
    """Returns the rows that differ, in words."""
    return " / ".join(dict.fromkeys(_numbers(row) for row in rows.tolist()))


PERIODS_MS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
"""Periods T in ms by default: 250 Hz to 8 kHz."""

QUICK_PERIODS_MS = (4.0, 1.0, 0.25)
"""Periods T in ms of a quick chart."""

USUAL_MS = 1.0
"""Period T in ms at which everything but the time step is varied."""

SUBSTEPS = (2, 4, 8)
ITERATIONS = (1, 2, 5, 20)
"""Limits of solver iterations. MuJoCo's own limit is 100, and it rarely needs more than ten."""

VARIED = ("implicit", "lossless")
"""Methods whose contacts and solver are varied: the two that are meant for a device. The others
respond to a contact as 'implicit' does, with an equal solver."""

MIN_MS, MAX_MS = 0.02, 20.0
"""Range of T in ms: 50 kHz to 50 Hz. No haptic loop runs beyond it."""


def chosen_methods(names: Sequence[str] | None) -> list[Method]:
    """Returns methods by name, all of them for None.

    Raises:
        StudyError: No name is given.
        SceneError: A name is not that of a method.
    """
    if names is None:
        return list(METHODS.values())
    if not names:
        raise StudyError("methods is empty; name one or more")
    return [method_named(name) for name in dict.fromkeys(names)]


def chosen_periods(steps_ms: Sequence[float] | None, *, is_quick: bool = False) -> list[float]:
    """Returns the periods T in s, longest first.

    Args:
        steps_ms: Periods in ms; None for ``PERIODS_MS``.
        is_quick: True selects ``QUICK_PERIODS_MS`` for None.

    Raises:
        StudyError: A period is out of range or does not divide the longest. Runs could then not be
            compared at common instants.
    """
    if steps_ms is None:
        steps_ms = QUICK_PERIODS_MS if is_quick else PERIODS_MS
    steps = sorted({float(step) for step in steps_ms}, reverse=True)
    if not steps:
        raise StudyError("steps is empty; name one or more time steps in ms")
    for step in steps:
        if not MIN_MS <= step <= MAX_MS:
            raise StudyError(f"a step is {step!r} ms; it must be between {MIN_MS:g} and {MAX_MS:g}")
        if abs(steps[0] / step - round(steps[0] / step)) > 1e-9:
            raise StudyError(
                f"step {step:g} ms does not divide {steps[0]:g} ms; all steps must divide the "
                "longest, or there are no common instants to compare at"
            )
    return [1e-3 * step for step in steps]


def settings_for(
    methods: Sequence[Method], periods: Sequence[float], *, has_contact: bool
) -> list[Setting]:
    """Returns the points of a chart.

    Every method runs at every period. At 1 ms, or the period nearest to it, every method also runs
    with 2, 4 and 8 substeps, unless it cannot divide a tick. If bodies can touch, the methods of
    ``VARIED`` run with every contact setting of MuJoCo in place of rigid contacts, and with few
    solver iterations. The contact settings are tried at the next smaller period too, because a
    setting may be right at one step by luck.

    Args:
        methods: Names of the methods.
        periods: T in s.
        has_contact: True if bodies in the scene can touch.
    """
    points = [Setting(method, period) for method in methods for period in periods]
    usual = min(periods, key=lambda period: abs(period - 1e-3 * USUAL_MS))
    points += [
        Setting(method, usual, substeps=count)
        for method in methods
        if not method.scheme.properties.one_substep
        for count in SUBSTEPS
    ]
    if has_contact:
        varied = [method for method in methods if method.name in VARIED]
        points += [
            Setting(method.with_contact("scene"), period, contact=contact)
            for method in varied
            for contact in CONTACTS
            for period in _with_neighbour(usual, periods)
        ]
        points += [
            Setting(method, usual, iterations=count) for method in varied for count in ITERATIONS
        ]
    return points


SCENE_TICKS = (2, 5, 10, 20)
"""Ticks of a loop at 1 kHz between two results of a slower scene: 500 to 50 Hz."""


def rate_settings() -> list[Setting]:
    """Returns the points of a chart of a slower scene.

    The methods of ``VARIED`` run with the scene beside a loop of 1 kHz at each of ``SCENE_TICKS``,
    and with a loop that is as slow as the scene.
    """
    methods, period = [METHODS[name] for name in VARIED], 1e-3 * USUAL_MS
    beside = [Setting(m, period, scene_ticks=n) for m in methods for n in SCENE_TICKS]
    return beside + [Setting(m, n * period) for m in methods for n in (1, *SCENE_TICKS)]


def _with_neighbour(usual: float, periods: Sequence[float]) -> list[float]:
    """Returns a period and the next smaller one; without one, the next larger one."""
    others = [period for period in periods if period != usual]
    smaller = [period for period in others if period < usual]
    return [usual, *([max(smaller)] if smaller else [min(others)] if others else [])]
