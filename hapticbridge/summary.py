"""Summary of a run."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.certificate import condition_sentences, is_run_certified, run_conditions
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.kernel.codes import COUPLING_ACTUATORS, Scheme
from hapticbridge.kernel.lossless import tree_of_tool
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.record import TickFlag
from hapticbridge.rendering import Method
from hapticbridge.theory.compensation import IMPLICIT_SHARE, effective_damping

# Sentences on the effective coupling and its law


def is_always_implicit(model: mujoco.MjModel, grip: str) -> bool:
    """Returns True if a lossless coupling stays implicit because the tool is never free.

    References:
        ``kernel.lossless.ToolTree.is_never_free`` lists the causes.
    """
    own = [model.actuator(name).id for name in COUPLING_ACTUATORS]
    return tree_of_tool(model, int(model.site(grip).bodyid[0]), own).is_never_free


def was_always_implicit(ticks: NDArray[np.void]) -> bool:
    """Returns True if no record of a run was lossless; False without records."""
    return was_never_lossless(len(ticks), int(np.bitwise_or.reduce(ticks["flags"])))


def was_never_lossless(count: int, flags: int) -> bool:
    """Returns True if no record was lossless, by the number of records and their combined flags."""
    return count > 0 and not flags & int(TickFlag.MIDPOINT)


def coupling_sentences(
    law: Coupling, method: Method, period: float, substeps: int, *, is_always_implicit: bool = False
) -> tuple[str, ...]:
    """Describes effective and law coupling: translation, then rotation if it has a spring.

        B = B' + adds K h,    h = T / substeps        (away from contact, to first order in h)

    A hand feels K and B. The law uses a smaller B' if the integration adds damping by itself, and
    the device condition b >= K T/2 + B' counts B'.

    Args:
        law: K and B' of the law.
        method: The rendering method; without a coupling law there are no sentences.
        period: T in s.
        substeps: MuJoCo steps per tick.
        is_always_implicit: True if the tool of a lossless coupling is never free. The coupling is
            then always implicit and adds the implicit form's damping. No effect on other methods.
    """
    if not method.has_law:
        return ()
    kinds = [_AxisGains("K", "B", law.stiffness, law.damping, "N/m", "N s/m")]
    if law.rotational_stiffness > 0:
        rotation = law.rotational_stiffness, law.rotational_damping
        kinds.append(_AxisGains("K_r", "B_r", *rotation, "N m/rad", "N m s/rad"))
    name, adds = method.name, method.added_share
    if is_always_implicit and method.scheme == Scheme.MIDPOINT:
        name, adds = f"{name}, here always implicit,", IMPLICIT_SHARE
    return tuple(_sentence(name, adds, period / substeps, substeps, kind) for kind in kinds)


class _AxisGains(NamedTuple):
    """Gains of the law along one kind of axis, with their symbols and units."""

    spring: str
    damper: str
    stiffness: float
    damping: float
    spring_unit: str
    damper_unit: str


def _sentence(name: str, adds: float | None, step: float, substeps: int, gains: _AxisGains) -> str:
    spring, damper, stiffness, damping, spring_unit, damper_unit = gains
    start = f"{spring} = {stiffness:.4g} {spring_unit}, {damper} ="
    if adds is None:
        return f"{start} {damper}' = {damping:.4g} {damper_unit} ({name} uses it as requested)"
    effective = effective_damping(stiffness, damping, step, adds)
    parts = substeps / adds
    added = ("KT" if spring == "K" else f"{spring} T") + (f"/{parts:g}" if parts != 1 else "")
    return (
        f"{start} {effective:.4g} {damper_unit} felt ({name} adds {added} to its {damper}' = "
        f"{damping:.4g})"
    )


def watch_sentence(flags: int) -> str:
    """Describes what the watch did to the force (``kernel.swing_watch``), with the remedy.

    Args:
        flags: Combined flags of a run's records; without the watch's own the text is empty.
    """
    if flags & int(TickFlag.RUNS_AWAY):
        return (
            "the force was taken away because the device gained speed against it: an axis is "
            "reversed (check the axes and signs of the device) or the force comes very late"
        )
    if flags & int(TickFlag.SWINGING):
        return (
            "the force was lowered because it swung as that of a late device does: lower "
            "--stiffness, and measure the device's delay ('hapticbridge identify')"
        )
    return ""


# Energies metered by the kernel, and the environment's verdict

Environment = Literal["strict", "within slack", "active"]


@dataclass(frozen=True, slots=True)
class Ledger:
    """Energies of a run in J; all but the storage are cumulative since its start.

    E_k = S_k − S_{k−1} − (works of all ports in tick k). The environment has released no more
    energy than it received while Σ E_k <= 0, eq. (14) of Brown & Colgate (1997). The device stays
    safe while Σ E_k stays below the slack, Σ ½ (K + B/T) ‖δx_k‖² and its rotational counterpart.

    Attributes:
        kinetic: Present kinetic energy.
        potential: Present potential energy of gravity and springs.
        coupling_work: Work of the coupling on the tool, Σ f_k·δx_k + τ_k·δφ_k.
        actuator_work: Work of the scene's own actuators.
        external_work: Work of applied forces, gravity compensation, moved mocap bodies and resets.
        environment_energy: Σ E_k: energy created (> 0) or dissipated (< 0) by the simulation.
        device_energy: Energy given to the device by the wrenches sent.
        slack: Bound of Σ E_k up to which the guarantee holds.
        slack_share: Largest share of the slack used so far; 0 if always strict.
        first_unstrict: First tick at which (14) did not hold, or None.
        first_active: First tick at which the slack was exceeded, or None.
        first_device_excess: First tick at which a device without a coupling law had received more
            than its damping dissipates and the scene released, or None.
    """

    kinetic: float
    potential: float
    coupling_work: float
    actuator_work: float
    external_work: float
    environment_energy: float
    device_energy: float
    slack: float
    slack_share: float
    first_unstrict: int | None
    first_active: int | None
    first_device_excess: int | None

    @classmethod
    def of(cls, state: NDArray[np.void]) -> Ledger:
        """Reads the ledger from the kernel's state (``STATE_DTYPE``, one element)."""
        energy = state["energy"][0]
        values = {name: float(energy[name]) for name in _ENERGIES}
        ticks = [int(energy[name]) for name in _TICKS]
        unstrict, active, kick = (tick if tick >= 0 else None for tick in ticks)
        return cls(**values, first_unstrict=unstrict, first_active=active, first_device_excess=kick)

    @property
    def environment(self) -> Environment:
        """``strict`` if (14) always held, ``within slack`` or ``active``."""
        if self.first_active is not None:
            return "active"
        return "strict" if self.first_unstrict is None else "within slack"

    @property
    def fault(self) -> tuple[int, str] | None:
        """Tick and port of the first fault, ``environment`` or ``device``; None if passive."""
        faults = ((self.first_active, "environment"), (self.first_device_excess, "device"))
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
    "environment_energy",
    "device_energy",
    "slack",
    "slack_share",
)

_TICKS = ("first_unstrict", "first_active", "first_device_excess")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutcome:
    """Counters of the loop, and the end of a run.

    Attributes:
        ticks: Ticks since the bridge was opened.
        overruns: Ticks that started a period or more after their deadline.
        skipped: Skipped deadlines.
        dropped: Records lost because the recorder was too far behind.
        stopped_by: ``duration``, ``signal``, ``trip``, ``caller``, or another caller of
            ``Bridge.stop``.
        recording: The recording, or None.
    """

    ticks: int
    overruns: int
    skipped: int
    dropped: int
    stopped_by: str
    recording: Path | None


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
        requested: Requested coupling: K and B to be felt.
        law: Coupling of the law, with the damping B' of the device condition.
        coupling_sentences: Sentences on effective and law coupling. They hold away from contact, or
            everywhere if the tool was never released.
        effective: Effective coupling of a weld (its stiffest axis, measured at the start); None
            with a coupling law.
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
        watch: What the watch for a late or reversed force did, in a sentence; empty for nothing.
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
    requested: Coupling
    law: Coupling
    coupling_sentences: tuple[str, ...]
    effective: Coupling | None
    fault: tuple[int, str] | None
    conditions: tuple[str, ...]
    is_certified: bool | None
    stopped_by: str
    recording: Path | None
    reach: float | None
    watch: str

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
        requested: Coupling,
        outcome: RunOutcome,
    ) -> Summary:
        """Builds the summary of a run from the kernel's state and the loop's counters."""
        ledger = Ledger.of(state)
        conditions = run_conditions(info, parameters, method)
        return cls(
            ticks=outcome.ticks,
            duration=(outcome.ticks + outcome.skipped) * parameters.period,
            overruns=outcome.overruns,
            skipped=outcome.skipped,
            dropped=outcome.dropped,
            peak_force=float(state["loop"]["peak_force"][0]),
            peak_torque=float(state["loop"]["peak_torque"][0]),
            energies=ledger.energies(),
            environment=ledger.environment,
            slack_share=ledger.slack_share,
            method=method.name,
            about=method.about,
            hazard=method.hazard,
            requested=requested,
            law=parameters.coupling,
            coupling_sentences=coupling_sentences(
                parameters.coupling,
                method,
                parameters.period,
                parameters.substeps,
                is_always_implicit=outcome.ticks > 0 and not state["lossless"]["ticks"][0],
            ),
            effective=parameters.effective,
            fault=ledger.fault,
            conditions=condition_sentences(info, parameters, method),
            is_certified=is_run_certified(conditions, method),
            stopped_by=outcome.stopped_by,
            recording=outcome.recording,
            reach=parameters.guarding.reach if parameters.guarding.reach < math.inf else None,
            watch=watch_sentence(int(state["watch"]["flags"][0])),
        )
