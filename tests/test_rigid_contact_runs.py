"""Rigid contact over whole runs: made and lost, in random hands, other periods, islands, sleep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import mujoco
import numpy as np
import pytest
from kernel_runs import Array, load, run_of, samples_of, unlimited
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import METHODS, prepare
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.lab.closed_loop import LoopOutcome
from hapticbridge.lab.maps import contact_rigs as rigs
from hapticbridge.lab.maps.base import loop_in
from hapticbridge.lab.maps.contact_rigs import COMPARED_RIGS, Case, run_case

FREE = [name for name in COMPARED_RIGS if not rigs.RIGS[name].is_shipped]
SHIPPED = [name for name in COMPARED_RIGS if rigs.RIGS[name].is_shipped]

TOOLS = ((1000.0, 0.03, 0.0), (6000.0, 0.03, 0.1), (2400.0, 0.1, 0.4), (6000.0, 0.3, 0.0))
"""K in N/m, mass in kg and friction of the random runs."""


def cases(rig: str, hands: tuple[int, ...]) -> list[Case]:
    return [Case(rig, *tool, hand) for tool in TOOLS for hand in hands]


def hold_strict(outcome: LoopOutcome, case: Case) -> None:
    assert outcome.environment == "strict", case
    assert (outcome.depths > 0).any(), case


# A contact made and lost, beside an integration from event to event

MASS, STIFFNESS, DAMPING, END = 0.1, 1000.0, 2.0, 2.0


def handle(t: Array) -> Array:
    """Returns the handle's height in m above the place where the tool touches."""
    return np.asarray(3e-3 * np.cos(3.4 * np.pi * t) + 5e-4)


def handle_speed(t: Array) -> Array:
    return np.asarray(-3e-3 * 3.4 * np.pi * np.sin(3.4 * np.pi * t))


def pull(t: float) -> float:
    """Returns the coupling's force in N on a tool that stands on the floor."""
    return float(STIFFNESS * handle(np.array(t)) + DAMPING * handle_speed(np.array(t)))


def motion(t: float, y: Array) -> list[float]:
    return [y[1], (pull(t) - STIFFNESS * y[0] - DAMPING * y[1]) / MASS]


def touches(_: float, y: Array) -> float:
    return float(y[0])


touches.terminal, touches.direction = True, -1  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Phase:
    begin: float
    end: float
    height: Callable[[Array], Array]


def height_of(solution: Callable[[Array], Array], t: Array) -> Array:
    return np.asarray(solution(t)[0])


@cache
def phases() -> list[Phase]:
    """Returns free and held phases: m x'' = K (h − x) + B (h' − x') down to an inelastic floor."""
    found: list[Phase] = []
    time, height = 0.0, float(handle(np.array(0.0)))
    while time < END:
        flight = solve_ivp(
            motion, (time, END + 0.1), [height, 0.0], events=touches, rtol=1e-10, atol=1e-13,
            dense_output=True,
        )  # fmt: skip
        found.append(Phase(time, flight.t[-1], partial(height_of, flight.sol)))
        time = flight.t[-1]
        pulls = np.flatnonzero([pull(t) > 0 for t in np.arange(time, END + 1, 1e-3)])
        release = brentq(pull, time + 1e-3 * (pulls[0] - 1), time + 1e-3 * pulls[0])
        found.append(Phase(time, release, np.zeros_like))
        time, height = release, 0.0
    return found


BALL = """
<mujoco>
  <option gravity="0 0 0" cone="elliptic"><flag diagexact="enable"/></option>
  <default><geom solref="{solref} 1" solimp="0.9 0.95 0.001"/></default>
  <worldbody>
    <body name="tool" pos="0 0 {start}"><freejoint/><geom type="sphere" size="0.01" mass="{mass}"/>
      <site name="grip"/></body>
    <geom type="box" size="0.1 0.1 0.01" pos="0 0 -0.02"/>
  </worldbody>
</mujoco>"""


@cache
def flown(period: float, method: str, contact: str) -> tuple[Array, Array]:
    """Returns time in s and height in m of a ball that a handle takes to the floor and back."""
    start = float(handle(np.array(0.0)))
    scene = load(BALL.format(start=start, mass=MASS, solref=2 * period))
    chosen = METHODS[method].with_contact(contact)
    coupling = Coupling(STIFFNESS, DAMPING, 1.0, 1e-3)
    prepare(scene, coupling, period, 1, chosen, warns=False)
    parameters = unlimited(scene, coupling, period, scheme=chosen.scheme, is_rigid=chosen.is_rigid)
    run = run_of(scene, BoundKernel(scene.model, scene.data, parameters), parameters)
    time = np.asarray(period * np.arange(1.0, round(END / period) + 1.0), dtype=np.float64)
    places = np.zeros((len(time), 3))
    places[:, 2] = handle(time) - start
    run.ticks = np.zeros(len(time), TICK_DTYPE)
    assert simulate(run.binding.state, samples_of(places), run.binding.row, run.ticks) == len(time)
    return time, np.array(run.ticks["tool_position"][:, 2], dtype=np.float64)


def errors(period: float, method: str, contact: str = "rigid") -> Array:
    time, height = flown(period, method, contact)
    exact = np.zeros_like(time)
    for phase in phases():
        inside = (time >= phase.begin) & (time <= phase.end)
        exact[inside] = phase.height(time[inside])
    return np.asarray(np.abs(height - exact))


@pytest.mark.parametrize("method", ["implicit", "lossless"])
def test_a_contact_made_and_lost_is_followed_to_first_order(method: str) -> None:
    coarse, fine = (errors(period, method).max() for period in (1e-3, 2.5e-4))
    assert np.log2(coarse / fine) / 2 > 0.85
    # the tool moves by 65 mm/s, that is by 65 µm in 1 ms
    assert coarse < 60e-6


@pytest.mark.parametrize("method", ["implicit", "lossless"])
def test_flight_and_release_are_as_accurate_as_with_the_scenes_contact(method: str) -> None:
    for period in (2e-3, 1e-3):
        rigid, own = (errors(period, method, contact) for contact in ("rigid", "scene"))
        assert rigid.max() < 1.1 * own.max()
        assert np.sqrt((rigid**2).mean()) < 1.02 * np.sqrt((own**2).mean())


def test_where_the_exact_tool_is_held_a_rigid_one_stands_within_a_micrometre() -> None:
    assert len(phases()) > 6
    for method in ("implicit", "lossless"):
        for contact, least, most in (("rigid", 0.0, 0.5e-6), ("scene", 5e-6, 1e-3)):
            time, height = flown(1e-3, method, contact)
            for phase in phases()[1::2]:
                middle = (time > phase.begin + 0.02) & (time < phase.end - 5e-3)
                assert least <= np.abs(height[middle]).max(initial=least) < most, contact


# Random hands


@pytest.mark.parametrize("rig", FREE)
def test_random_hands_find_no_energy_and_no_depth_in_a_rig(rig: str) -> None:
    for number, case in enumerate(cases(rig, (61, 62))):
        method = ("implicit", "lossless")[number % 2]
        outcome = run_case(replace(rigs.RIGID, method=method), case)
        hold_strict(outcome, case)
        # a contact that closes faster than 0.15 m/s is first seen in penetration
        assert outcome.depths.max() < 90e-6, case
        assert np.median(outcome.depths[outcome.depths > 0]) < 8e-6, case


@pytest.mark.parametrize("rig", SHIPPED)
def test_shipped_scenes_with_jointed_grips_among_them_are_strict_and_sharp(rig: str) -> None:
    for hand in (0, 61):
        for method in ("implicit", "lossless"):
            case = Case(rig, 3000.0, hand=hand)
            outcome = run_case(replace(rigs.RIGID, method=method), case)
            hold_strict(outcome, case)
            assert np.median(outcome.depths[outcome.depths > 0]) < 4e-6, case


@pytest.mark.parametrize("period", [2.5e-4, 5e-4, 2e-3, 4e-3])
def test_rigid_contacts_are_strict_at_other_periods(period: float) -> None:
    for rig in ("peg", "taps", "stack", "bench_pliers", "lock"):
        case = Case(rig, *TOOLS[1], 61)
        hold_strict(run_case(replace(rigs.RIGID, period=period), case), case)


# MuJoCo's islands and sleep


def run_with(flags: str, bit: int, case: Case) -> LoopOutcome:
    """Runs a case with a bit of MuJoCo's options set."""
    scene = loop_in(rigs.RIGS[case.rig].load, "contact").scene
    scene.set_contact(is_rigid=False)  # the options are then the scene's own
    option, own = scene.model.opt, getattr(scene.model.opt, flags)
    setattr(option, flags, own | bit)
    try:
        return run_case(rigs.RIGID, case, keep_records=True)
    finally:
        scene.set_contact(is_rigid=False)
        setattr(option, flags, own)


@pytest.mark.parametrize("rig", ["stack", "bench_pliers", "hex_key"])
def test_contacts_are_strict_with_and_without_islands_and_move_alike(rig: str) -> None:
    case = Case(rig, 2400.0, 0.03, 0.1, 61)
    islands = run_case(rigs.RIGID, case, keep_records=True)
    without = run_with("disableflags", int(mujoco.mjtDisableBit.mjDSBL_ISLAND), case)
    for outcome in (islands, without):
        hold_strict(outcome, case)
    moved = islands.records["tool_position"] - without.records["tool_position"]
    assert np.abs(moved).max() < 1e-6


@pytest.mark.parametrize("rig", ["stack", "bench_pliers"])
def test_contacts_of_sleeping_bodies_are_strict(rig: str) -> None:
    case = Case(rig, 2400.0, 0.03, 0.1, 61)
    asleep = run_with("enableflags", int(mujoco.mjtEnableBit.mjENBL_SLEEP), case)
    hold_strict(asleep, case)
    awake = run_case(rigs.RIGID, case, keep_records=True)
    moved = asleep.records["tool_position"] - awake.records["tool_position"]
    assert 0 < np.abs(moved).max() < 5e-4
