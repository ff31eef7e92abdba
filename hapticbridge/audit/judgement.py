"""Verdict on energies, block by block."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.balance import Balance
from hapticbridge.audit.structure import TOLERANCE

_RECORDED = ("kinetic", "potential", "actuator_work", "external_work")


@dataclass(frozen=True, slots=True)
class _Excess:
    """First tick beyond a limit, and the excess in J."""

    tick: int
    joules: float


@dataclass(slots=True)
class Judgement:
    """Verdict collected over the blocks of a recording.

    Attributes:
        is_watched: True if the device port is judged by its energy. A device that meets its
            condition behind a coupling law is proven safe without it.
        energies: Energies after the newest tick, in J.
        slack_share: Largest share of the slack that was used.
        commanded: Energy that commands have added to the coupling, in J.
    """

    is_watched: bool
    energies: dict[str, float] = field(default_factory=dict)
    slack_share: float = 0.0
    commanded: float = 0.0
    _unstrict: _Excess | None = None
    _active: _Excess | None = None
    _kicked: _Excess | None = None

    def add(self, ticks: NDArray[np.void], balance: Balance) -> None:
        """Adds at least one record with its balance."""
        created = balance.environment_energy
        rounding = TOLERANCE * (1 + balance.throughput)
        unstrict = created > rounding
        allowed = balance.slack + rounding
        self.slack_share = max(
            self.slack_share, float(np.max(np.where(unstrict, created / allowed, 0.0)))
        )
        start = int(ticks["tick"][0])
        self._unstrict = self._unstrict or _first(unstrict, created, start)
        self._active = self._active or _first(created > allowed, created - balance.slack, start)
        if self.is_watched:
            kicked = balance.kicked > rounding
            self._kicked = self._kicked or _first(kicked, balance.kicked, start)
        self.commanded = float(balance.commanded[-1])
        last = ticks[-1]
        self.energies = {name: float(last[name]) for name in _RECORDED} | {
            "coupling_work": float(balance.coupling_work[-1]),
            "environment_energy": float(created[-1]),
            "device_energy": float(balance.device_energy[-1]),
            "slack": float(balance.slack[-1]),
        }

    def findings(self, *, strict: bool) -> dict[str, Any]:
        """Returns the fields of ``AuditReport`` that follow from the energies.

        ``strict`` accepts only (14) itself.
        """
        unstrict, active, kicked = self._unstrict, self._active, self._kicked
        if kicked is not None and not (active is not None and active.tick <= kicked.tick):
            return {
                "verdict": "active",
                "environment": "within slack" if unstrict else "strict",
                "reason": f"from tick {kicked.tick} the device is given {kicked.joules:.3g} J more "
                "than its damping burns and scene and coupling give up",
                "tick": kicked.tick,
                "port": "device",
                "joules": kicked.joules,
                "slack_share": self.slack_share,
            }
        if unstrict is None:
            # rounding may leave it above zero; + 0.0 removes the sign of zero
            lost = max(-self.energies["environment_energy"], 0.0) + 0.0
            return {
                "verdict": "passive",
                "environment": "strict",
                "reason": f"the environment never gave out more than it got ({lost:.3g} J "
                "dissipated)",
            }
        if active is None and not strict:
            return {
                "verdict": "passive",
                "environment": "within slack",
                "reason": "energy was created at times, within the slack that the coupling leaves "
                f"({self.slack_share:.0%} of it used)",
                "slack_share": self.slack_share,
            }
        excess = active or unstrict
        limit = "its slack" if active else "(14), asked for strictly"
        return {
            "verdict": "active",
            "environment": "active" if active else "within slack",
            "reason": f"from tick {excess.tick} the environment exceeds {limit} by "
            f"{excess.joules:.3g} J",
            "tick": excess.tick,
            "port": "environment",
            "joules": excess.joules,
            "slack_share": self.slack_share,
        }


def _first(is_beyond: NDArray[np.bool_], joules: NDArray[np.float64], start: int) -> _Excess | None:
    if not is_beyond.any():
        return None
    at = int(np.argmax(is_beyond))
    return _Excess(start + at, float(joules[at]))
