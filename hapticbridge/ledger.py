"""What the kernel metered, in words: energy per port, and whether the environment is passive."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Environment = Literal["strict", "within slack", "active"]


@dataclass(frozen=True, slots=True)
class Ledger:
    """Energies of a run so far, all in J and cumulative since its start except the storage.

    E_k = S_k − S_{k−1} − (works of all ports in tick k); the environment gave out no more than it
    got while Σ E_k <= 0 (BC97 (14)), and the device stays safe while Σ E_k stays below the slack,
    Σ ½‖δx_k‖²_{K+B/T} and its rotational counterpart.

    Attributes:
        kinetic: Kinetic energy now.
        potential: Potential energy now: gravity and springs.
        coupling_work: Work of the coupling on the tool, Σ f_k·δx_k + τ_k·δφ_k.
        actuator_work: Work of the scene's own actuators.
        external_work: Work of applied forces, gravity compensation, moved mocap bodies and resets.
        tuning_work: Work of commands that changed the coupling, on its spring (``kernel.tuning``).
        environment_energy: Σ E_k: what the simulation created (> 0) or dissipated (< 0).
        device_energy: Energy given to the device by the wrenches that were sent.
        slack: What Σ E_k may reach before the guarantee is lost.
        slack_share: Largest share of the slack that was ever used, 0 if always strict.
        first_unstrict: First tick at which (14) did not hold, or None.
        first_active: First tick at which the slack was exceeded, or None.
        first_kick: First tick at which a device whose wrench comes from no coupling law had been
            given more than its damping burns and the scene gave up, or None.
    """

    kinetic: float
    potential: float
    coupling_work: float
    actuator_work: float
    external_work: float
    tuning_work: float
    environment_energy: float
    device_energy: float
    slack: float
    slack_share: float
    first_unstrict: int | None
    first_active: int | None
    first_kick: int | None

    @classmethod
    def of(cls, state: NDArray[np.void]) -> Ledger:
        """Reads the ledger out of the kernel's state (``STATE_DTYPE``, one element)."""
        values = {name: float(state[name][0]) for name in _ENERGIES}
        ticks = [int(state[name][0]) for name in _TICKS]
        unstrict, active, kick = (tick if tick >= 0 else None for tick in ticks)
        return cls(**values, first_unstrict=unstrict, first_active=active, first_kick=kick)

    @property
    def environment(self) -> Environment:
        """``strict`` if (14) held throughout, ``within slack`` or ``active``."""
        if self.first_active is not None:
            return "active"
        return "strict" if self.first_unstrict is None else "within slack"

    @property
    def fault(self) -> tuple[int, str] | None:
        """Tick and port of the first fault, ``environment`` or ``device``; None if passive."""
        faults = ((self.first_active, "environment"), (self.first_kick, "device"))
        found = [(tick, port) for tick, port in faults if tick is not None]
        return min(found) if found else None

    def energies(self) -> dict[str, float]:
        """Returns the energies by name, in J."""
        return {name: value for name, value in asdict(self).items() if name in _ENERGIES[:-1]}


_ENERGIES = (
    "kinetic",
    "potential",
    "coupling_work",
    "actuator_work",
    "external_work",
    "tuning_work",
    "environment_energy",
    "device_energy",
    "slack",
    "slack_share",
)

_TICKS = ("first_unstrict", "first_active", "first_kick")
