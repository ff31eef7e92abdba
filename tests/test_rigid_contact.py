"""Rigid contacts: passive by the tank, sharp, with Coulomb's friction, repeated to the bit."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numpy as np
import pytest
from kernel_runs import Array, Run, T, go_on, load, run_of, samples_of, unlimited
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import METHODS, prepare
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.kernel.rigid_contact import STALLED
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import simulate
from hapticbridge.run.description import method_of
from hapticbridge.run.options import BridgeOptions
from hapticbridge.scene import Scene, load_scene

BETA, SPENDABLE = 0.2, 0.9  # of the law, written down anew

OPTION = '<option gravity="0 0 {g}" cone="{cone}"/>'
HEAD = f"""
<mujoco>
  <compiler angle="radian"/>
  {OPTION}
  <default><geom solref="0.002 1" solimp="0.9 0.95 0.001" condim="{{condim}}"
    friction="{{mu}} 0.002 0.002"/></default>
  <worldbody>"""
PEG = (
    HEAD
    + """
    <body name="tool"><freejoint/><geom type="box" size="0.01 0.01 0.03" mass="{mass}"/>
      <site name="grip"/></body>
    <geom type="box" size="0.02 0.05 0.03" pos="0.0302 0 -0.03"/>
    <geom type="box" size="0.02 0.05 0.03" pos="-0.0302 0 -0.03"/>
    <geom type="box" size="0.0102 0.02 0.03" pos="0 0.0302 -0.03"/>
    <geom type="box" size="0.0102 0.02 0.03" pos="0 -0.0302 -0.03"/>
    <geom type="box" size="0.03 0.03 0.005" pos="0 0 -0.065"/>
  </worldbody>
</mujoco>"""
)
BLOCK = (
    HEAD
    + """
    <body name="tool"><freejoint/><geom type="box" size="0.015 0.015 0.01" mass="{mass}"/>
      <site name="grip"/></body>
    <geom type="box" size="0.3 0.1 0.01" pos="0 0 -0.02"/>
  </worldbody>
</mujoco>"""
)
BALL = (
    HEAD
    + """
    <body name="tool"><freejoint/><geom type="sphere" size="0.01" mass="{mass}"/>
      <site name="grip"/></body>
    <geom type="box" size="0.1 0.1 0.01" pos="0 0 -0.02"/>
    <body name="other" pos="0.03 0 0"><freejoint/>
      <geom type="capsule" size="0.01 0.02" euler="1.5708 0 0" mass="0.05"/></body>
  </worldbody>
</mujoco>"""
)
CLUTTER = (
    HEAD.replace("<option", '<option iterations="{n}" ls_iterations="{line}"')
    + """
    <body name="tool" pos="0 0 0.035"><freejoint/>
      <geom type="box" size="0.02 0.02 0.01" mass="{mass}"/><site name="grip"/></body>
    <geom type="box" size="0.3 0.3 0.01" pos="0 0 -0.01"/>
    <body pos="-0.03 0 0.0101"><freejoint/>
      <geom type="box" size="0.01 0.01 0.01" mass="0.05"/></body>
    <body pos="0 0 0.0101"><freejoint/>
      <geom type="box" size="0.01 0.01 0.01" mass="0.05"/></body>
    <body pos="0.03 0 0.0101"><freejoint/>
      <geom type="box" size="0.01 0.01 0.01" mass="0.05"/></body>
  </worldbody>
</mujoco>"""
)
LIFT = (
    HEAD
    + """
    <body name="tool" pos="0 0 0.0105"><freejoint/>
      <geom type="box" size="0.01 0.01 0.01" mass="{mass}"/><site name="grip"/></body>
    <body name="plate" mocap="true" pos="0 0 -0.01"><geom type="box" size="0.1 0.1 0.01"/></body>
    <body pos="0.03 0 0.0101"><freejoint/>
      <geom type="box" size="0.01 0.01 0.01" mass="0.05"/></body>
  </worldbody>
</mujoco>"""
)
WELDED = (
    HEAD
    + """
    <body name="tool" pos="0 0 0.0305"><freejoint/>
      <geom type="box" size="0.01 0.01 0.01" mass="{mass}"/><site name="grip"/></body>
    <body name="plate" mocap="true"/>
    <body name="hand"><freejoint/><geom type="box" size="0.03 0.03 0.02" mass="0.2"/></body>
  </worldbody>
  <equality><weld body1="hand" body2="plate"/></equality>
</mujoco>"""
)
COUPLING = Coupling(2400.0, 0.5, 2.4, 5e-4)


def scene(
    xml: str, *, mass: float = 0.1, mu: float = 0.4, condim: int = 3, g: float = 0.0,
    cone: str = "elliptic",
) -> Scene:  # fmt: skip
    return load(xml.format(mass=mass, mu=mu, condim=condim, g=g, cone=cone))


def prepared(
    loaded: Scene, method: str = "implicit", coupling: Coupling = COUPLING, contact: str = "rigid"
) -> Run:
    """Returns a run without ticks that starts where the scene stands."""
    chosen = METHODS[method].with_contact(contact)
    start = loaded.data.qpos.copy()
    prepare(loaded, coupling, T, 1, chosen, warns=False)
    loaded.data.qpos[:] = start
    mujoco.mj_forward(loaded.model, loaded.data)
    parameters = unlimited(
        loaded,
        chosen.law_coupling(coupling, T),
        scheme=chosen.scheme,
        is_rigid=chosen.is_rigid,
    )
    return run_of(loaded, BoundKernel(loaded.model, loaded.data, parameters), parameters)


def through(run: Run, samples: np.ndarray) -> Run:
    """Runs all ticks in compiled code."""
    run.ticks = np.zeros(len(samples), TICK_DTYPE)
    done = simulate(run.binding.state, samples, run.binding.row, run.ticks)
    assert done == len(samples)
    return run


def jamming(seed: int, count: int = 1500) -> np.ndarray:
    """Returns samples of a random hand that turns and pushes a tool in its hole."""
    generator = np.random.default_rng(seed)
    time = T * np.arange(1, count + 1)

    def wave(amplitude: float) -> Array:
        frequency = generator.uniform(0.3, 6.0, 5)
        weight = generator.uniform(0.2, 1.0, 5) / np.sqrt(frequency)
        phase = generator.uniform(0.0, 2 * np.pi, 5)
        curve = np.sin(2 * np.pi * np.outer(time, frequency) + phase) @ (weight / weight.sum())
        return np.asarray(2 * amplitude * (curve - curve[0]) * np.minimum(time / 0.1, 1.0))

    places = np.stack([wave(0.004) for _ in range(3)], axis=1)
    turns = np.stack([wave(0.08) for _ in range(3)], axis=1)
    return samples_of(places, Rotation.from_rotvec(turns))


def pressed(count: int, force: float, sideways: float = 0.0) -> np.ndarray:
    """Returns samples that press with a force in N, and pull sideways after 0.4 s, in 0.2 s."""
    time = T * np.arange(1, count + 1)
    places = np.zeros((count, 3))
    places[:, 2] = -force / COUPLING.stiffness * np.minimum(time / 0.2, 1.0)
    places[:, 0] = sideways / COUPLING.stiffness * np.clip((time - 0.4) / 0.2, 0.0, 1.0)
    return samples_of(places)


def strict(run: Run) -> bool:
    return int(run.binding.state["energy"]["first_unstrict"][0]) < 0


# The law


@dataclass
class Work:
    """Work of the contacts in each tick, by MuJoCo's own rows; ``tank`` is the one before it."""

    given: list[float]
    bound: list[float]
    tank: list[float]
    depth: list[float]

    def note(self, run: Run, data: mujoco.MjData) -> None:
        tank = float(run.binding.state["contact"]["tank"][0])
        self.tank.append(tank)
        rows = data.efc_type >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
        speed = np.zeros(data.nefc)
        if data.nefc:
            mujoco.mj_mulJacVec(run.scene.model, data, speed, data.qvel)
        self.given.append(float(T * (data.efc_force * speed)[rows].sum()))
        normals = [c.efc_address for c in data.contact if c.efc_address >= 0]
        depth = np.maximum(-data.efc_pos[normals], 0.0)
        wanted = BETA * depth / T
        self.bound.append(float((wanted**2 / (4 * data.efc_R[normals])).sum()))
        self.depth.append(float(depth.max(initial=0.0)))


def measured(run: Run, samples: np.ndarray) -> Work:
    work = Work([], [], [float(run.binding.state["contact"]["tank"][0])], [])
    go_on(run, samples, after_tick=lambda _, data: work.note(run, data))
    return work


@pytest.mark.parametrize("condim", [1, 3, 4, 6])
@pytest.mark.parametrize(("xml", "mass"), [(PEG, 0.03), (BALL, 0.1), (BLOCK, 0.03)])
def test_contacts_give_no_more_than_the_law_and_the_tank_allow(
    xml: str, mass: float, condim: int
) -> None:
    run = prepared(scene(xml, mass=mass, mu=0.3, condim=condim, g=-2.0))
    samples = jamming(condim, 900)
    samples["position"][:, 2] -= 0.002
    work = measured(run, samples)
    given, bound, tank = np.array(work.given), np.array(work.bound), np.array(work.tank)
    assert np.abs(given).max() > 1e-6
    assert max(work.depth) > 1e-8
    assert (given <= bound + 1e-15).all()
    assert (given <= SPENDABLE * np.maximum(tank[:-1], 0.0) + 1e-15).all()
    assert strict(run)


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_a_jammed_peg_is_strict_where_the_contact_of_the_scene_creates_energy(cone: str) -> None:
    stiff = Coupling(6000.0, 0.5, 6.0, 5e-4)
    for seed, mass, mu in ((4, 0.03, 0.0), (5, 0.03, 0.1), (7, 0.1, 0.0), (7, 0.03, 0.4)):
        condim, friction = (1, 1.0) if mu == 0.0 else (3, mu)
        results = {}
        for contact in ("rigid", "scene"):
            peg = scene(PEG, mass=mass, mu=friction, condim=condim, cone=cone)
            results[contact] = through(prepared(peg, "implicit", stiff, contact), jamming(seed))
        assert strict(results["rigid"]), (seed, mass, mu)
        assert not strict(results["scene"]), (seed, mass, mu)


def worst_gradient(run: Run, seed: int) -> float:
    """Returns the largest gradient in m/s² with which the solver ended a tick of a jam."""
    worst = [0.0]

    def note(_: object, data: mujoco.MjData) -> None:
        for island in range(max(data.nisland, 1)):
            if (count := int(data.solver_niter[island])) > 0:
                last = island * mujoco.mjNSOLVER + min(count, mujoco.mjNSOLVER) - 1
                worst.append(float(data.solver.gradient[last]))

    go_on(run, jamming(seed), after_tick=note)
    return max(worst)


@pytest.mark.parametrize("seed", [66, 140])
def test_a_solution_that_does_not_converge_is_replaced_by_one_that_does(seed: int) -> None:
    """Newton's method goes round in circles in these jams."""
    results = {}
    for stalled in (None, np.inf):
        run = prepared(scene(PEG, mass=0.03, mu=1.0), coupling=Coupling(6000.0, 0.5, 6.0, 5e-4))
        if stalled is not None:
            run.binding.state["contact"]["stalled"] = stalled
        own = run.scene.model.opt.solver
        results[stalled] = worst_gradient(run, seed)
        assert run.scene.model.opt.solver == own
        assert strict(run)
    assert results[None] <= STALLED < results[np.inf]


@pytest.mark.parametrize(("iterations", "line_search"), [(100, 10), (3, 50), (3, 5)])
def test_a_file_with_a_hasty_solver_is_solved_as_mujoco_does(
    iterations: int, line_search: int
) -> None:
    xml = CLUTTER.replace("{n}", str(iterations)).replace("{line}", str(line_search))
    results: dict[bool, list[bool]] = {False: [], True: []}
    for is_hasty, seed in product(results, range(4)):
        stiff = Coupling(6000.0, 0.5, 6.0, 5e-4)
        run = prepared(scene(xml, mass=0.05, g=-9.81), coupling=stiff)
        run.binding.state["contact"]["stalled"] = np.inf  # no second solver helps
        if is_hasty:
            option = run.scene.model.opt
            option.iterations, option.ls_iterations = iterations, line_search
        samples = jamming(seed, 800)
        samples["position"][:, 2] -= 0.02 * np.minimum(T * np.arange(800) / 0.1, 1.0)
        results[is_hasty].append(strict(through(run, samples)))
    assert all(results[False])
    assert not all(results[True])


@pytest.mark.parametrize("xml", [LIFT, WELDED])
def test_a_moving_mocap_body_pays_for_its_push_and_gives_nothing_by_receding(xml: str) -> None:
    results: dict[str, list[bool]] = {"rigid": [], "scene": []}
    for contact, stroke in product(results, (0.0005, 0.002, 0.005)):
        run = prepared(scene(xml, mass=0.05, g=-9.81), contact=contact)
        plate = run.scene.model.body("plate").mocapid[0]
        start = run.scene.data.mocap_pos[plate].copy()

        def move(
            k: int,
            data: mujoco.MjData,
            plate: int = plate,
            start: Array = start,
            by: float = stroke,
        ) -> None:
            sideways = by * (np.cos(k / 15) - 1.0)
            data.mocap_pos[plate] = start + np.array([sideways, 0.0, by * np.sin(k / 15)])

        samples = jamming(1, 800)
        samples["position"][:, 2] -= 0.002 * np.minimum(T * np.arange(800) / 0.1, 1.0)
        results[contact].append(strict(go_on(run, samples, on_tick=move)))
    assert all(results["rigid"])
    assert not results["scene"][-1]


def test_the_tank_is_filled_by_what_was_dissipated_up_to_its_cap() -> None:
    run = through(prepared(scene(PEG, mass=0.1)), jamming(5))
    created = np.concatenate([[0.0], run.ticks["environment_energy"]])
    tank = run.ticks["contact_tank"]
    cap = 0.5 * COUPLING.stiffness * 1e-3**2
    level, expected = 0.0, []
    for change in np.diff(created):
        level = min(level - change, cap)
        expected.append(level)
    assert tank == pytest.approx(np.array(expected), abs=1e-12)
    assert tank.max() == cap
    assert (tank <= -run.ticks["environment_energy"] + 1e-15).all()


def sunken(tank: float, cap: float, depth: float = 1e-3) -> Run:
    """Returns a run whose tool stands inside the floor, with a tank of this energy."""
    block = scene(BLOCK, mass=0.1)
    block.data.qpos[2] = -depth
    run = prepared(block)
    run.binding.state["contact"]["tank"] = tank
    run.binding.state["contact"]["cap"] = cap
    return run


def test_with_an_empty_tank_a_contact_holds_and_opens_but_never_pushes_out() -> None:
    run = go_on(sunken(0.0, 0.0), pressed(400, 3.0))
    height = run.ticks["tool_position"][:, 2]
    assert height.min() > -1.01e-3
    assert np.diff(height).max() <= 1e-12
    assert strict(run)
    lifted = np.zeros((600, 3))
    lifted[:, 2] = 0.004
    go_on(run, samples_of(lifted))
    assert run.ticks["tool_position"][-1, 2] > 1e-3


def test_a_full_tank_pushes_out_and_pays_for_it() -> None:
    run = go_on(sunken(4e-3, 4e-3), pressed(400, 1.0))
    assert run.ticks["tool_position"][-1, 2] > -2e-6
    spent = 4e-3 - run.ticks["contact_tank"].min()
    assert 0.0 < run.ticks["environment_energy"].max() <= spent + 1e-12 <= 4e-3


def test_without_the_tank_a_contact_creates_energy() -> None:
    run = go_on(sunken(1e3, 1e3), pressed(400, 3.0))
    assert not strict(run)


RAILS = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0"/>
  <default><joint limited="true" range="-0.004 0.003" solreflimit="-1000000 -500"
    solimplimit="0.9 0.95 0.001"/><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="tool">
    <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
    <joint type="slide" axis="0 0 1"/><joint axis="1 0 0" range="-0.02 0.03"/>
    <joint axis="0 1 0" range="-0.02 0.03"/><joint axis="0 0 1" range="-0.02 0.03"/>
    <geom type="box" size="0.01 0.01 0.03" mass="0.01"/><site name="grip"/></body></worldbody>
</mujoco>"""


def test_limits_of_joints_are_as_rigid_and_strict_as_contacts() -> None:
    stiff = Coupling(6000.0, 0.5, 0.6, 5e-5)
    runs = {}
    for contact in ("rigid", "scene"):
        loaded = load(RAILS)
        own = loaded.model.jnt_solref.copy(), loaded.model.jnt_solimp.copy()
        samples = jamming(1)
        samples["position"] *= 2.0
        runs[contact] = through(prepared(loaded, "implicit", stiff, contact), samples)
        assert (loaded.model.jnt_solref == own[0]).all()
        assert (loaded.model.jnt_solimp == own[1]).all()
    assert strict(runs["rigid"])
    assert not strict(runs["scene"])
    settled = load(RAILS)
    run = through(prepared(settled), pressed(1000, 15.0))
    assert run.ticks["tool_position"][-1, 2] == pytest.approx(-0.004, abs=2e-6)


SWIVEL = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody><body name="tool"><joint type="ball" limited="true" range="0 5"/>
    <geom type="box" size="0.01 0.01 0.02" mass="0.05"/><site name="grip"/></body></worldbody>
</mujoco>"""
LEASH = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody><body name="tool"><freejoint/><geom type="box" size="0.01 0.01 0.02" mass="0.01"/>
    <site name="grip"/></body><site name="hook" pos="0 0 0.1"/></worldbody>
  <tendon><spatial limited="true" range="0 0.104"><site site="grip"/><site site="hook"/></spatial>
  </tendon>
</mujoco>"""


@pytest.mark.parametrize("method", ["implicit", "lossless"])
@pytest.mark.parametrize("speed", [0.05, 0.3, 1.0])
def test_a_fast_blow_on_a_limit_is_met_before_it_is_passed(speed: float, method: str) -> None:
    way = np.minimum(speed * T * np.arange(300), 0.02)
    places, still = np.zeros((300, 3)), np.zeros((300, 3))
    places[:, 2] = -way
    turned = Rotation.from_rotvec(np.stack([20.0 * way, still[:, 0], still[:, 0]], axis=1))
    coupling = Coupling(2400.0, 0.5, 0.6, 5e-5)
    for xml in (RAILS.replace("-1000000 -500", "0.002 1"), LEASH):  # without a bounce
        run = through(prepared(load(xml), method, coupling), samples_of(places))
        passed = -0.004 - run.ticks["tool_position"][:, 2].min()
        # 38 N press a tool of 10 g
        assert 0.0 < passed < 10e-6, xml
        assert strict(run)
    run = through(prepared(load(SWIVEL), method, coupling), samples_of(still, turned))
    passed = 2.0 * np.arccos(run.ticks["tool_quaternion"][:, 0].min()) - np.deg2rad(5.0)
    assert 0.0 < passed < 1e-4
    assert strict(run)


@pytest.mark.parametrize("start", [0.0, 1e-4, 5e-4])
def test_a_leash_lets_its_ends_meet(start: float) -> None:
    xml = LEASH.replace('pos="0 0 0.1"', f'pos="0 {start} 0.01"')
    places = np.zeros((300, 3))
    places[:, 2] = np.minimum(0.1 * T * np.arange(300), 0.02)
    runs = [
        through(prepared(load(text)), samples_of(places))
        for text in (xml, xml.replace('limited="true"', 'limited="false"'))
    ]
    heights = [run.ticks["tool_position"][:, 2] for run in runs]
    assert heights[0][-1] == pytest.approx(0.02, abs=1e-4)
    assert np.abs(heights[0] - heights[1]).max() < 1e-9


COUPLED = """
<mujoco>
  <option gravity="0 0 0"/>
  <default><geom type="box" size="0.01 0.01 0.01" mass="0.05" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body name="tool"><joint type="slide" axis="1 0 0"/><joint axis="0 0 1"/><geom/>
      <site name="grip" pos="0.01 0 0"/></body>
    <body name="other" pos="0 0.04 0"><joint type="slide" axis="1 0 0"/><joint axis="0 0 1"/><geom/>
    </body>
  </worldbody>
  <equality>{equality}</equality>
</mujoco>"""


@pytest.mark.parametrize(
    "equality",
    [
        '<weld body1="tool" body2="other"/>',
        '<connect body1="tool" body2="other" anchor="0 0.04 0"/>',
    ],
)
def test_bodies_that_turn_at_a_dead_point_of_their_constraint_gain_no_energy(equality: str) -> None:
    """MuJoCo adds −J̇v to these rows, which would give energy where J is near zero."""
    for seed in (1, 2, 3):
        for method in ("implicit", "lossless"):
            loaded = load(COUPLED.format(equality=equality))
            samples = jamming(seed)
            samples["position"] *= 4.0
            run = through(prepared(loaded, method, Coupling(1000.0, 0.5, 1.0, 5e-4)), samples)
            assert strict(run), (seed, method)


# Sharpness


def test_a_pressed_tool_settles_within_a_micrometre() -> None:
    for mass in (0.03, 0.3):
        run = through(prepared(scene(BALL, mass=mass, mu=0.4)), pressed(1000, 3.0))
        assert -1e-6 < run.ticks["tool_position"][-1, 2] < 0.0


def test_a_lifted_tool_is_released_within_10_ms() -> None:
    samples = pressed(1000, 20.0)
    samples["position"][800:, 2] = 0.002
    run = through(prepared(scene(BALL)), samples)
    opened = np.flatnonzero(run.ticks["tool_position"][800:, 2] > 0.0)
    assert opened[0] <= 10


ALONE = re.sub(r'<body name="other".*?</body>', "", BALL, flags=re.DOTALL)


def blow(
    start: float,
    velocity: tuple[float, float, float],
    mass: float = 0.1,
    force: float = 0.0,
    xml: str = BALL,
) -> Array:
    """Returns the penetration in m per tick of a ball in a blow; negative is a gap.

    ``start`` is the ball's height in m above the floor; along x it meets a capsule at height 0. The
    hand presses with up to 0.3 of ``force`` in N.
    """
    loaded = scene(xml, mass=mass, mu=0.4)
    loaded.data.qpos[2] = start
    loaded.data.qvel[:3] = velocity
    speed = loaded.data.qvel.copy()
    run = prepared(loaded)
    loaded.data.qvel[:] = speed
    # motion of the start, not energy that the scene created
    run.binding.state["energy"]["start_energy"] += 0.5 * mass * np.sum(speed[:3] ** 2)
    depths: list[float] = []

    def note(_: int, data: mujoco.MjData) -> None:
        depths.append(-min((c.dist for c in data.contact), default=1.0))

    go_on(run, pressed(60, force), after_tick=note)
    return np.array(depths)


@pytest.mark.parametrize("speed", [0.3, 1.0, 4.0])
def test_a_fast_blow_is_met_before_it_sinks_in(speed: float) -> None:
    depths = blow(2.4e-3 * speed, (0.0, 0.0, -speed), xml=ALONE)
    assert -1e-5 < depths.max() < 2e-6


@pytest.mark.parametrize(
    ("flag", "geom"),
    [("", 'gap="-0.0005"'), ("", 'margin="-0.002" gap="-0.001"'), ('override="enable"', "")],
)
def test_a_blow_is_met_whatever_margins_and_gaps_the_file_has(flag: str, geom: str) -> None:
    xml = ALONE.replace('cone="{cone}"/>', f'cone="{{cone}}"><flag {flag}/></option>')
    depths = blow(0.0024, (0.0, 0.0, -1.0), xml=xml.replace("<geom solref", f"<geom {geom} solref"))
    assert -1e-5 < depths.max() < 2e-6


@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_a_fast_blow_on_a_free_body_is_met_before_it_sinks_in(speed: float) -> None:
    assert blow(0.0, (speed, 0.0, 0.0)).max() < 0.01 * speed * T  # what the softness leaves


def test_a_blow_beyond_the_largest_margin_is_seen_late() -> None:
    assert blow(0.023, (0.0, 0.0, -8.0), mass=1.0).max() > 2e-4


def test_an_oblique_blow_neither_sinks_in_where_it_sticks_nor_floats_where_it_slides() -> None:
    sticking = blow(0.003, (0.1, 0.0, -0.3))
    assert -2e-5 < sticking.max() < 2e-6
    sliding = blow(0.0, (1.0, 0.0, 0.0), mass=30.0, force=30.0)[:25]  # then it meets the capsule
    assert np.abs(sliding[-10:]).max() < 1e-5


@pytest.mark.parametrize("sideways", [-0.6, -0.3, 0.3, 0.6])
@pytest.mark.parametrize("tilt", [0.3, 0.8, 1.2])
def test_a_corner_that_stops_sliding_in_a_blow_does_not_sink_in(
    sideways: float, tilt: float
) -> None:
    loaded, turn = scene(BLOCK), Rotation.from_euler("y", tilt)
    corners = np.array(list(product((-1, 1), repeat=3))) * [0.015, 0.015, 0.01]
    loaded.data.qpos[2] = -0.01 - turn.apply(corners)[:, 2].min() + 8e-4
    loaded.data.qpos[3:] = turn.as_quat(scalar_first=True)
    loaded.data.qvel[:3] = sideways, 0.0, -0.3
    speed = loaded.data.qvel.copy()
    run = prepared(loaded)
    loaded.data.qvel[:] = speed
    depths: list[float] = []

    def note(_: int, data: mujoco.MjData) -> None:
        lowest = data.geom_xpos[1] + corners @ data.geom_xmat[1].reshape(3, 3).T
        depths.append(-0.01 - lowest[:, 2].min())

    go_on(run, pressed(25, 0.0), after_tick=note)
    assert -1e-5 < max(depths) < 2.5e-5


@pytest.mark.parametrize("mu", [0.1, 0.4])
def test_friction_breaks_away_at_coulombs_limit_and_slides_at_it(mu: float) -> None:
    samples = pressed(6000, 3.0)
    samples["position"][:, 0] = 2e-4 * np.maximum(T * np.arange(6000) - 0.4, 0.0)
    run = through(prepared(scene(BLOCK, mu=mu)), samples)
    force = -run.ticks["wrench_on_tool"][:, [0, 2]] * [-1.0, 1.0]
    ratio = force[400:, 0] / force[400:, 1]
    held = ratio[np.abs(run.ticks["tool_position"][400:, 0]) < 1e-6]
    assert held.max() == pytest.approx(mu, rel=0.01)
    assert np.median(ratio[-500:]) == pytest.approx(mu, rel=0.01)


def test_below_the_limit_friction_creeps_by_less_than_10_nm_a_second() -> None:
    for contact, least, most in (("rigid", 0.0, 10e-9), ("scene", 1e-6, 1.0)):
        block = scene(BLOCK, mu=0.4)
        run = through(prepared(block, contact=contact), pressed(2600, 3.0, 0.5 * 0.4 * 3.0))
        creep = abs(run.ticks["tool_position"][-1, 0] - run.ticks["tool_position"][-1001, 0])
        assert least <= creep < most


# Equal in every repetition


def drumming(count: int) -> np.ndarray:
    """Returns samples of a hand that drums on the floor at 20 Hz."""
    time = T * np.arange(1, count + 1)
    places, turns = np.zeros((count, 3)), np.zeros((count, 3))
    places[:, 0] = 0.004 * np.sin(2 * np.pi * 1.3 * time)
    places[:, 2] = 0.02 * np.sin(2 * np.pi * 20 * time) * np.minimum(time / 0.1, 1.0) - 0.01
    turns[:, 1] = 0.1 * np.sin(9 * time)
    return samples_of(places, Rotation.from_rotvec(turns))


@pytest.mark.parametrize("method", ["implicit", "compensated", "lossless"])
def test_compiled_ticks_equal_those_through_mujocos_bindings(method: str) -> None:
    samples = drumming(600)

    def sunken_block() -> Run:
        block = scene(BLOCK, mass=0.03, mu=0.1)
        block.data.qpos[2] = -3e-4
        run = prepared(block, method)
        run.binding.state["contact"]["cap"] = 1e-6  # too little for the way out
        return run

    one, other = go_on(sunken_block(), samples), through(sunken_block(), samples)
    assert one.ticks.tobytes() == other.ticks.tobytes()
    assert int(one.binding.state["contact"]["repetitions"][0]) > 0
    assert strict(one)


@pytest.mark.parametrize("level", [0.5, 5.0])
def test_a_force_limit_and_a_tank_hold_together(level: float) -> None:
    run = prepared(scene(PEG, mass=0.03, mu=0.1))
    run.parameters = replace(run.parameters, force_limit=level, torque_limit=0.05)
    run.binding = BoundKernel(run.scene.model, run.scene.data, run.parameters)
    work = measured(run, jamming(2, 900))
    force = np.linalg.norm(run.ticks["wrench_on_tool"][:, :3], axis=1)
    assert force.max() == pytest.approx(level)
    assert (work.given <= SPENDABLE * np.maximum(work.tank[:-1], 0.0) + 1e-15).all()
    assert strict(run)


# The option


def test_contact_of_the_scene_restores_what_rigid_contact_changed() -> None:
    loaded = scene(PEG, cone="pyramidal")
    fields = ("geom_margin", "pair_margin", "flex_margin", "body_margin")
    before = [getattr(loaded.model, name).copy() for name in fields]
    own = loaded.model.opt.cone, loaded.model.opt.impratio, loaded.model.opt.o_margin
    prepared(loaded)
    assert loaded.model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert (loaded.model.geom_margin > 0).all()
    resting = loaded.model.geom_margin.copy()
    run = go_on(prepared(loaded), drumming(300))
    assert loaded.model.geom_margin.max() > resting.max()
    assert (loaded.model.body_margin >= loaded.model.geom_margin.max()).any()
    run.binding.release()
    assert (loaded.model.geom_margin == resting).all()
    prepared(loaded, contact="scene")
    after = [getattr(loaded.model, name) for name in fields]
    assert all((a == b).all() for a, b in zip(before, after, strict=True))
    assert own == (loaded.model.opt.cone, loaded.model.opt.impratio, loaded.model.opt.o_margin)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contact": "soft"}, "contact is 'soft'; it must be one of 'rigid', 'scene'"),
        ({"contact": "rigid", "method": "weld"}, "'weld' has the contacts of the scene"),
        (
            {"contact": "rigid", "method": "explicit:rk4"},
            "one of 'compensated', 'implicit', 'lossless'",
        ),
    ],
)
def test_a_contact_that_a_method_cannot_have_is_refused(
    changes: dict[str, str], message: str
) -> None:
    with pytest.raises(HapticBridgeError, match=re.escape(message)):
        BridgeOptions(**changes)  # type: ignore[arg-type] # names are checked there


def test_methods_for_comparison_have_the_contact_of_the_scene() -> None:
    assert BridgeOptions(method="weld").rendering_method.contact == "scene"
    assert BridgeOptions().rendering_method.contact == "rigid"
    assert method_of({"method": "lossless", "contact": "rigid"}).contact == "rigid"


@pytest.mark.parametrize("name", ["lock", "bench_pliers", "planar_peg"])
def test_a_shipped_scene_starts_at_rest_with_rigid_contacts(name: str) -> None:
    run = prepared(load_scene(name), "lossless")
    through(run, samples_of(np.zeros((300, 3))))
    moved = np.linalg.norm(run.ticks["tool_position"] - run.tool_start[:3], axis=1)
    assert moved.max() < 1e-3
    assert strict(run)
