"""A way to render: how the coupling's wrench reaches the tool."""

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
    """A way to render.

    Attributes:
        name: What ``--method`` and the recording's metadata call it.
        about: What it is, in one sentence.
        hazard: What it may do on a real device, in one sentence; empty where nothing more than the
            device condition is to be said.
        scheme: How the wrench reaches the tool, as the kernel counts (``kernel.scheme.COUPLED`` …).
        integrator: MuJoCo's, by the name that MJCF gives it.
        discretization: How the coupling's damper is discretised, as the bounds call it; ``none``
            where no coupling law gives the wrench.
        compensated: Whether the actuators get the extra K h of damping, h the time step, that makes
            the implicit integration of velocity alone one of position too.
        lag: Share of K h that is taken off the damping asked for, because the integration adds it;
            no unit.
        adds: Share of K h that the integration adds to the damping, whether it is taken off or
            not; None where it adds another amount, or takes some away.
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
        """MuJoCo's part of a substep, through the Python bindings, on model and data.

        ``kernel.step.advance`` is the same by C symbol, to the bit.
        """
        step: Callable[[Any, Any], None] = (
            mujoco.mj_step if self.has_coupling else mujoco.mj_fwdPosition
        )
        return step

    def laws(self, substeps: int) -> int:
        """Returns how often per tick the wrench on the tool is computed."""
        return laws_per_tick(self.scheme, substeps)

    @property
    def has_law(self) -> bool:
        """Whether the coupling law gives the wrench, so that the device condition proves safety."""
        return has_law(self.scheme)

    @property
    def meters_inputs(self) -> bool:
        """Whether the work of applied forces and moved mocap bodies is known."""
        return self.integrator != "RK4" and self.scheme != DIRECT

    @property
    def has_coupling(self) -> bool:
        """Whether anything elastic lies between handle and tool."""
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
        """Returns the coupling whose law and gains make a tool feel like the one asked for.

        B' = max(B − lag K h, 0), and B_r alike: the integration adds lag K h again. The device
        needs b >= K T/2 + B', so what is taken off is also gained in stiffness.

        Args:
            coupling: What should be felt.
            timestep: h in s, MuJoCo's.

        Raises:
            CouplingError: The time step is not finite and > 0.

        References:
            ``passivity.compensation``.
        """
        return self._with_damping(coupling, timestep, law_damping)

    def rendered(self, used: Coupling, timestep: float) -> Coupling:
        """Returns what must be asked for where ``used`` is the law: B = B' + lag K h.

        It is what is felt, but for methods that take nothing off what they add (``adds``).
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
    """Refuses a method that may kick on a device with a motor, unless the user knows.

    Raises:
        DeviceError: Says what the method may do, and how to go on.
    """
    if is_real and method.hazard and not i_know:
        raise DeviceError(
            f"method '{method.name}' on a real device: {method.hazard}; use 'implicit', or say "
            "--i-know (Bridge(i_know=True))"
        )
