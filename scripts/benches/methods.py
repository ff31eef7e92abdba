"""The passive methods in contact: every shipped scene, and the map's taps and hole.

One line per scene and method: how many runs were strict, within the slack and active, in how many
more of the slack was used than by 'implicit' in the same hand, the most energy that the environment
made, the largest share of the slack that it used, the largest force, and the largest change of
force within a tick. In a scene the first hand is the path that comes with it, the others are seeds
(``tests/random_hands``: 3 cm and 45 degrees within 5 s), in the scene's own grip; on the map's rigs
they are the map's, over all its tools, couplings and frictions, with the contact settings of the
scene, which may create energy. 'slippery peg' is the scene 'peg_in_hole' without friction, led into
the hole before it is led about.

Methods are compared at the same K, and at the same B felt ('--same felt') or on the same device
('--same device'). Felt: every method is asked for what 'lossless' has by default on the simulated
device; 'implicit' then uses B' = B, needs more device damping than that has, and adds K T on top.
Device: each method has its own default, all of them the same B', which needs the same b >= K T/2 +
B'; then 'compensated' is 'implicit', and both add K T/2 more than 'lossless'.

Nothing here depends on how fast the machine is.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from argument_types import whole
from model_runs import LOOP_SCENES
from random_hands import random_motion

from hapticbridge.demand.certificate import default_coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.device.motion_file import read_motion
from hapticbridge.device.simulated.device import scene_hand
from hapticbridge.lab.closed_loop import ClosedLoop, LoopOutcome
from hapticbridge.lab.maps.contact import cases_of
from hapticbridge.lab.maps.contact_rigs import ContactRun, Treatment, contact_run, run_case
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import load_scene

PERIOD = 1e-3
COMPARED = ("implicit", "compensated", "lossless")
VERDICTS = ("strict", "within slack", "active")
ROUNDING = 1e-9
"""Difference of two shares of the slack that counts as zero, no unit."""

INTO_HOLE = -0.045
"""Descent of a peg in m before its motion in the hole: 35 mm of it are in the hole then."""


def run(loop: ClosedLoop, method: str, hand: int, same: str, first: float) -> LoopOutcome:
    """Runs a scene in a hand: 0 follows the scene's own path, others are seeds.

    With ``first`` all are seeds, which first move up by so many m.
    """
    own = loop.scene.path.with_suffix(".csv")
    is_own = hand == 0 and not first
    path = read_motion(own).relative() if is_own else random_motion(hand, first=first)
    device = SimulatedDevice(path=path, hand=scene_hand(loop.scene.model, own))
    asked_as = METHODS["lossless" if same == "felt" else method]
    coupling = default_coupling(device.info, PERIOD, method=asked_as)
    ticks = round(path.duration / PERIOD)
    return loop.run(device, coupling, METHODS[method], ticks=ticks, keep_records=True)


def steepest(outcome: LoopOutcome) -> float:
    """Returns the largest change of the force on the tool within a tick, in N."""
    force = outcome.records["wrench_on_tool"][:, :3]
    return float(np.linalg.norm(np.diff(force, axis=0), axis=1).max())


Runs = Sequence[LoopOutcome | ContactRun]
COLUMNS = (*VERDICTS, "above", "created", "slack", "peak", "step")


def row(runs: Runs, implicit: Sequence[float], step: float | None) -> dict[str, float | None]:
    """Returns the outcomes of runs; ``implicit`` is its share of the slack in each."""
    counts = Counter(one.environment for one in runs)
    above = sum(one.slack_share > b + ROUNDING for one, b in zip(runs, implicit, strict=True))
    return {verdict: counts[verdict] for verdict in VERDICTS} | {
        "above": above,
        "created": max(0.0, *(one.created for one in runs)),
        "slack": max(one.slack_share for one in runs),
        "peak": max(one.peak_force for one in runs),
        "step": step,
    }


def compared(where: str, runs_of: Callable[[str], Runs]) -> dict[str, Any]:
    """Prints and returns a row of each method in a scene or rig."""
    rows: dict[str, Any] = {}
    implicit: list[float] = []
    for method in COMPARED:
        runs = runs_of(method)
        implicit = implicit or [one.slack_share for one in runs]
        steps = [steepest(one) for one in runs if isinstance(one, LoopOutcome)]
        found = rows[f"{where}, {method}"] = row(runs, implicit, max(steps, default=None))
        cells = ("-" if found[key] is None else f"{found[key]:.3g}" for key in COLUMNS)
        print(f"{where:14} {method:12}", *(f"{cell:>9}" for cell in cells), flush=True)
    return rows


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds the number of hands and what the methods have in common."""
    parser.add_argument("--hands", type=whole, default=20, help="per scene, its own one first")
    parser.add_argument(
        "--same", choices=("felt", "device"), default="felt", help="for all methods"
    )


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Prints the table; returns its rows."""
    print(f"{'scene':14} {'method':12}", *(f"{head:>9}" for head in COLUMNS))
    rows: dict[str, Any] = {}
    shown = [(name, load_scene(name), 0.0) for name in LOOP_SCENES]
    # the one shipped scene that can use the slack: a peg that jams without friction
    shown.append(("slippery peg", load_scene("peg_in_hole", friction=0.0), INTO_HOLE))
    for name, scene, first in shown:
        loop = ClosedLoop(scene)
        rows |= compared(
            name,
            lambda method, loop=loop, first=first: [  # type: ignore[misc]
                run(loop, method, hand, options.same, first) for hand in range(options.hands)
            ],
        )
    for rig in ("taps", "peg"):
        rows |= compared(
            f"map: {rig}",
            lambda method, rig=rig: [  # type: ignore[misc]
                contact_run(
                    run_case(Treatment(method=method), case, same_law=options.same == "device")
                )
                for case in cases_of(rig)
            ],
        )
    return rows
