"""Description of a rendering method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import mujoco

from hapticbridge.coupling import Coupling
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.scheme import COUPLED, DIRECT, HELD, LOSSLESS, has_law, laws_per_tick
from hapticbridge.kernel.tuning import Gains
from hapticbridge.passivity.compensation import felt_damping, law_damping


@dataclass(frozen=True, slots=True)
class Method:
    """A rendering method.

    Attributes:
        name: Name for ``--method`` and the recording's metadata.
        about: Description in one sentence.
        hazard: Hazard on a real device beyond the device condition, in one sentence; empty without
            one.
        scheme: Code of the kernel's scheme (``kernel.scheme.COUPLED`` …).
        integrator: MuJoCo's integrator by its MJCF name.
        discretization: Discretisation of the coupling's damper in the bounds; ``none`` without a
            law.
        compensated: True if the actuators get K h of extra damping, h the time step. It turns the
            implicit integration of velocity into one of position too.
        lag: Share of K h that is subtracted from the requested damping because the integration adds
            it; no unit.
        adds: Share of K h that the integration adds to the damping, subtracted or not; None if it
            adds another amount or removes some.
    """

    name: str
    about: str
    hazard: str
    scheme: int
    integrator: str
    discretization: str = "backward"
    compensated: bool = False
    lag: float = 0.0
    adds: float | None = None

    @property
    def step(self) -> Callable[[Any, Any], None]:
        """MuJoCo's part of a substep through the Python bindings.

        ``kernel.step.advance`` calls the C function with equal results to the bit.
        """
        step: Callable[[Any, Any], None] = (
            mujoco.mj_step if self.has_coupling else mujoco.mj_fwdPosition
        )
        return step

    def laws(self, substeps: int) -> int:
        """Returns the evaluations of the tool's wrench per tick."""
        return laws_per_tick(self.scheme, substeps)

    @property
    def has_law(self) -> bool:
        """True if the coupling law gives the wrench, so that the device condition proves safety."""
        return has_law(self.scheme)

    @property
    def meters_inputs(self) -> bool:
        """True if the work of applied forces and moved mocap bodies is metered."""
        return self.integrator != "RK4" and self.scheme != DIRECT

    @property
    def has_coupling(self) -> bool:
        """True if an elastic coupling lies between handle and tool."""
        return self.scheme != DIRECT

    def gains(self, coupling: Coupling, timestep: float) -> tuple[Gains, Gains]:
        """Returns the gains of the coupling's actuators, for forces and for torques."""
        if self.scheme == HELD:
            return (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
        if self.scheme not in (COUPLED, LOSSLESS):
            return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        more = timestep if self.compensated else 0.0
        k, b = coupling.stiffness, coupling.damping
        kr, br = coupling.rotational_stiffness, coupling.rotational_damping
        return (b, k, b + k * more), (br, kr, br + kr * more)

    def used(self, coupling: Coupling, timestep: float) -> Coupling:
        """Returns the law's coupling for a requested one: B' = max(B − lag K h, 0).

        The integration adds lag K h again; rotation follows the same rule. The device needs b >= K
        T/2 + B', so the subtracted damping allows more stiffness. ``timestep`` is MuJoCo's h in s.

        Raises:
            CouplingError: The time step is not finite and > 0.

        References:
            ``passivity.compensation``.
        """
        return self._with_damping(coupling, timestep, law_damping)

    def rendered(self, used: Coupling, timestep: float) -> Coupling:
        """Returns the requested coupling for the law's one: B = B' + lag K h.

        It is also the effective coupling, except for methods that do not subtract their own damping
        (``adds``).
        """
        return self._with_damping(used, timestep, felt_damping)

    def _with_damping(
        self, coupling: Coupling, timestep: float, damping: Callable[..., float]
    ) -> Coupling:
        if self.lag == 0.0:
            return coupling
        k, b = coupling.stiffness, coupling.damping
        kr, br = coupling.rotational_stiffness, coupling.rotational_damping
        return replace(
            coupling,
            damping=damping(k, b, timestep, self.lag),
            rotational_damping=damping(kr, br, timestep, self.lag),
        )


def refuse_unknowing(method: Method, *, is_real: bool, i_know: bool) -> None:
    """Refuses a hazardous method on a device with motors without the user's consent.

    Raises:
        DeviceError: The message names the hazard and the way to consent.
    """
    if is_real and method.hazard and not i_know:
        raise DeviceError(
            f"method '{method.name}' on a real device: {method.hazard}; use 'implicit', or consent "
            "with --i-know (Bridge(i_know=True))"
        )
