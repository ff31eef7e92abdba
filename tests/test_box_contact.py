"""Contact of two boxes against exact distances of polytopes, beside MuJoCo's own function."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hapticbridge.kernel.box_contact import CONE, MAX_POINTS, NEAR
from hapticbridge.kernel.colliders import EXACT_POINTS, bind_colliders, use_exact_points
from hapticbridge.kernel.rigid_contact import MARGIN as REST

Floats = NDArray[np.float64]

MARGIN = 2e-4
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def two_boxes(
    first: Floats, second: Floats, *, ours: bool = True, margin: float = MARGIN
) -> mujoco.MjModel:
    """Returns a fixed box and a free one, with their half-sizes in m."""
    sizes = [" ".join(map(repr, map(float, size))) for size in (first, second)]
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <default><geom type="box" margin="{margin / 2}"/></default>
      <worldbody>
        <geom size="{sizes[0]}"/>
        <body>
          <freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom size="{sizes[1]}"/>
        </body>
      </worldbody></mujoco>""")
    if ours:
        use_exact_points(model)
    return model


class Pair:
    """Two boxes of a model, the second one free."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.sizes = model.geom_size.copy()

    def place(self, position: Floats, turn: Rotation) -> None:
        self.data.qpos[:3] = position
        self.data.qpos[3:] = turn.as_quat(scalar_first=True)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)

    def points(self) -> tuple[Floats, Floats, Floats]:
        """Returns gaps, positions, and normals from the fixed box to the free one."""
        contact = self.data.contact
        return (
            np.array(contact.dist),
            np.array(contact.pos).reshape(-1, 3),
            np.array(contact.frame).reshape(-1, 9)[:, :3],
        )

    def gap(self) -> float:
        """Returns the boxes' distance, or minus their depth of penetration, by least squares and by
        the hull of all differences of their corners."""
        position, rotation = self.data.geom_xpos[1], self.data.geom_xmat[1].reshape(3, 3)
        differences = (
            position + (CORNERS * self.sizes[1]) @ rotation.T - (CORNERS * self.sizes[0])[:, None]
        )
        depth = float(
            ConvexHull(differences.reshape(-1, 3), qhull_options="QJ Pp").equations[:, 3].max()
        )
        if depth <= 0.0:
            return depth
        spread = np.hstack([rotation * self.sizes[1], -np.diag(self.sizes[0])])
        found = lsq_linear(spread, -position, (-1.0, 1.0), method="bvls", tol=1e-14)
        return float(np.linalg.norm(found.fun))


def separating_axes(sizes: Floats, turn: Rotation) -> tuple[Floats, Floats]:
    """Returns the 15 axes that can separate two boxes, and the boxes' reach along them."""
    rotation = turn.as_matrix()
    crossed = np.cross(np.eye(3)[:, None], rotation.T[None]).reshape(-1, 3)
    lengths = np.linalg.norm(crossed, axis=1)
    is_axis = lengths > 1e-6
    axes = np.vstack([np.eye(3), rotation.T, crossed[is_axis] / lengths[is_axis, None]])
    return axes, np.abs(axes) @ sizes[0] + np.abs(axes @ rotation) @ sizes[1]


def turns(seed: int, count: int) -> list[Rotation]:
    """Returns orientations: any, and tilted by up to 10 mrad from parallel faces."""
    random = np.random.default_rng(seed)
    found = list(Rotation.random(count, random))
    for k in range(0, count, 2):
        tilt = Rotation.from_rotvec(random.uniform(-0.01, 0.01, 3))
        yaw = Rotation.from_rotvec([0.0, 0.0, random.uniform(-np.pi, np.pi)])
        found[k] = tilt * yaw
    return found


def separated(
    sizes: Floats, position: Floats, turn: Rotation, direction: Floats, wanted: float
) -> Floats:
    """Moves a position along a direction until the boxes' separation in m is the wanted one.

    The separation is the largest gap along the 15 axes: a lower bound of the distance, and exact
    below 0.
    """
    axes, reach = separating_axes(sizes, turn)
    speed = axes @ direction
    axes, reach, speed = (each[np.abs(speed) > 1e-9] for each in (axes, reach, speed))
    way = (wanted + reach - np.sign(speed) * (axes @ position)) / np.abs(speed)
    return np.asarray(position + way.min() * direction)


def random_pairs(
    seed: int, count: int, wanted: float, *, size: float = 0.04, margin: float = MARGIN
) -> list[Pair]:
    """Returns pairs of boxes of ``size``/8 to ``size`` in m with a separation in m."""
    random = np.random.default_rng(seed)
    found = []
    for turn in turns(seed, count):
        sizes = random.uniform(size / 8, size, (2, 3))
        pair = Pair(two_boxes(*sizes, margin=margin))
        direction = random.normal(size=3)
        direction /= np.linalg.norm(direction)
        pair.place(separated(pair.sizes, np.zeros(3), turn, direction, wanted), turn)
        found.append(pair)
    return found


@pytest.mark.parametrize("wanted", [1.5e-4, 1e-5, 1e-7])
def test_the_smallest_gap_is_the_distance_of_the_boxes(wanted: float) -> None:
    for pair in random_pairs(1, 40, wanted):
        gaps, _, _ = pair.points()
        exact = pair.gap()
        if exact < MARGIN:
            assert gaps.min() == pytest.approx(exact, abs=1e-9)
        else:
            assert gaps.size == 0


@pytest.mark.parametrize("wanted", [-1e-7, -1e-5, -5e-4])
def test_the_smallest_gap_is_at_least_the_depth_of_penetration(wanted: float) -> None:
    for pair in random_pairs(2, 40, wanted):
        gaps, _, _ = pair.points()
        exact = pair.gap()
        # beside the shortest way out a second one may count, of at most twice the depth
        assert 2 * exact - 1.1e-6 <= gaps.min() <= exact + 1e-9


@pytest.mark.parametrize("size", [1e-3, 2e-4, 1e-4, 3e-5])
def test_boxes_smaller_than_their_margin_have_their_own_gap_and_depth(size: float) -> None:
    for wanted in (0.03 * size, 1e-3 * size, -1e-3 * size, -0.03 * size):
        for pair in random_pairs(8, 25, wanted, size=size, margin=2 * REST):
            gaps, positions, normals = pair.points()
            exact = pair.gap()
            assert min(2 * exact, exact) - 1e-3 * size <= gaps.min() <= exact + 1e-9
            assert np.abs(positions).max() < 3 * size
            # a normal along which the boxes are really that far apart
            rotation, place = pair.data.geom_xmat[1].reshape(3, 3), pair.data.geom_xpos[1]
            reach = np.abs(normals) @ pair.sizes[0] + np.abs(normals @ rotation) @ pair.sizes[1]
            assert np.abs(normals @ place - reach - gaps).max() < 2 * CONE * size * np.sqrt(3)


def test_a_normal_is_the_gradient_of_its_gap() -> None:
    step, compared = 1e-8, 0
    for pair in [*random_pairs(3, 30, 2e-5), *random_pairs(4, 30, -2e-5)]:
        gaps, positions, normals = pair.points()
        home, turn = (
            pair.data.qpos[:3].copy(),
            Rotation.from_quat(pair.data.qpos[3:], scalar_first=True),
        )
        for axis in range(6):
            motion = np.eye(6)[axis] * (1.0 if axis < 3 else 50.0)
            pair.place(home + step * motion[:3], Rotation.from_rotvec(step * motion[3:]) * turn)
            later, places, directions = pair.points()
            for gap, position, normal in zip(gaps, positions, normals, strict=True):
                distances = np.linalg.norm(places - position, axis=1)
                distances += np.linalg.norm(directions - normal, axis=1)
                match = int(distances.argmin())
                if distances[match] > 1e-3:
                    continue  # the point ends here
                velocity = motion[:3] + np.cross(motion[3:], position - home)
                assert (later[match] - gap) / step == pytest.approx(normal @ velocity, abs=2e-3)
                compared += 1
    assert compared > 500


def peg_at_edge(seed: int) -> tuple[Floats, list[Rotation]]:
    """Returns a smooth motion of a peg that leans on the edge of a wall beside it."""
    random = np.random.default_rng(seed)
    t = np.arange(1000) * 1e-3
    waves = np.sum(
        [
            random.uniform(0.2, 1.0, (6, 1))
            * np.sin(
                2 * np.pi * random.uniform(0.5, 3.0, (6, 1)) * t + random.uniform(0, 6, (6, 1))
            )
            for _ in range(3)
        ],
        axis=0,
    )
    tilt = np.array([0.02, 0.06, 0.03])[:, None] * waves[3:]
    return np.array([0.0, 0.004, 0.01])[:, None] * waves[:3], [
        Rotation.from_rotvec(v) for v in tilt.T
    ]


def unforeseen_depths(*, ours: bool) -> Floats:
    """Returns for each step of motions, in m, the depth that no point of the step before foresaw.

    The free box moves rigidly from step to step. A point foresees its gap plus its normal's
    component of the motion of the free box's point there. The position along x is such that the
    boxes' exact gap swings by 20 µm about −10 µm.
    """
    found = []
    for seed in (1, 2):
        pair = Pair(
            two_boxes(np.array([0.02, 0.05, 0.03]), np.array([0.01, 0.01, 0.03]), ours=ours)
        )
        path, tilts = peg_at_edge(seed)
        before: tuple[Floats, Rotation, tuple[Floats, Floats, Floats]] | None = None
        for k, turn in enumerate(tilts):
            exact = 2e-5 * np.sin(0.02 * k) - 1e-5
            start = np.array([0.0, path[1, k], 0.03 + path[2, k]])
            position = separated(pair.sizes, start, turn, np.array([1.0, 0.0, 0.0]), exact)
            if before is not None:
                home, past, (gaps, positions, normals) = before
                moved = position + (turn * past.inv()).apply(positions - home) - positions
                foreseen = (gaps + (normals * moved).sum(axis=1)).min(initial=MARGIN)
                found.append(max(-exact, 0.0) - max(-foreseen, 0.0))
            pair.place(position, turn)
            before = position, turn, pair.points()
    return np.maximum(found, 0.0)


def test_no_point_appears_deeper_than_the_motion_of_a_step_explains() -> None:
    ours, stock = unforeseen_depths(ours=True), unforeseen_depths(ours=False)
    assert ours.max() < 5e-7
    assert stock.max() > 1e-5


def test_the_order_of_the_boxes_changes_only_the_sign_of_the_normals() -> None:
    for pair in random_pairs(5, 30, -1e-6):
        gaps, positions, normals = pair.points()
        other = Pair(two_boxes(pair.sizes[1], pair.sizes[0]))
        turn = Rotation.from_quat(pair.data.qpos[3:], scalar_first=True).inv()
        other.place(turn.apply(-pair.data.qpos[:3]), turn)
        swapped_gaps, swapped_positions, swapped_normals = other.points()
        first = np.column_stack([gaps, positions, normals])
        back = turn.inv()
        second = np.column_stack(
            [
                swapped_gaps,
                pair.data.qpos[:3] + back.apply(swapped_positions),
                -back.apply(swapped_normals),
            ]
        )
        assert first.shape == second.shape
        apart = np.abs(first[:, None] - second[None]).max(axis=2)
        assert apart.min(axis=1).max() < NEAR + 1e-9


@pytest.mark.parametrize("yaw", [0.0, 1e-9, 1e-5, 1e-3])
@pytest.mark.parametrize("height", [0.02, 0.02 - 1e-6, 0.02 + 1e-6])
def test_equal_boxes_on_each_other_rest_on_their_corners(yaw: float, height: float) -> None:
    pair = Pair(two_boxes(np.full(3, 0.01), np.full(3, 0.01)))
    pair.place(np.array([0.0, 0.0, height]), Rotation.from_rotvec([0.0, 0.0, yaw]))
    gaps, positions, normals = pair.points()
    assert gaps == pytest.approx(height - 0.02, abs=1e-12)
    assert np.allclose(normals, [0.0, 0.0, 1.0])
    # within 0.1 mm of each corner; turned squares also meet in the middle of their sides
    at_corner = np.abs(positions[:, :2]).min(axis=1) > 0.0099
    assert len({tuple(np.sign(position[:2])) for position in positions[at_corner]}) == 4


def test_crossed_bars_without_a_vertex_on_the_other_meet_in_four_points() -> None:
    pair = Pair(two_boxes(np.array([0.05, 0.01, 0.01]), np.array([0.01, 0.05, 0.01])))
    pair.place(np.array([0.0, 0.0, 0.02 - 1e-6]), Rotation.from_rotvec([CONE / 4, 0.0, 0.0]))
    gaps, positions, _ = pair.points()
    assert {tuple(np.sign(position[:2])) for position in positions} == set(
        product((-1.0, 1.0), repeat=2)
    )
    assert gaps.max() - gaps.min() == pytest.approx(0.02 * np.sin(CONE / 4), rel=1e-3)


@pytest.mark.parametrize(
    "position", [(0.0, 0.0, 0.0), (0.001, 0.0, 0.0), (0.0, 0.0, 0.0099), (0.01, 0.01, 0.01)]
)
def test_boxes_inside_each_other_give_finite_points(position: tuple[float, ...]) -> None:
    for inner in (0.002, 0.01, 0.03):
        for turn in (Rotation.identity(), Rotation.from_rotvec([0.3, 0.2, 0.1])):
            pair = Pair(two_boxes(np.full(3, 0.01), np.full(3, inner)))
            pair.place(np.array(position), turn)
            gaps, positions, normals = pair.points()
            assert 0 < gaps.size <= MAX_POINTS
            assert np.isfinite(positions).all()
            assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)


def test_a_vertex_past_the_middle_of_a_plate_leaves_the_way_it_came() -> None:
    pair = Pair(two_boxes(np.array([0.05, 0.05, 0.0005]), np.full(3, 0.01)))
    pair.place(np.array([0.0, 0.0, 0.0105 - 6e-4]), Rotation.identity())
    gaps, _, normals = pair.points()
    assert gaps == pytest.approx(-6e-4)
    assert np.allclose(normals, [0.0, 0.0, 1.0])


def test_other_models_of_the_process_keep_the_stock_function() -> None:
    first, second = np.array([0.02, 0.05, 0.03]), np.array([0.01, 0.01, 0.03])
    pose = np.array([0.0295, 0.01, 0.02]), Rotation.from_rotvec([0.0, 0.01, 0.02])
    stock = Pair(two_boxes(first, second, ours=False))
    stock.place(*pose)
    alone = stock.points()
    mine = Pair(two_boxes(first, second))
    mine.place(*pose)
    stock.place(*pose)
    for now, then in zip(stock.points(), alone, strict=True):
        assert np.array_equal(now, then)
    assert mine.points()[0].shape != alone[0].shape or not np.array_equal(
        mine.points()[1], alone[1]
    )
    use_exact_points(mine.model, is_used=False)
    mine.place(*pose)
    assert np.array_equal(mine.points()[1], alone[1])


def test_copies_and_the_binary_form_keep_the_choice(tmp_path: Path) -> None:
    model = two_boxes(np.full(3, 0.01), np.full(3, 0.01))
    path = tmp_path / "model.mjb"
    mujoco.mj_saveModel(model, str(path))
    for other in (mujoco.MjModel.from_binary_path(str(path)), model.__copy__()):
        assert other.opt.enableflags & EXACT_POINTS
        assert bind_colliders(other)
    assert not bind_colliders(two_boxes(np.full(3, 0.01), np.full(3, 0.01), ours=False))


def test_threads_find_the_same_points() -> None:
    model = two_boxes(np.array([0.02, 0.05, 0.03]), np.array([0.01, 0.01, 0.03]))

    def rolled(_: int) -> Floats:
        data = mujoco.MjData(model)
        data.qpos[:3] = 0.0, 0.0, 0.0605
        data.qvel[:] = 0.1, 0.0, 0.0, 1.0, 2.0, 3.0
        for _ in range(300):
            mujoco.mj_step(model, data)
        return np.array(data.qpos)

    with ThreadPoolExecutor(2) as pool:
        results = list(pool.map(rolled, range(4)))
    assert all(np.array_equal(result, results[0]) for result in results)
