"""Going over to the implicit form at contact: what it saves, and what equal damping is for."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest
from kernel_runs import Array
from lossless_runs import T, bound, led, tapping

from hapticbridge.coupling import Coupling
from hapticbridge.device.trajectory import pose_at, read_motion
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.tick import after_step, before_step, simulate
from hapticbridge.lab.methods import METHODS
from hapticbridge.record import SAMPLE_DTYPE, TICK_DTYPE, TickFlag
from hapticbridge.scene import load_scene, scene_path
from hapticbridge.summary import Ledger

# --- without it -----------------------------------------------------------------------------------


def samples_for(name: str) -> np.ndarray:
    """Returns taps on the wall, or the hand path that a scene comes with."""
    if name == "virtual_wall":
        samples = np.zeros(2000, SAMPLE_DTYPE)
        samples["position"], samples["quaternion"][:, 0] = tapping(T, 4.0), 1.0
        return samples
    motion = read_motion(scene_path(name).with_suffix(".csv")).relative()
    samples = np.zeros(int(motion.duration / T), SAMPLE_DTYPE)
    cursor = 0
    for k in range(len(samples)):
        cursor, position, quaternion = pose_at(motion.table, T * (k + 1), cursor)
        samples["position"][k], samples["quaternion"][k] = position, quaternion
    return samples


def created(name: str, method: str, *, is_seen: bool = True) -> tuple[float, str]:
    """Returns the largest Σ E_k in J of a scene without friction, and the ledger's verdict."""
    scene = load_scene(name)
    scene.model.geom_condim[:] = 1  # jamming bifurcates: with friction nothing can be ranked
    samples = samples_for(name)
    binding = bound(scene, method, Coupling(6000.0, 3.5, 6.0, 0.0017), T)
    if not is_seen:  # nothing of the scene belongs to the tool's tree, so nothing is near it
        binding._owned["geom_in_tree"][:] = 0
    rows = np.zeros(len(samples), TICK_DTYPE)
    assert simulate(binding.state, samples, binding.row, rows) == len(samples)
    return float(rows["environment_energy"].max()), Ledger.of(binding.state).environment


@pytest.mark.parametrize("name", ["virtual_wall", "planar_peg"])
def test_without_the_change_over_a_strict_contact_creates_energy(name: str) -> None:
    most, verdict = created(name, "lossless")
    assert verdict == "strict"
    assert most < 1e-12
    most, verdict = created(name, "lossless", is_seen=False)
    assert verdict == "within slack"
    assert most > 2e-5  # 43 µJ on the peg, 0.4 mJ on the wall


def test_without_the_change_over_a_jamming_peg_creates_more_than_implicit() -> None:
    # several contacts create energy in the implicit form already, 7.0 mJ; 5.1 and 8.4 mJ
    implicit, _ = created("peg_in_hole", "implicit")
    assert created("peg_in_hole", "lossless")[0] < implicit
    assert created("peg_in_hole", "lossless", is_seen=False)[0] > 1.1 * implicit


def struck(method: str) -> tuple[Array, float, Array]:
    """Lets 30 g strike the wall with the B' of ``lossless``, so stiffly held that energy is made.

    Returns:
        Σ E_k before the first contact, J, its largest rise from there, and the tool's position, m.
    """
    scene = load_scene("virtual_wall")
    scene.model.body_mass[scene.model.body("tool").id] = 0.03
    mujoco.mj_setConst(scene.model, scene.data)
    law = METHODS["lossless"].used(Coupling(6000.0, 7.5, 1.0, 0.002), T)
    path = tapping(T, 5.0)[:100]
    rows, _ = led(scene, method, METHODS[method].rendered(law, T), path, T)
    first = int(np.argmax(rows["contacts"] > 0))
    energy: Array = rows["environment_energy"]
    return energy[:first], float(energy.max() - energy[first - 1]), rows["tool_position"][:, 0]


def test_a_strike_makes_what_implicit_makes_but_implicit_has_burned_some_before() -> None:
    # so of the slack lossless uses 4.9 %, implicit 4.7 %
    (before, made, place), (burned, by_implicit, other) = struck("lossless"), struck("implicit")
    assert place.max() == pytest.approx(other.max(), rel=1e-2)
    assert made > 5e-4
    assert made == pytest.approx(by_implicit, rel=0.01)
    assert burned[-1] < -2e-5
    assert np.abs(before).max() < -0.01 * burned[-1]
    # what is made beyond (14) differs by no more than that
    assert 0 < made + before[-1] - by_implicit - burned[-1] < -burned[-1]


# --- equal damping on both sides ------------------------------------------------------------------

PUSH = 1.0  # N, with which the hand presses the tool against the wall
K, FREE = 2400.0, 0.5  # N/m, and B' in N s/m of the lossless side
HALF = 0.5 * K * T


def pressed(more: float, damping: float, ticks: int = 4000) -> tuple[Array, np.ndarray, str]:
    """Presses a tool on a wall with a device that is nothing but a damper: v = (PUSH − f)/b.

    At Nyquist it is the worst passive hand, and exact under the hold.

    Args:
        more: What the implicit side has more of B' than the lossless one, in N s/m.
        damping: b in N s/m.
        ticks: How many.

    Returns:
        The force on the tool along x, whether it was lossless, and the ledger's verdict.
    """
    scene = load_scene("virtual_wall")
    binding = bound(scene, "lossless", Coupling(K, FREE + HALF, 1.0, 0.002), T)
    state, row = binding.state, binding.row
    first = int(state["mj"]["coupling_actuator_id"][0])
    sample = np.zeros(1, SAMPLE_DTYPE)
    sample["quaternion"][:, 0] = 1.0
    rows = np.zeros(ticks, TICK_DTYPE)
    for k in range(ticks):
        is_free = bool(state["lossless"]["is_midpoint"][0])
        used = FREE if is_free else FREE + more
        state["coupling"]["damping"] = used  # the law's; the gains follow
        share = 0.5 if is_free else 1.0
        scene.model.actuator_gainprm[first : first + 3, 0] = share * used
        scene.model.actuator_biasprm[first : first + 3, 2] = -share * used
        sample["position"][0, 0] += T / damping * (PUSH + row["wrench_on_device"][0, 0])
        assert before_step(state, sample, row, 0, T) == OK
        mujoco.mj_step(scene.model, scene.data)
        assert after_step(state, row, 0) == OK
        rows[k] = row[0]
    is_lossless = (rows["flags"] & int(TickFlag.MIDPOINT)) != 0
    return rows["wrench_on_tool"][:, 0], is_lossless, Ledger.of(state).environment


def test_unequal_damping_makes_a_limit_cycle_that_equal_damping_does_not() -> None:
    # a device that bears the lossless side: with the same B' in contact it comes to rest
    device = 1.1 * (HALF + FREE)
    force, _, verdict = pressed(0.0, device)
    assert force[-500:] == pytest.approx(PUSH, abs=1e-9)
    assert verdict == "strict"
    # 0.3 N s/m more in contact, which this device does not bear there: it grows in contact, is
    # thrown off the wall, dies down in free space, comes back, and so on for ever
    device = HALF + FREE + 0.8 * 0.3
    assert device > 1.1 * (HALF + FREE)
    force, is_lossless, verdict = pressed(0.3, device, 8000)
    ripple = [np.ptp(force[i : i + 2000]) for i in range(0, 8000, 2000)]
    assert ripple == pytest.approx([72.0] * 4, rel=0.1)
    changes = np.diff(is_lossless.astype(int)) != 0
    assert all(changes[i : i + 2000].sum() >= 10 for i in range(0, 8000, 2000))
    # no energy comes from the change-over: it is the device that is beyond its condition
    assert verdict == "strict"


@pytest.mark.parametrize("more", [-0.4, 0.3, HALF])
def test_unequal_damping_comes_to_rest_where_the_device_bears_both_sides(more: float) -> None:
    force, _, verdict = pressed(more, 1.03 * (HALF + FREE + max(more, 0.0)))
    assert force[-500:] == pytest.approx(PUSH, abs=1e-9)
    assert verdict == "strict"


def balance(law: Array, handle: Array, tool: Array, device: float) -> float:
    """Σ f_k (d_{k+1} − δx_k) + Σ (b/T) d_{k+1}² + what the spring held, for B' by tick; in J.

    Args:
        law: B'_k in N s/m, k = 1 … N.
        handle: d_k in m, k = 1 … N + 1.
        tool: δx_k in m, k = 1 … N.
        device: b in N s/m.
    """
    moved = handle[:-1] - tool
    stretch = np.cumsum(moved)
    force = K * stretch + law / T * moved
    work = float(np.sum(force * (handle[1:] - tool)))
    return work + device / T * float(np.sum(handle**2)) + 0.5 * K * float(handle[0] ** 2)


def test_a_device_that_bears_the_larger_damping_bears_any_sequence_of_them() -> None:
    # the inequality in the docstring of ``theory.compensation``, against random motions
    random = np.random.default_rng(3)
    low, high = FREE, FREE + HALF
    device = HALF + high
    for trial, count in itertools.product(range(20), (2, 20, 200)):
        law = random.choice([low, high], count)
        handle = random.normal(size=count + 1)
        if trial % 2:  # every other at Nyquist, where it is hardest
            handle = np.abs(handle) * (-1.0) ** np.arange(count + 1)
        tool = random.normal(size=count) * random.choice([0.0, 0.1, 1.0])
        scale = device / T * float(np.sum(handle**2))
        assert balance(law, handle, tool, device) >= -1e-9 * scale
    # and it needs that much: the larger all the time, or on average what two ticks on end have
    nyquist: Array = (-1.0) ** np.arange(2001, dtype=np.float64)
    wall = np.zeros(2000)
    assert balance(np.full(2000, high), nyquist, wall, 0.99 * device) < 0
    taking_turns = np.where(np.arange(2000) % 2, low, high)
    mean = HALF + 0.5 * (low + high)
    assert balance(taking_turns, nyquist, wall, 0.99 * mean) < 0
    assert balance(taking_turns, nyquist, wall, mean) >= 0
