"""Summary of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import condition_sentences, is_run_certified, run_conditions
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.felt import coupling_sentences
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.ledger import Ledger
from hapticbridge.rendering import Method


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a run.

    Attributes:
        ticks: Ticks since the bridge was opened.
        duration: Time of the run's clock in s: a period for each tick and each skipped deadline.
        overruns: Ticks that started a period or more after their deadline.
        skipped: Skipped deadlines.
        dropped: Records lost because the recorder was too far behind.
        peak_force: Largest norm of the force on the tool in N.
        peak_torque: Largest norm of the torque on the tool in N m.
        energies: Energies by name in J.
        environment: ``strict``, ``within slack`` or ``active``.
        slack_share: Largest share of the slack that was used.
        method: Name of the rendering method.
        about: Description of the method in a sentence.
        hazard: Hazard on a real device beyond the device condition, in a sentence; empty without
            one.
        coupling: Requested coupling: K and B to be felt.
        used: Coupling of the law, with the damping B' of the device condition.
        rendered: Sentences on effective and law coupling. They hold away from contact, or
            everywhere if the tool was never released.
        felt: Effective coupling of a weld (its stiffest axis, measured at the start); None with a
            coupling law.
        fault: Tick and port (``environment`` or ``device``) of the first fault, or None. With a
            coupling law the device port is not metered during the run. A certified device needs no
            metering; for any other the audit of the recording decides.
        conditions: Device conditions, as sentences.
        is_certified: True if b >= scale · force_scale · (KT/2 + B') holds for the device in
            translation and rotation. None if its damping is unknown, or if no coupling law makes
            the condition sufficient.
        stopped_by: ``duration``, ``signal``, ``caller``, or another caller of ``Bridge.stop``.
        recording: The recording, or None.
        reach: Distance in m of the device from the origin of its frame beyond which it moved
            without handle and force; None without such a limit.
    """

    ticks: int
    duration: float
    overruns: int
    skipped: int
    dropped: int
    peak_force: float
    peak_torque: float
    energies: dict[str, float]
    environment: str
    slack_share: float
    method: str
    about: str
    hazard: str
    coupling: Coupling
    used: Coupling
    rendered: tuple[str, ...]
    felt: Coupling | None
    fault: tuple[int, str] | None
    conditions: tuple[str, ...]
    is_certified: bool | None
    stopped_by: str
    recording: Path | None
    reach: float | None

    @property
    def verdict(self) -> str:
        """``passive`` (strict or within slack, without a metered kick) or ``active``."""
        return "active" if self.fault is not None else "passive"

    @classmethod
    def of(
        cls,
        state: NDArray[np.void],
        parameters: RunParameters,
        info: DeviceInfo,
        method: Method,
        asked: Coupling,
        *,
        ticks: int,
        overruns: int,
        skipped: int,
        dropped: int,
        stopped_by: str,
        recording: Path | None,
    ) -> Summary:
        """Builds the summary of a run from the kernel's state and the loop's counters."""
        ledger = Ledger.of(state)
        conditions = run_conditions(info, parameters, method)
        return cls(
            ticks=ticks,
            duration=(ticks + skipped) * parameters.period,
            overruns=overruns,
            skipped=skipped,
            dropped=dropped,
            peak_force=float(state["peak_force"][0]),
            peak_torque=float(state["peak_torque"][0]),
            energies=ledger.energies(),
            environment=ledger.environment,
            slack_share=ledger.slack_share,
            method=method.name,
            about=method.about,
            hazard=method.hazard,
            coupling=asked,
            used=parameters.coupling,
            rendered=coupling_sentences(
                parameters.coupling,
                method,
                parameters.period,
                parameters.substeps,
                is_always_held=ticks > 0 and not state["lossless_ticks"][0],
            ),
            felt=parameters.felt,
            fault=ledger.fault,
            conditions=condition_sentences(info, parameters, method),
            is_certified=is_run_certified(conditions, method),
            stopped_by=stopped_by,
            recording=recording,
            reach=parameters.guarding.reach if parameters.guarding.reach < math.inf else None,
        )
