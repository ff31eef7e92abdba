"""Contact settings on two rigs: one mass on a wall, and a peg that jams in its hole."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.guard import UNLIMITED
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import ClosedLoop
from hapticbridge.study.maps.contact_hands import random_push, recorded, tapping
from hapticbridge.study.maps.contact_treatments import PERIOD, Treatment
from hapticbridge.study.maps.rigs import loop_in, set_tool_mass

DEVICE_MARGIN = 1.25
"""Device damping over the KT/2 + B of (6): the device is never what fails here."""

WALL_DAMPING = 2.0
"""B on the wall, in N s/m."""

PEG_DAMPING = 0.5
"""B on the peg, in N s/m; soft, so that the coupling hides little of what contacts create."""

PEG_ROTATION = (1e-3, 5e-4)
"""K_r over K, in m²/rad, and B_r in N m s/rad: the README's 2 N m/rad at 2000 N/m."""

PEG_START = 0.005
"""Height of the peg's centre at the start in m: 25 mm of the 60 mm peg stand in the hole."""

DEPTH_EVERY = 20
"""Ticks in contact between two looks at the depth: the peak of a push lasts longer, and every look
costs as much as five ticks."""

WALL_RUNS = tuple(itertools.product((0.01, 0.05, 0.2), (0, 1)))
"""Tool mass in kg and hand, the most often active first."""

PEG_RUNS = tuple(itertools.product((0.03, 0.1), (0.0, 0.42), (1, 2)))
"""Tool mass in kg, friction and hand (0 is the recorded one, others are seeds), likewise."""


@dataclass(frozen=True, slots=True)
class ContactRun:
    """One closed loop with contact.

    Attributes:
        environment: The ledger's verdict.
        created: Largest Σ E_k in J.
        slack_share: Largest share of the slack that was used.
        first_active: Tick at which the environment went beyond the slack, −1 for none.
        peak_force: In N.
        depth: Largest penetration in m.
    """

    environment: str
    created: float
    slack_share: float
    first_active: int
    peak_force: float
    depth: float


def summary(runs: Sequence[ContactRun]) -> dict[str, float | int]:
    """Returns how many runs had each verdict, and the worst and the usual of them."""
    verdicts = [run.environment for run in runs]
    failed = [run.first_active for run in runs if run.first_active >= 0]
    depths = [run.depth for run in runs]
    return {
        "runs": len(runs),
        "strict": verdicts.count("strict"),
        "within_slack": verdicts.count("within slack"),
        "active": verdicts.count("active"),
        "created": max(run.created for run in runs),
        "slack_share": max(run.slack_share for run in runs),
        "first_active": min(failed, default=-1),
        "peak_force": max(run.peak_force for run in runs),
        "median_depth": float(np.median(depths)),
        "largest_depth": max(depths),
    }


def until_active(runs: Iterable[ContactRun]) -> list[ContactRun]:
    """Returns runs to the first that is active: no later one can make their verdict worse.

    Given runs that are made as they are asked for, no later one is made.
    """
    made = []
    for run in runs:
        made.append(run)
        if run.environment == "active":
            break
    return made


def wall_runs(
    treatment: Treatment, stiffness: float, cases: Iterable[tuple[float, int]] = WALL_RUNS
) -> Iterator[ContactRun]:
    """Runs masses (kg) against a wall with hands (0 slow and deep, 1 fast) at K in N/m.

    Every run is made when it is asked for.
    """
    loop = loop_in("virtual_wall", "contact")
    coupling = Coupling(stiffness, WALL_DAMPING, 1.0, 1e-3)  # the rail lets nothing turn
    for mass, hand in cases:
        treatment.apply(loop.scene.model, 0.0)
        set_mass(loop, "tool", mass)
        device = firm_device(
            coupling, tapping((3.0, 6.0)[hand]), Hand(stiffness=2000.0, damping=25.0)
        )
        records, run = run_once(loop, device, coupling, treatment, 1000)
        # the face is 10 mm from where the tool's surface starts
        depth = max(0.0, float(records["tool_position"][:, 0].max()) - 0.01)
        yield replace(run, depth=depth)


def peg_runs(
    treatment: Treatment,
    stiffness: float,
    cases: Iterable[tuple[float, float, int]] = PEG_RUNS,
) -> Iterator[ContactRun]:
    """Runs pegs by mass (kg), friction and hand in the hole at K in N/m, as ``wall_runs`` does."""
    loop = loop_in("peg_in_hole", "contact", start_in_hole)
    for mass, friction, hand in cases:
        treatment.apply(loop.scene.model, friction)
        set_mass(loop, "peg", mass)
        device, coupling = peg_device(stiffness, hand)
        records, run = run_once(loop, device, coupling, treatment, ticks_of(device))
        yield replace(run, depth=deepest(loop, records))


def peg_device(stiffness: float, hand: int) -> tuple[SimulatedDevice, Coupling]:
    """Returns a hand (0 is the recorded one, others are seeds) and the coupling by K in N/m."""
    per_k, rotational_damping = PEG_ROTATION
    coupling = Coupling(stiffness, PEG_DAMPING, per_k * stiffness, rotational_damping)
    path, holder = recorded() if hand == 0 else random_push(hand)
    return firm_device(coupling, path, holder), coupling


def ticks_of(device: SimulatedDevice) -> int:
    """Returns how many ticks a hand's path takes."""
    return int((device.info.duration or 0.0) / PERIOD)


def run_once(
    loop: ClosedLoop,
    device: SimulatedDevice,
    coupling: Coupling,
    treatment: Treatment,
    ticks: int,
) -> tuple[NDArray[np.void], ContactRun]:
    """Returns a run's records, and what it came to but for its depth."""
    outcome = loop.run(
        device,
        coupling,
        METHODS[treatment.method],
        period=PERIOD,
        ticks=ticks,
        substeps=treatment.substeps,
        keep_records=True,
    )
    run = ContactRun(
        outcome.environment,
        outcome.created,
        outcome.slack_share,
        outcome.first_active,
        outcome.peak_force,
        0.0,
    )
    return outcome.records, run


def firm_device(coupling: Coupling, path: Motion, hand: Hand) -> SimulatedDevice:
    """Returns a hand with a device that bears the coupling with a margin."""
    half = PERIOD / 2
    return SimulatedDevice(
        damping=DEVICE_MARGIN * (coupling.stiffness * half + coupling.damping),
        rotational_damping=DEVICE_MARGIN
        * (coupling.rotational_stiffness * half + coupling.rotational_damping),
        hand=hand,
        path=path,
        force_limit=UNLIMITED.force,
        torque_limit=UNLIMITED.torque,
    )


def set_mass(loop: ClosedLoop, body: str, mass: float) -> None:
    """Gives a tool a mass in kg."""
    set_tool_mass(loop.scene.model, body, mass)
    mujoco.mj_setConst(loop.scene.model, loop.scene.data)


def start_in_hole(model: mujoco.MjModel) -> None:
    """Lets runs of ``peg_in_hole`` start with the peg in the hole."""
    model.key_qpos[0, 2] = PEG_START


def deepest(loop: ClosedLoop, records: NDArray[np.void]) -> float:
    """Returns the largest penetration in m, from the poses that were recorded."""
    model, data = loop.scene.model, loop.scene.data
    depth = 0.0
    for row in records[records["contacts"] > 0][::DEPTH_EVERY]:
        data.qpos[:3], data.qpos[3:7] = row["tool_position"], row["tool_quaternion"]
        mujoco.mj_fwdPosition(model, data)
        if data.ncon:
            depth = max(depth, -float(data.contact.dist.min()))
    return depth
