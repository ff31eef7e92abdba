"""What a run was, in one object."""

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
    """What a run was.

    Attributes:
        ticks: Ticks since the bridge was opened.
        duration: Time of the run's clock in s: a period for each tick and each skipped deadline.
        overruns: Ticks that started a period or more after their deadline.
        skipped: Deadlines that were skipped for it.
        dropped: Records that the recorder did not get because it was too far behind.
        peak_force: Largest norm of the force on the tool in N.
        peak_torque: Largest norm of the torque on the tool in N m.
        energies: Energies by name in J.
        environment: ``strict``, ``within slack`` or ``active``.
        slack_share: Largest share of the slack that was used.
        method: How the tool was rendered.
        about: What that means, in a sentence.
        hazard: What it may do on a real device, in a sentence; empty where the device condition is
            all that is to be said.
        coupling: The coupling asked for: what should be felt.
        used: That of the law, whose damping B' the device condition counts.
        rendered: What is felt away from contact, or everywhere if the tool was never let go, and
            what is used, in sentences.
        felt: The coupling that the tool was truly held by, where no law says it (a weld: the
            stiffest axis, as measured at the start).
        fault: Tick and port (``environment`` or ``device``) of the first fault, or None. Behind a
            coupling law the device's port is not metered while it runs: a certified device needs
            no watch, and of another the audit of its recording tells.
        conditions: What the device must satisfy, as sentences.
        is_certified: Whether b >= scale · force_scale · (KT/2 + B') holds for the device in
            translation and rotation; None where its damping is unknown, or where no coupling law
            makes that condition enough.
        stopped_by: ``duration``, ``signal``, ``caller``, or who else called ``Bridge.stop``.
        recording: The file, if one was written.
        reach: Distance of the device in m from the origin of its frame beyond which it moved
            without the handle and without force; None without such a limit.
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
        """``passive`` (strict or within slack, and no kick that is metered) or ``active``."""
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
        """Reads the summary of a run out of the kernel's state and the loop's counters.

        Args:
            state: ``kernel.layout.STATE_DTYPE``, one element.
            parameters: Of the run.
            info: The device.
            method: How the tool was rendered.
            asked: The coupling asked for.
            ticks: Ticks that were done.
            overruns: Ticks that started a period or more after their deadline.
            skipped: Deadlines that were skipped for it.
            dropped: Records that were lost.
            stopped_by: What ended the run.
            recording: The file, if one was written.
        """
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
