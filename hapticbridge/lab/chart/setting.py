"""How one point of a chart is simulated: method, time steps, contacts, solver."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import StudyError
from hapticbridge.kernel.codes import Scheme
from hapticbridge.lab.methods import METHODS
from hapticbridge.rendering import (
    Method,
    method_named,
)
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
DIRECT_CONTACT = "direct"

CONTACTS: dict[str, tuple[float, float] | None] = {
    SHIPPED: None,
    "2 steps": (2.0, 1.0),
    "damped": (0.5, 8.0),
    SOFT: None,
    DIRECT_CONTACT: None,
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

_GIVEN = {SOFT: SOFT_SOLREF, DIRECT_CONTACT: DIRECT_SOLREF}


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


PERIODS_MS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
"""T in ms where nobody chooses: 250 Hz to 8 kHz."""

QUICK_PERIODS_MS = (4.0, 1.0, 0.25)
"""Likewise, of a quick chart."""

USUAL_MS = 1.0
"""T in ms at which everything but the time step is varied."""

SUBSTEPS = (2, 4, 8)
ITERATIONS = (1, 2, 5, 20)
"""The most solver iterations; MuJoCo's own limit is 100 and it rarely needs more than ten."""

VARIED = ("implicit", "lossless")
"""Methods whose contacts and solver are varied: the two that are meant for a device. The others
answer to a contact as 'implicit' does, by the same solver."""

LEAST_MS, MOST_MS = 0.02, 20.0
"""Range of T in ms: 50 kHz to 50 Hz. Beyond, nothing haptic runs."""


def chosen_methods(names: Sequence[str] | None) -> list[Method]:
    """Returns methods by name, all of them for None.

    Raises:
        StudyError: No name is given.
        SceneError: A name is none of a method's.
    """
    if names is None:
        return list(METHODS.values())
    if not names:
        raise StudyError("methods is empty; name one or more")
    return [method_named(name) for name in dict.fromkeys(names)]


def chosen_periods(steps_ms: Sequence[float] | None, *, is_quick: bool = False) -> list[float]:
    """Returns the periods T in s, longest first.

    Args:
        steps_ms: In ms; None for ``PERIODS_MS``.
        is_quick: Whether None means ``QUICK_PERIODS_MS``.

    Raises:
        StudyError: One is out of range or does not divide the longest, so that there would be no
            common instants to compare at.
    """
    if steps_ms is None:
        steps_ms = QUICK_PERIODS_MS if is_quick else PERIODS_MS
    steps = sorted({float(step) for step in steps_ms}, reverse=True)
    if not steps:
        raise StudyError("steps is empty; name one or more time steps in ms")
    for step in steps:
        if not LEAST_MS <= step <= MOST_MS:
            raise StudyError(
                f"a step is {step!r} ms; it must be between {LEAST_MS:g} and {MOST_MS:g}"
            )
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

    Every method at every period. At 1 ms, or the period nearest to it, also: every method with 2, 4
    and 8 substeps, unless it cannot divide a tick; and where something can touch, the methods of
    ``VARIED`` with every contact setting, and with few solver iterations. The contact settings are
    tried at the next smaller period too: what is right at one step alone is right by luck.

    Args:
        methods: Which.
        periods: T in s.
        has_contact: Whether anything in the scene can touch.
    """
    points = [Setting(method, period) for method in methods for period in periods]
    usual = min(periods, key=lambda period: abs(period - 1e-3 * USUAL_MS))
    points += [
        Setting(method, usual, substeps=count)
        for method in methods
        if method.scheme not in (Scheme.MIDPOINT, Scheme.MASSLESS)
        for count in SUBSTEPS
    ]
    if has_contact:
        varied = [method for method in methods if method.name in VARIED]
        points += [
            Setting(method, period, contact=contact)
            for method in varied
            for contact in CONTACTS
            if contact != SHIPPED
            for period in _with_neighbour(usual, periods)
        ]
        points += [
            Setting(method, usual, iterations=count) for method in varied for count in ITERATIONS
        ]
    return points


def _with_neighbour(usual: float, periods: Sequence[float]) -> list[float]:
    """Returns a period and the next smaller one; where there is none, the next larger one."""
    others = [period for period in periods if period != usual]
    smaller = [period for period in others if period < usual]
    return [usual, *([max(smaller)] if smaller else [min(others)] if others else [])]
