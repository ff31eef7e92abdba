"""What substeps buy, accuracy, and what they cost: device damping."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from kernel_runs import T
from rendering_runs import FREE_MASS, rendered, sway

from hapticbridge.bridge import Bridge
from hapticbridge.certificate import default_coupling, device_conditions, required_damping
from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import CouplingError, HapticBridgeError
from hapticbridge.lab.closed_loop import ClosedLoop, LoopOutcome
from hapticbridge.lab.methods import METHODS
from hapticbridge.rendering import default_method
from hapticbridge.scene import load_scene
from hapticbridge.theory.rigid_body import exact_mass_response
from hapticbridge.theory.sampled_loop import WorstHand

COUPLING = Coupling(2400.0, 0.5, 2.4, 5e-4)
KNOCK = np.array([1e-4, 0, 0, 0, 0, 0])
WALL = math.inf
ANGLES = np.geomspace(3e-3, np.pi, 800)


def response(angle: float, laws: int, mass: float) -> complex:
    """What a device feels per displacement, from the n steps of a tick written as one matrix."""
    z = np.exp(1j * angle)
    handle = 1 - np.arange(laws - 1, -1, -1) / laws * (1 - 1 / z)
    difference = np.eye(laws) - np.eye(laws, k=-1) + 0j
    difference[0, -1] -= 1 / z
    law = COUPLING.stiffness * np.eye(laws) + COUPLING.damping * laws / T * difference
    tool = np.zeros(laws, dtype=complex)
    if mass < WALL:
        inertia = mass * (laws / T) ** 2 * difference @ difference
        tool = np.linalg.solve(inertia + law, law @ handle)
    return complex((law @ (handle - tool)).mean())


def worst(laws: int, mass: float) -> tuple[float, float]:
    """Returns the largest b = (T/2) (Re H − Im H cot(θ/2)) and its θ."""
    found = []
    for angle in ANGLES:
        felt = response(angle, laws, mass)
        found.append(T / 2 * (felt.real - felt.imag / math.tan(angle / 2)))
    i = int(np.argmax(found))
    return found[i], float(ANGLES[i])


@pytest.mark.parametrize(("laws", "percent"), [(1, 0.089), (2, 0.044), (4, 0.022)])
def test_error_of_a_free_mass_falls_with_the_number_of_substeps(laws: int, percent: float) -> None:
    """1 kg moved at 2 Hz, against the mass behind an unsampled coupling, when it has settled."""
    frequency, amplitude, ticks, window = 2.0, 0.01, 30_000, 5000
    run = rendered(
        "implicit",
        COUPLING,
        sway(ticks, amplitude, frequency),
        FREE_MASS.format(mass=1.0),
        substeps=laws,
    )
    time = T * np.arange(ticks - window + 1, ticks + 1)
    wave = np.exp(2j * np.pi * frequency * time)
    position = run.ticks["tool_position"][-window:, 0]
    measured = 2j * np.mean(position / wave) / amplitude
    exact = complex(exact_mass_response(COUPLING, 1.0, frequency))
    assert 100 * abs(measured / exact - 1) == pytest.approx(percent, rel=0.1)


def test_damping_that_substeps_need_is_what_is_printed() -> None:
    needed = [required_damping(COUPLING, T, n) for n in (1, 2, 4, 8)]
    assert needed == pytest.approx([1.70, 1.63, 1.90, 2.42], abs=6e-3)


def test_strict_environments_need_less_than_the_form_grants() -> None:
    masses = (WALL, 1.0, 0.2, 0.05, 0.02, 0.01)
    for laws, wall, most in ((1, 1.70, 1.70), (2, 1.30, 1.30), (4, 1.60, 1.65), (8, 1.75, 2.03)):
        found = [worst(laws, mass)[0] for mass in masses]
        assert found[0] == pytest.approx(wall, abs=6e-3)
        assert max(found) == pytest.approx(most, abs=6e-3)
        assert max(found) <= required_damping(COUPLING, T, laws) * (1 + 1e-9)


@pytest.mark.parametrize(("laws", "mass"), [(4, 0.05), (8, 0.05)])
def test_worst_hand_behind_substeps_diverges_below_the_limit_and_not_above(
    laws: int, mass: float
) -> None:
    limit, angle = worst(laws, mass)
    scene = load_scene("point_mass")
    body = scene.model.site_bodyid[scene.model.site("grip").id]
    scene.model.body_mass[body] = mass
    mujoco.mj_setConst(scene.model, scene.data)
    loop = ClosedLoop(scene)

    def run(damping: float) -> LoopOutcome:
        hand = WorstHand(damping, angle / T, T, response(angle, laws, mass))
        return loop.run(
            SimulatedDevice(hand=hand),
            Coupling(COUPLING.stiffness, COUPLING.damping, 0.0, 0.0),
            METHODS["implicit"],
            substeps=laws,
            ticks=4000,
            knock=KNOCK,
        )

    below, above = run(0.9 * limit), run(1.05 * limit)
    assert (below.is_stable, above.is_stable) == (False, True)
    assert below.environment == above.environment == "strict"
    assert run(required_damping(COUPLING, T, laws)).is_stable


@pytest.mark.parametrize("laws", [1, 2, 4, 8, 32])
@pytest.mark.parametrize("period", [1e-4, 1e-3, 5e-3])
def test_default_coupling_is_certified_with_any_number_of_substeps(
    laws: int, period: float
) -> None:
    info = SimulatedDevice().info
    for scales in ((1.0, 1.0), (3.0, 0.5)):
        coupling = default_coupling(info, period, *scales, laws)
        used = default_method(laws).used(coupling, period / laws)
        conditions = device_conditions(info, used, period, *scales, laws)
        assert all(c.needed <= 0.85 * (c.available or 0.0) * (1 + 1e-6) for c in conditions)
        assert laws == 2 or conditions[0].needed == pytest.approx(0.85 * 2.0)


def test_a_bridge_without_a_coupling_asked_for_is_certified_with_substeps() -> None:
    with Bridge("point_mass", substeps=8, clock=SimulatedClock()) as bridge:
        summary = bridge.run(0.05)
    assert summary.is_certified
    assert summary.requested == bridge.setup.coupling
    assert summary.requested.stiffness < 2400


@pytest.mark.parametrize("substeps", [0, 101, 100_000, 1.5, math.nan])
def test_substeps_out_of_range_are_refused_in_one_sentence_wherever_they_enter(
    substeps: int,
) -> None:
    with pytest.raises(HapticBridgeError, match=r"substeps is .* whole number"):
        Bridge("point_mass", substeps=substeps)
    with pytest.raises(CouplingError, match=r"substeps is .* whole number"):
        required_damping(COUPLING, T, substeps)
    with pytest.raises(CouplingError, match=r"substeps is .* whole number"):
        default_coupling(SimulatedDevice().info, T, laws=substeps)
    with pytest.raises(HapticBridgeError, match=r"substeps is .* whole number"):
        ClosedLoop(load_scene("point_mass")).run(
            SimulatedDevice(), COUPLING, METHODS["implicit"], substeps=substeps
        )
