"""Springs and dampers of the tool beside a lossless coupling: order, energy, and what may not."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from closed_forms import swing_from_rest
from kernel_runs import Array, T, at_rest, load, samples_of
from random_hands import random_motion
from test_kernel_lossless import OUT_AND_BACK, SLIDER, STOP, bound, circling, distance, led

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import METHODS
from hapticbridge.device.trajectory import pose_at
from hapticbridge.kernel.codes import HALF_DONE, OK
from hapticbridge.kernel.record import TICK_DTYPE, TickFlag
from hapticbridge.kernel.tick import answer_step, before_step, close_tick, simulate
from hapticbridge.run.summary import coarse_spring

ASKED = Coupling(1000.0, 5.0, 1.0, 0.005)

KILOGRAM = SLIDER.replace('mass="0.1"', 'mass="1"')
FIXED = '<tendon><fixed {}><joint joint="rail" coef="1"/></fixed></tendon>'

ON_RAILS = {
    "a joint's spring": ('stiffness="500"', "", (500.0, 0.0)),
    "a joint's damper": ('damping="5"', "", (0.0, 5.0)),
    "a joint's spring and damper": ('stiffness="500" damping="5"', "", (500.0, 5.0)),
    "a tendon's spring": ("", FIXED.format('stiffness="500"'), (500.0, 0.0)),
    "a tendon's spring and damper": (
        "",
        FIXED.format('stiffness="500" damping="5"'),
        (500.0, 5.0),
    ),
}

HUNG = """
<mujoco>
  <option gravity="0 0 {gravity}"/>
  <worldbody>
    <site name="anchor" pos="-0.05 0.08 0"/>
    <body name="tool"><freejoint/>
      <geom type="box" size="0.01 0.02 0.03" mass="1" contype="0" conaffinity="0"/>
      <site name="grip" pos="0 0 0.02"/></body>
    {more}
  </worldbody>
  <tendon><spatial {tendon}><site site="anchor"/><site site="grip"/></spatial></tendon>
</mujoco>"""
SPRING = 'stiffness="500" springlength="0.05"'

BALL = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool"><joint type="ball" {}/>
      <geom type="box" size="0.01 0.02 0.03" pos="0.05 0.02 0" mass="1" contype="0"
        conaffinity="0"/><site name="grip" pos="0.1 0 0"/></body>
  </worldbody>
</mujoco>"""

PAIR = """
<mujoco>
  <worldbody>
    <body name="tool"><freejoint/>
      <geom size="0.02" mass="0.2" contype="0" conaffinity="0"/><site name="grip"/></body>
    <body pos="0 0 -0.2"><freejoint/>
      <geom size="0.02" mass="0.1" contype="0" conaffinity="0"/><site name="other"/></body>
  </worldbody>
  <tendon><spatial stiffness="80" damping="0.5" springlength="0.1"><site site="grip"/>
    <site site="other"/></spatial></tendon>
</mujoco>"""

TURNING = {
    "a tendon's spring": HUNG.format(gravity=0, more="", tendon=SPRING),
    "a tendon's damper": HUNG.format(gravity=-9.81, more="", tendon=SPRING + ' damping="5"'),
    "a ball joint's spring": BALL.format('stiffness="5"'),
    "a ball joint's spring and damper": BALL.format('stiffness="5" damping="0.02"'),
    "a spring that stiffens": KILOGRAM.format(joint='stiffness="300 0 1e6"', more=""),
    "a damper that stiffens": KILOGRAM.format(joint='damping="3 20"', more=""),
    "a spring to another body": PAIR,
}


@pytest.mark.parametrize("name", sorted(ON_RAILS))
def test_a_sprung_mass_follows_its_closed_form_to_second_order(name: str) -> None:
    joint, more, constants = ON_RAILS[name]
    scene, errors = load(KILOGRAM.format(joint=joint, more=more)), []
    for period in (4e-3, 2e-3, 1e-3, 5e-4):
        t: Array = period * np.arange(1, round(1.0 / period) + 1, dtype=np.float64)
        path = np.zeros((t.size, 3))
        path[:, 0] = 0.02 * np.sin(4 * np.pi * t)
        rows, ledger = led(scene, "lossless", ASKED, path, period)
        assert ledger.environment == "strict"
        error = rows["tool_position"][:, 0] / 0.02 - swing_from_rest(t, ASKED, 1.0, constants)
        errors.append(float(np.sqrt(np.mean(error**2))))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx(2.0, abs=0.05)  # at the end of the step: 0.9 to 1.1
    assert errors[2] < 2e-4  # 5.6e-3 with the spring at the end of the step


@pytest.mark.parametrize("name", sorted(TURNING))
def test_springs_with_turning_lever_arms_are_followed_to_second_order(name: str) -> None:
    scene = load(TURNING[name])

    def run(period: float) -> np.ndarray:
        return led(scene, "lossless", ASKED, circling(period, 2.0, 0.5), period)[0]

    reference = run(T / 32)
    errors = [distance(run(period), reference)[0] for period in (2 * T, T, T / 2)]
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.3)
    assert errors[1] / errors[2] == pytest.approx(4.0, abs=0.3)


STRICT = {
    "a joint's spring": SLIDER.format(joint='stiffness="500"', more=""),
    "a tendon's spring": TURNING["a tendon's spring"].replace('mass="1"', 'mass="0.05"'),
    "a spring that stiffens": SLIDER.format(joint='stiffness="0 0 5e6"', more=""),
    "a spring to another body": PAIR,
}


@pytest.mark.parametrize("name", sorted(STRICT))
def test_a_sprung_tool_creates_nothing_in_ten_random_hands(name: str) -> None:
    scene = load(STRICT[name])
    for seed in range(10):
        motion, path, cursor = random_motion(seed, 2.0), np.zeros((2000, 3)), 0
        for k in range(len(path)):
            cursor, path[k], _ = pose_at(motion.table, T * (k + 1), cursor)
        rows, ledger = led(scene, "lossless", Coupling(2400.0, 3.0, 2.4, 0.003), path, T)
        assert ledger.environment == "strict", seed
        assert (rows["flags"][1:] & int(TickFlag.MIDPOINT)).all()


def test_a_position_stage_ahead_of_the_sample_changes_no_bit_of_a_sprung_tool() -> None:
    # free, at a stop, and free again: in the stop the springs are MuJoCo's own
    xml = SLIDER.format(
        joint=f'limited="true" range="-1 {STOP}" stiffness="100" damping="0.3"',
        more=FIXED.format('stiffness="50" damping="0.2"'),
    )
    scene = load(xml)
    path = np.zeros((OUT_AND_BACK.size, 3))
    path[:, 0] = OUT_AND_BACK
    samples, plain = samples_of(path), np.zeros(len(path), TICK_DTYPE)
    binding = bound(scene, "lossless", ASKED, T)
    assert simulate(binding.state, samples, binding.row, plain) == len(path)
    assert np.diff((plain["flags"] & int(TickFlag.MIDPOINT)) != 0).sum() == 3
    binding = bound(scene, "lossless", ASKED, T)
    model, data, ahead, codes = scene.model, scene.data, np.zeros_like(plain), set()
    own = model.jnt_stiffness.copy(), model.tendon_damping.copy()
    for k in range(len(path)):
        code = before_step(binding.state, samples[k : k + 1], binding.row, 0, T)
        codes.add(code)
        (mujoco.mj_step2 if code == HALF_DONE else binding.step)(model, data)
        assert answer_step(binding.state, binding.row, 0) == OK
        mujoco.mj_fwdPosition(model, data)
        assert close_tick(binding.state, binding.row, True) == OK
        ahead[k] = binding.row[0]
        assert np.array_equal(model.jnt_stiffness, own[0])
        assert np.array_equal(model.tendon_damping, own[1])
    assert codes == {OK, HALF_DONE}
    assert ahead.tobytes() == plain.tobytes()


def test_a_step_that_is_broken_off_leaves_the_scenes_own_springs() -> None:
    scene = load(SLIDER.format(joint='stiffness="100" damping="0.3"', more=""))
    binding = bound(scene, "lossless", ASKED, T)
    samples, rows = at_rest(5), np.zeros(5, TICK_DTYPE)
    assert simulate(binding.state, samples, binding.row, rows) == 5
    assert before_step(binding.state, samples[:1], binding.row, 0, T) == OK
    assert (scene.model.jnt_stiffness[0], scene.model.dof_damping[0]) == (25.0, 0.15)
    binding.release()
    assert (scene.model.jnt_stiffness[0], scene.model.dof_damping[0]) == (100.0, 0.3)


COARSE = {
    "slack": HUNG.format(gravity=0, more="", tendon='stiffness="500" springlength="0.08 0.1"'),
    "yields": SLIDER.format(joint='stiffness="500" springyield="2"', more=""),
}


@pytest.mark.parametrize("word", sorted(COARSE))
def test_a_spring_with_a_corner_stays_mujocos_own_and_is_named(word: str) -> None:
    scene = load(COARSE[word])
    path = circling(T, 2.0)
    rows, ledger = led(scene, "lossless", ASKED, path, T)
    assert ledger.environment == "strict"
    assert (rows["flags"][1:] & int(TickFlag.MIDPOINT)).all()
    assert word in coarse_spring(scene.model, scene.grip, METHODS["lossless"])
    assert not coarse_spring(scene.model, scene.grip, METHODS["implicit"])
    if word == "yields":
        return
    # first order, and still nearer to the truth than the implicit method
    reference = led(scene, "lossless", ASKED, circling(T / 16, 2.0), T / 16)[0]
    implicit = led(scene, "implicit", ASKED, path, T)[0]
    assert 4 * distance(rows, reference)[0] < distance(implicit, reference)[0]


@pytest.mark.parametrize("name", sorted(STRICT))
def test_a_spring_without_a_corner_is_not_complained_of(name: str) -> None:
    scene = load(STRICT[name])
    assert not coarse_spring(scene.model, scene.grip, METHODS["lossless"])
