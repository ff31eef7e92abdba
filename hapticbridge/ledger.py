"""Energies metered by the kernel, and the environment's verdict."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Environment = Literal["strict", "within slack", "active"]


@dataclass(frozen=True, slots=True)
class Ledger:
    """Energies of a run in J; all but the storage are cumulative since its start.

    E_k = S_k − S_{k−1} − (works of all ports in tick k). The environment has released no more
    energy than it received while Σ E_k <= 0 (BC97 (14)). The device stays safe while Σ E_k stays
    below the slack, Σ ½‖δx_k‖²_{K+B/T} and its rotational counterpart.

    Attributes:
        kinetic: Present kinetic energy.
        potential: Present potential energy of gravity and springs.
        coupling_work: Work of the coupling on the tool, Σ f_k·δx_k + τ_k·δφ_k.
        actuator_work: Work of the scene's own actuators.
        external_work: Work of applied forces, gravity compensation, moved mocap bodies and resets.
        tuning_work: Work on the coupling's spring by commands that changed it (``kernel.tuning``).
        environment_energy: Σ E_k: energy created (> 0) or dissipated (< 0) by the simulation.
        device_energy: Energy given to the device by the wrenches sent.
        slack: Bound of Σ E_k up to which the guarantee holds.
        slack_share: Largest share of the slack used so far; 0 if always strict.
        first_unstrict: First tick at which (14) did not hold, or None.
        first_active: First tick at which the slack was exceeded, or None.
        first_kick: First tick at which a device without a coupling law had received more than its
            damping dissipates and the scene released, or None.
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
        """Reads the ledger from the kernel's state (``STATE_DTYPE``, one element)."""
        values = {name: float(state[name][0]) for name in _ENERGIES}
        ticks = [int(state[name][0]) for name in _TICKS]
        unstrict, active, kick = (tick if tick >= 0 else None for tick in ticks)
        return cls(**values, first_unstrict=unstrict, first_active=active, first_kick=kick)

    @property
    def environment(self) -> Environment:
        """``strict`` if (14) always held, ``within slack`` or ``active``."""
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
