"""The lossless coupling: second order and balanced in free space, implicit in contact."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kernel_runs import Array
from lossless_runs import ARM, LOSSLESS, SPUN, T, circling, distance, led, scene_of, tapping
from rendering_runs import FREE_MASS
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.certificate import default_coupling
from hapticbridge.coupling import Coupling
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import HapticBridgeError
from hapticbridge.lab.closed_loop import ClosedLoop
from hapticbridge.lab.methods import METHODS
from hapticbridge.record import TickFlag
from hapticbridge.scene import load_scene
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand

# --- accuracy -------------------------------------------------------------------------------------


def response_from_rest(t: Array, stiffness: float, damping: float, mass: float = 1.0) -> Array:
    """x(t) of a mass behind K and B when the handle starts as 20 mm sin(2π 2 Hz t); closed form."""
    w, size = 2 * np.pi * 2.0, 0.02
    law = stiffness + 1j * w * damping
    steady = size * law / (law - mass * w * w)
    roots = np.roots([mass, damping, stiffness])
    start = np.array([-steady.imag, -(1j * w * steady).imag])
    own = np.linalg.solve(np.array([[1, 1], roots]), start)
    moved = (steady * np.exp(1j * w * t)).imag
    return np.asarray(moved + (np.exp(np.outer(t, roots)) @ own).real)


def test_one_mass_is_followed_to_second_order_without_creating_energy(tmp_path: Path) -> None:
    scene = scene_of(FREE_MASS.format(mass=1.0), tmp_path)
    errors = {}
    for method in ("implicit", "compensated", "lossless"):
        for period in (4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4):
            t: Array = period * np.arange(1, round(2.0 / period) + 1, dtype=np.float64)
            path = np.zeros((t.size, 3))
            path[:, 0] = 0.02 * np.sin(2 * np.pi * 2.0 * t)
            rows, _ = led(scene, method, Coupling(1000.0, 5.0, 1.0, 0.005), path, period)
            assert rows["environment_energy"].max() <= 1e-12
            error = rows["tool_position"][:, 0] - response_from_rest(t, 1000.0, 5.0)
            errors[method, period] = float(np.sqrt(np.mean(error**2)) / 0.02)
    assert errors["implicit", 1e-3] == pytest.approx(0.0133, rel=0.01)  # THEORY's table
    assert errors["compensated", 1e-3] == pytest.approx(0.00114, rel=0.01)
    assert errors["lossless", 1e-3] < 1e-4
    periods = np.array([4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4])
    for method, order in (("implicit", 1), ("compensated", 1), ("lossless", 2)):
        found = np.polyfit(np.log(periods), np.log([errors[method, p] for p in periods]), 1)[0]
        assert found == pytest.approx(order, abs=0.16 if order == 1 else 0.02)


def test_default_couplings_are_rendered_ten_times_better_than_by_implicit(tmp_path: Path) -> None:
    scene = scene_of(FREE_MASS.format(mass=0.1), tmp_path)
    t: Array = T * np.arange(1, 2001, dtype=np.float64)
    path = np.zeros((t.size, 3))
    path[:, 0] = 0.02 * np.sin(2 * np.pi * 2.0 * t)
    errors = {}
    for method in ("implicit", "lossless"):
        asked = default_coupling(SimulatedDevice().info, T, method=METHODS[method])
        rows, _ = led(scene, method, asked, path, T)
        felt = response_from_rest(t, asked.stiffness, asked.damping, 0.1)
        errors[method] = float(np.sqrt(np.mean((rows["tool_position"][:, 0] - felt) ** 2)))
    assert 10 * errors["lossless"] < errors["implicit"]


@pytest.mark.parametrize(
    ("name", "away", "turned", "lost"),
    [
        ("spun", 2e-5, 2e-4, 3.4),
        ("arm", 1e-5, 2e-4, 3.9),
        # the spring of a joint is MuJoCo's own, implicit: what it loses falls with T alone
        ("arm in gravity with a spring", 2e-5, 2e-4, 2.06),
    ],
)
def test_turning_tool_and_arm_are_followed_to_second_order(
    name: str, away: float, turned: float, lost: float, tmp_path: Path
) -> None:
    # in m and rad; how many times less energy is lost at half the step
    asked = Coupling(1000.0, 5.0, 0.0, 0.0)
    xml = ARM.format(gravity=0, spring=0) if name == "arm" else ARM.format(gravity=-9.81, spring=2)
    if name == "spun":
        asked, xml = Coupling(1000.0, 5.0, 5.0, 0.02), SPUN
    scene = scene_of(xml, tmp_path)

    def run(method: str, period: float) -> np.ndarray:
        path = circling(period, 3.0 if name == "spun" else 4.0)
        t = period * np.arange(1, len(path) + 1)
        spin = Rotation.from_rotvec(t[:, None] * np.array([30.0, 0.0, 40.0]))
        turn = spin.as_quat(scalar_first=True) if name == "spun" else None
        return led(scene, method, asked, path, period, turn)[0]

    reference = run("lossless", T / 32)
    coarse, fine = run("lossless", T), run("lossless", T / 2)
    errors = distance(coarse, reference)
    assert errors[0] < away
    assert errors[1] < turned
    assert errors[0] / distance(fine, reference)[0] == pytest.approx(4.0, abs=0.6)
    assert distance(run("implicit", T), reference)[0] > 50 * errors[0]
    # what it creates is given back at once: from the first tick on it never exceeds the start
    assert coarse["environment_energy"].max() <= 1e-9
    loss, less = (-rows["environment_energy"].min() for rows in (coarse, fine))
    assert loss / less == pytest.approx(lost, abs=0.15)


def test_energy_that_turning_creates_is_given_back(tmp_path: Path) -> None:
    # without a rotational coupling nothing damps the spin: without giving back, Σ E_k is +1e-4 J
    scene = scene_of(SPUN, tmp_path)
    asked = Coupling(1000.0, 5.0, 0.0, 0.0)
    rows, ledger = led(scene, "lossless", asked, circling(T, 3.0), T)
    assert ledger.environment == "strict"
    assert rows["environment_energy"].max() < 1e-12
    # it costs no order: half the step, a quarter of what is lost
    finer, _ = led(scene, "lossless", asked, circling(T / 2, 3.0), T / 2)
    lost = [-part["environment_energy"].min() for part in (rows, finer)]
    assert 0 < lost[1] < lost[0] / 2.5


# --- what is rendered, and what the device needs --------------------------------------------------


def test_damping_used_is_what_the_integration_leaves_and_never_negative() -> None:
    asked = Coupling(1000.0, 5.0, 2.0, 0.0015)
    used = METHODS["compensated"].used(asked, T)
    assert (used.damping, used.rotational_damping) == (4.0, 0.0)
    used = LOSSLESS.used(asked, T)
    assert used.damping == 4.5
    assert used.rotational_damping == pytest.approx(0.0005)
    assert LOSSLESS.rendered(used, T) == asked
    soft = LOSSLESS.used(Coupling(1000.0, 0.1, 2.0, 0.0015), T)
    assert soft.damping == 0.0
    assert LOSSLESS.rendered(soft, T).damping == 0.5  # the least that this K and T can show
    assert METHODS["implicit"].used(asked, T) is asked


@pytest.mark.parametrize(
    ("method", "mass"),
    # an implicit tool yields at Nyquist: there only the wall has this hand as its worst
    [("lossless", 0.01), ("lossless", 0.1), ("lossless", 1e9), ("compensated", 1e9)],
)
@pytest.mark.parametrize("share", [0.97, 1.03])
def test_worst_hand_needs_half_kt_and_the_damping_used(
    method: str, mass: float, share: float, tmp_path: Path
) -> None:
    # at Nyquist a tool of any mass stands still under the midpoint rule; 1e9 kg is a wall
    asked = Coupling(1000.0, 2.0, 1.0, 0.002)
    used = METHODS[method].used(asked, T)
    needed = share * (0.5 * used.stiffness * T + used.damping)
    hand = WorstHand(needed, np.pi / T, T)
    device = SimulatedDevice(damping=needed, hand=hand)
    loop = ClosedLoop(scene_of(FREE_MASS.format(mass=mass), tmp_path))
    knock = np.array([1e-3, 0, 0, 0, 0, 0])
    outcome = loop.run(device, asked, METHODS[method], ticks=2000, knock=knock)
    assert outcome.is_stable == (share > 1)


FLOOR = """
<mujoco>
  <option cone="elliptic" gravity="0 0 -9.81"/>
  <default><geom condim="1" solref="0.002 1" solimp="0.99 0.999 0.0001"/></default>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.01"><joint type="slide" axis="0 0 1"/>
      <geom size="0.01" mass="0.01"/><site name="grip"/></body>
  </worldbody>
</mujoco>"""
"""Ten grams that lie on a floor; free, they would need 7 to 9 % less under the implicit form."""


def stays(loop: ClosedLoop, asked: Coupling, method: str, hand: WorstHand, axis: int) -> bool:
    knock = np.zeros(6)
    knock[axis] = -1e-6  # on the floor its force stays below the weight
    device = SimulatedDevice(damping=hand.damping, hand=hand)
    return loop.run(device, asked, METHODS[method], ticks=2000, knock=knock).is_stable


@pytest.mark.parametrize("method", ["implicit", "compensated", "lossless"])
def test_tool_on_a_floor_needs_half_kt_and_the_damping_used(method: str, tmp_path: Path) -> None:
    asked = Coupling(1000.0, 2.0, 1.0, 0.002)
    used = METHODS[method].used(asked, T)
    loop = ClosedLoop(scene_of(FLOOR, tmp_path))
    for share in (0.98, 1.01):
        hand = WorstHand(share * (0.5 * used.stiffness * T + used.damping), np.pi / T, T)
        assert stays(loop, asked, method, hand, 2) == (share > 1)


@pytest.mark.parametrize("mass", [0.01, 0.1])
def test_free_tool_behind_the_compensated_coupling_needs_what_its_spectrum_says(
    mass: float, tmp_path: Path
) -> None:
    asked = Coupling(1000.0, 2.0, 1.0, 0.002)
    theory = SampledLoop(METHODS["compensated"].used(asked, T), T, mass)
    worst = theory.worst_frequency()
    needed = float(theory.damping_spectrum(worst))
    assert needed < 0.5 * 1.0 + 1.0  # K T/2 + B', which a wall needs
    loop = ClosedLoop(scene_of(FREE_MASS.format(mass=mass), tmp_path))
    for share in (0.97, 1.03):
        hand = WorstHand(share * needed, worst, T, complex(theory.response(worst)))
        assert stays(loop, asked, "compensated", hand, 0) == (share > 1)


# --- contact --------------------------------------------------------------------------------------


def test_tool_changes_over_before_it_touches_and_back_after() -> None:
    scene = load_scene("virtual_wall")
    asked = Coupling(2400.0, 1.7, 1.0, 0.002)
    rows, ledger = led(scene, "lossless", asked, tapping(T), T)
    is_free = (rows["flags"] & int(TickFlag.MIDPOINT)) != 0
    touches = (rows["flags"] & int(TickFlag.CONTACT)) != 0
    assert touches.any()
    assert not (is_free & touches).any()
    assert (is_free.sum(), np.abs(np.diff(is_free.astype(int))).sum()) == (
        pytest.approx(1055, abs=100),
        9,  # away from the start, and to and from each of four taps
    )
    assert ledger.environment == "strict"
    # the wrench steps no more than the implicit one does
    other, _ = led(scene, "implicit", asked, tapping(T), T)
    step, others = (np.abs(np.diff(r["wrench_on_tool"][:, 0])).max() for r in (rows, other))
    assert step <= others


@pytest.mark.parametrize(
    ("frequency", "same_felt", "same_device"),
    # slow taps stay near for longer, where both are implicit: at the same B a third is not reached
    [(4.0, 0.31, 0.14), (1.0, 0.50, 0.20)],
)
def test_touch_and_go_errs_by_a_share_of_implicit(
    frequency: float, same_felt: float, same_device: float
) -> None:
    scene = load_scene("virtual_wall")

    def error(method: str, asked: Coupling) -> float:
        coarse, fine = (
            led(scene, method, asked, tapping(period, frequency)[: round(1 / period)], period)[0]
            for period in (T, T / 32)
        )
        return distance(coarse, fine)[0]

    felt = Coupling(2400.0, 1.7, 1.0, 0.002)
    lossless = error("lossless", felt)
    assert lossless / error("implicit", felt) == pytest.approx(same_felt, rel=0.05)
    # with the same B', so that both need the same device
    assert lossless / error("implicit", LOSSLESS.used(felt, T)) == pytest.approx(
        same_device, rel=0.05
    )


def test_joint_friction_and_constraints_keep_a_tool_implicit() -> None:
    asked = Coupling(2400.0, 1.7, 1.0, 0.002)
    path = circling(T, 2.0, 0.2)
    rows, _ = led(load_scene("drawer"), "lossless", asked, path, T)
    assert not (rows["flags"] & int(TickFlag.MIDPOINT)).any()
    other, _ = led(load_scene("drawer"), "compensated", replace_damping(asked), path, T)
    assert np.array_equal(rows["wrench_on_tool"], other["wrench_on_tool"])


def replace_damping(asked: Coupling) -> Coupling:
    """What ``compensated`` must be asked for to use the gains that ``lossless`` uses."""
    return METHODS["compensated"].rendered(LOSSLESS.used(asked, T), T)


# --- records, audit -------------------------------------------------------------------------------


def test_recording_is_simulated_again_bit_for_bit_and_its_law_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with hb.Bridge(
        "peg_in_hole", method="lossless", clock=hb.SimulatedClock(), recording=path
    ) as bridge:
        summary = bridge.run(duration=4.0)
    assert summary.environment == "strict"
    assert summary.is_certified
    report = hb.audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")
    ticks = hb.read_recording(path).ticks
    is_free = (ticks["flags"] & int(TickFlag.MIDPOINT)) != 0
    assert is_free.any()
    assert not is_free.all()


def test_substeps_are_refused() -> None:
    # before anything is said of a coupling that there will not be
    with pytest.raises(HapticBridgeError, match="substeps is 2; a lossless coupling"):
        hb.Bridge("point_mass", method="lossless", substeps=2)
