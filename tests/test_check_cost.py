"""Costs are planted: the clocks of the test tell exactly what each stage is made to take."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from hapticbridge.check import cost as costs
from hapticbridge.check.case import samples_of
from hapticbridge.check.cost import Cost, measure_cost
from hapticbridge.coupling import Coupling
from hapticbridge.demand.rehearsal import RunPoint
from hapticbridge.device import Motion
from hapticbridge.errors import SceneError
from hapticbridge.scene import load_scene, scene_path

COUPLING = Coupling(2400, 0.5, 2.4, 5e-4)
MICRO = 1e-6


class PlantedClock:
    """Time that passes only where a test says so."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def spend(self, microseconds: float) -> None:
        self.seconds += microseconds * MICRO

    def mujocos(self) -> float:
        return self.seconds

    def pythons(self) -> int:
        return round(self.seconds * 1e9)


@pytest.fixture
def clock() -> Iterator[PlantedClock]:
    clock = PlantedClock()
    mujoco.set_mjcb_time(clock.mujocos)
    try:
        yield clock
    finally:
        mujoco.set_mjcb_time(None)
        mujoco.set_mjcb_control(None)
        mujoco.set_mjcb_passive(None)
        mujoco.set_mjcb_contactfilter(None)


Plant = Callable[[PlantedClock], None]


def cost_of_wall(
    clock: PlantedClock | None = None, plant: Plant | None = None, wall: str | Path = "virtual_wall"
) -> Cost:
    """Costs of a tool that is pushed 10 mm to a wall, 5 mm beyond, and back: 400 ticks."""
    times, places = [0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.008, 0.015, 0.015, 0.0]
    motion = Motion(times, [(x, 0, 0) for x in places])
    scene = load_scene(wall)
    samples = samples_of(motion, 1e-3)
    if clock is None:
        return measure_cost(scene, samples, RunPoint(COUPLING))
    if plant is not None:
        plant(clock)  # not before: MuJoCo's compiler calls some of it too
    return measure_cost(scene, samples, RunPoint(COUPLING, contact="scene"), clock=clock.pythons)


def changed(cost: Cost) -> dict[str, tuple[float, float]]:
    taken = {name: times for name, times in cost.stages.items() if max(times) > 1e-12}
    return {name: (free / MICRO, contact / MICRO) for name, (free, contact) in taken.items()}


def test_time_that_nothing_takes_is_zero_everywhere(clock: PlantedClock) -> None:
    with np.errstate(divide="ignore"):
        cost = cost_of_wall(clock)
    assert changed(cost) == {}
    assert cost.free.median == cost.contact.p99 == 0.0


def plant_velocity(clock: PlantedClock) -> None:
    mujoco.set_mjcb_passive(lambda _m, _d: clock.spend(7))


def plant_collision(clock: PlantedClock) -> None:
    def filter_(_model: object, _data: object, _one: int, _other: int) -> bool:
        clock.spend(5)
        return False

    mujoco.set_mjcb_contactfilter(filter_)


@pytest.mark.parametrize(
    ("plant", "stage", "microseconds"),
    [(plant_velocity, "velocity", 7.0), (plant_collision, "collision", 5.0)],
)
def test_cost_is_told(clock: PlantedClock, plant: Plant, stage: str, microseconds: float) -> None:
    cost = cost_of_wall(clock, plant)
    ((name, (_, contact)),) = changed(cost).items()
    assert name == stage
    assert contact == pytest.approx(microseconds)
    assert cost.contact.median == pytest.approx(microseconds * MICRO, abs=2e-9)
    assert cost.highest_rate == pytest.approx(costs.TICK_SHARE / cost.all_ticks.p99)
    stages, _ = costs.draw_cost(cost, "wall: what a tick costs").axes
    assert [label.get_text() for label in stages.get_yticklabels()] == [stage, costs.BRIDGE]


def test_200_more_walls_cost_200_more_collisions(clock: PlantedClock, tmp_path: Path) -> None:
    text = scene_path("virtual_wall").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if 'name="wall" class' in line)
    more = "".join(line.replace('"wall" class', f'"wall{k}" class') for k in range(200))
    crowded = tmp_path / "crowded.xml"
    crowded.write_text(text.replace(line, line + more), encoding="utf-8")
    found = changed(cost_of_wall(clock, plant_collision, crowded))
    assert set(found) == {"collision"}
    assert found["collision"][1] == pytest.approx(201 * 5.0)


def test_cost_that_grows_with_contacts_is_found(clock: PlantedClock) -> None:
    def passive(_model: object, data: mujoco.MjData) -> None:
        clock.spend(2 + 3 * data.ncon)

    cost = cost_of_wall(clock, lambda _: mujoco.set_mjcb_passive(passive))
    assert changed(cost)["velocity"] == pytest.approx((2, 5))
    assert cost.free.median == pytest.approx(2e-6, abs=2e-9)
    assert cost.contact.median == pytest.approx(5e-6, abs=2e-9)
    growth = cost.by_contacts
    assert [count for count, _, _ in growth.steps] == [0, 1]
    assert growth.base == pytest.approx(2e-6, abs=2e-9)
    assert growth.per_one == pytest.approx(3e-6, abs=4e-9)
    # condim 1: a row per contact
    assert cost.by_rows.steps == growth.steps


def test_what_the_bridge_adds_to_the_step_is_its_own_line(clock: PlantedClock) -> None:
    calls = [0]

    def pythons() -> int:
        calls[0] += 1  # each reading is 4 µs after the one before
        return 4000 * calls[0]

    scene = load_scene("point_mass")
    motion = Motion([0, 0.2], [(0, 0, 0), (0.01, 0, 0)])
    cost = measure_cost(scene, samples_of(motion, 1e-3), RunPoint(COUPLING), clock=pythons)
    assert changed(cost).keys() == {costs.BRIDGE}
    assert changed(cost)[costs.BRIDGE][0] == pytest.approx(4)
    assert cost.contact.ticks == 0
    assert np.isnan(cost.contact.median)
    assert cost.by_contacts.base is None


def test_stages_and_rest_make_up_the_step_by_mujocos_own_clock() -> None:
    cost = cost_of_wall()
    assert set(cost.stages) == {*costs.STAGES, costs.REST, costs.BRIDGE}
    assert all(min(times) >= 0 for times in cost.stages.values())
    assert cost.free.ticks + cost.contact.ticks == cost.all_ticks.ticks == 401 - 50
    assert 0 < cost.all_ticks.median <= cost.all_ticks.p99


def test_line_of_growth_is_the_planted_one_where_rare_counts_are_left_out() -> None:
    counts = np.repeat([0, 3, 6, 9], [100, 40, 20, 19])
    times = 4e-6 + 0.5e-6 * counts
    times[counts == 9] = 1.0
    growth = costs.growth_of(counts, times)
    assert [step[:2] for step in growth.steps] == [(0, 100), (3, 40), (6, 20)]
    assert growth.base == pytest.approx(4e-6)
    assert growth.per_one == pytest.approx(0.5e-6)
    assert growth.is_measurable


@pytest.mark.parametrize("per_one", [-3.2e-17, 0.0, 2e-9])
def test_a_growth_within_the_noise_is_none(per_one: float) -> None:
    """A falling line would be told as a negative time per row."""
    counts = np.repeat([0, 3, 6], 40)
    assert not costs.growth_of(counts, 4e-6 + per_one * counts).is_measurable


def test_motion_that_ends_in_nothing_finite_is_an_error() -> None:
    scene = load_scene("point_mass")
    samples = samples_of(Motion([0, 0.2], [(0, 0, 0), (0.01, 0, 0)]), 1e-3)
    samples["position"][100] = np.nan
    with pytest.raises(SceneError, match="not finite after tick 100"):
        measure_cost(scene, samples, RunPoint(COUPLING))
