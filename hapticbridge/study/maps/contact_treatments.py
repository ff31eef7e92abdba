"""The ways in which the map ``contact`` has MuJoCo treat a contact, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco

from hapticbridge.scene.contacts import ContactNumbers, contact_numbers

PERIOD = 1e-3
"""T in s, of every run of the map."""

SHIPPED_SOLIMP = (0.9, 0.95, 0.001)
"""d₀, d_w and width in m of the shipped scenes."""


@dataclass(frozen=True, slots=True)
class Treatment:
    """A way to have MuJoCo treat a contact.

    Attributes:
        solref: (timeconst in s, dampratio) or (−k in 1/s², −b in 1/s).
        solimp: d₀, d_w and width in m.
        cone: ``elliptic`` or ``pyramidal``.
        diagexact: Whether the diagonal of the constraint inertia is exact.
        refsafe: Whether MuJoCo may replace rows that the step cannot resolve.
        speculative: Whether contacts are added before impact.
        condim: 1 takes friction out; else 3.
        impratio: Of friction to normal impedance.
        margin: At which contacts begin, in m.
        substeps: MuJoCo steps a tick.
        method: How the tool is rendered.
    """

    solref: tuple[float, float] = (0.002, 1.0)
    solimp: tuple[float, float, float] = SHIPPED_SOLIMP
    cone: str = "elliptic"
    diagexact: bool = True
    refsafe: bool = True
    speculative: bool = False
    condim: int = 3
    impratio: float = 1.0
    margin: float = 0.0
    substeps: int = 1
    method: str = "implicit"

    @property
    def relaxation(self) -> float:
        """τ in s: how long the contact takes to come back after a push, as b/k."""
        return self.numbers.relaxation * self._step

    @property
    def static_depth(self) -> float:
        """How deep a steady force sinks in, over what it does as shipped: (1 − d) d_w²/(d² k)."""
        depth = self._depth(self.numbers, self.solimp[1], self._step)
        shipped = contact_numbers((0.002, 1.0), SHIPPED_SOLIMP, PERIOD)
        return depth / self._depth(shipped, SHIPPED_SOLIMP[1], PERIOD)

    @staticmethod
    def _depth(numbers: ContactNumbers, last: float, step: float) -> float:
        impedance = numbers.impedance
        return (1 - impedance) * (last * numbers.resolved * step / impedance) ** 2

    @property
    def numbers(self) -> ContactNumbers:
        """What the rule sees of it."""
        return contact_numbers(self.solref, self.solimp, self._step, refsafe=self.refsafe)

    @property
    def is_ruled(self) -> bool:
        """Whether the rule is about it: implicit, elliptic, with the exact diagonal."""
        return self.method == "implicit" and self.cone == "elliptic" and self.diagexact

    @property
    def _step(self) -> float:
        return PERIOD / self.substeps

    def apply(self, model: mujoco.MjModel, friction: float) -> None:
        """Sets a model's contacts through MuJoCo's global override; needs no compilation."""
        option = model.opt
        option.o_solref[:] = self.solref
        option.o_solimp[:3] = self.solimp
        option.o_friction[:2] = friction
        option.o_margin = self.margin
        option.impratio = self.impratio
        model.geom_condim[:] = self.condim
        elliptic, pyramidal = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtCone.mjCONE_PYRAMIDAL
        option.cone = int(elliptic if self.cone == "elliptic" else pyramidal)
        enable, disable = mujoco.mjtEnableBit, mujoco.mjtDisableBit
        option.enableflags = _with_bits(
            option.enableflags,
            {
                enable.mjENBL_OVERRIDE: True,
                enable.mjENBL_DIAGEXACT: self.diagexact,
                enable.mjENBL_SPECULATIVE: self.speculative,
            },
        )
        option.disableflags = _with_bits(
            option.disableflags, {disable.mjDSBL_REFSAFE: not self.refsafe}
        )


def _with_bits(flags: int, bits: Mapping[object, bool]) -> int:
    for bit, is_set in bits.items():
        number = int(bit)  # type: ignore[call-overload]
        flags = flags | number if is_set else flags & ~number
    return flags


SHIPPED = "as shipped: 0.002 1"

TREATMENTS: Mapping[str, Treatment] = {
    SHIPPED: Treatment(),
    "pyramidal cone": Treatment(cone="pyramidal"),
    "diagexact off": Treatment(diagexact=False),
    "refsafe off, 0.0002 1": Treatment((0.0002, 1.0), refsafe=False),
    "speculative contacts": Treatment(speculative=True),
    "impratio 10": Treatment(impratio=10.0),
    "margin 0.1 mm": Treatment(margin=1e-4),
    "no friction (condim 1)": Treatment(condim=1),
    "impedance 0.5 throughout": Treatment(solimp=(0.5, 0.5, 0.001)),
    "impedance 0.99 throughout": Treatment(solimp=(0.99, 0.99, 0.001)),
    "impedance 0.999 throughout": Treatment(solimp=(0.999, 0.999, 0.001)),
    "0.002 2, impedance 0.95": Treatment((0.002, 2.0), (0.95, 0.95, 0.001)),
    "0.002 2, impedance 0.99": Treatment((0.002, 2.0), (0.99, 0.99, 0.001)),
    "0.004 2, impedance 0.99": Treatment((0.004, 2.0), (0.99, 0.99, 0.001)),
    "0.004 8, impedance 0.99": Treatment((0.004, 8.0), (0.99, 0.99, 0.001)),
    "0.000125 8, imp. 0.999": Treatment((0.000125, 8.0), (0.999, 0.999, 0.001)),
    "0.002 1, imp. 0.9 to 0.99": Treatment(solimp=(0.9, 0.99, 0.001)),
    "damped, imp. 0 to 0.99 at once": Treatment((0.0005, 8.0), (0.0001, 0.99, 0.00001)),
    "0.0005 4": Treatment((0.0005, 4.0)),
    "0.00025 8": Treatment((0.00025, 8.0)),
    "timeconst T: 0.001 1": Treatment((0.001, 1.0)),
    "0.003 1": Treatment((0.003, 1.0)),
    "0.002 1.5": Treatment((0.002, 1.5)),
    "MuJoCo's default 0.02 1": Treatment((0.02, 1.0)),
    "direct -20000 -50": Treatment((-20_000.0, -50.0)),
    "direct -1000000 -500": Treatment((-1e6, -500.0)),
    "4 substeps, 0.002 1": Treatment(substeps=4),
    "4 substeps, 0.0005 4": Treatment((0.0005, 4.0), substeps=4),
    "implicitfast": Treatment(method="implicitfast"),
    "damped: 0.0005 8": Treatment((0.0005, 8.0)),
    "default 0.02 1, pyramidal": Treatment((0.02, 1.0), cone="pyramidal"),
    "damped, pyramidal cone": Treatment((0.0005, 8.0), cone="pyramidal"),
    "damped hard: 0.00002 100": Treatment((0.00002, 100.0)),
}
"""The search: what the peg's contact is treated with at 1 kHz, all under ``implicit`` but one."""
