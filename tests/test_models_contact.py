"""The contact setting of peg_in_hole: how far it gives, and how near it comes to a rigid hole."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from model_runs import (
    BOTTOMED_HEIGHT,
    HOME_HEIGHT,
    K_R,
    Array,
    Edit,
    K,
    moved_through,
    scene_with_handle,
)
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation


def without_friction(spec: Any) -> None:
    for geom in spec.geoms:
        geom.condim = 1


def with_default_contact(spec: Any) -> None:
    plain = mujoco.MjSpec().worldbody.add_geom()
    for geom in spec.geoms:
        geom.solref, geom.solimp = plain.solref, plain.solimp


def test_single_contact_gives_by_twelve_micrometres_under_three_newtons() -> None:
    # the peg stands on one corner, its space diagonal upright, on the rim east of the hole
    diagonal = np.array([-0.01, 0.01, -0.03])
    upright, _ = Rotation.align_vectors([[0, 0, -1]], [diagonal / np.linalg.norm(diagonal)])
    vector = tuple(upright.as_rotvec())
    length = float(np.linalg.norm(diagonal))
    above = length - HOME_HEIGHT
    # the coupling carries nothing once the tool rests; it presses with 2.8 N
    press = above - 2.8 / K
    model, data = scene_with_handle("peg_in_hole")
    run = moved_through(
        model,
        data,
        [
            (0.3, (0.02, 0, 0.02), vector),
            (0.3, (0.02, 0, above + 0.002), vector),
            (0.3, (0.02, 0, press), vector),
            (0.4, (0.02, 0, press), vector),
        ],
    )
    assert data.ncon == 1
    wrench = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, wrench)
    assert wrench[0] == pytest.approx(2.8, rel=0.02)
    assert run.deepest[-1] == pytest.approx(12e-6, rel=0.5)


@pytest.mark.parametrize(
    ("edit", "least", "most"), [(None, 5e-6, 25e-6), (with_default_contact, 300e-6, 1e-3)]
)
def test_peg_sinks_into_the_wall_only_with_mujocos_default_contact(
    edit: Edit | None, least: float, most: float
) -> None:
    model, data = scene_with_handle("peg_in_hole", edit)
    run = moved_through(
        model,
        data,
        [(0.8, (0, 0, -0.04), (0, 0, 0)), (0.4, (0.0015, 0, -0.04), (0, 0, 0)),
         (0.6, (0.0015, 0, -0.04), (0, 0, 0))],
    )  # fmt: skip
    assert least < run.deepest[-1] < most
    assert least < run.tool[-1, 0] - 0.0002 < most


def rigid_optimum(handle: Array, vector: Array) -> tuple[Array, Rotation]:
    """Least coupling energy of a rigid, frictionless peg that is inside the hole.

    The part of the peg in the hole is the convex hull of its four lower corners and of the points
    where its long edges cross the mouth, so it is inside exactly if these eight points are.
    """
    corners = np.array([[x, y, -0.03] for x in (-0.01, 0.01) for y in (-0.01, 0.01)])
    along = np.array([0.0, 0.0, 0.06])

    def pose(p: Array) -> tuple[Array, Rotation]:
        # millimetres and hundredths of a radian, so that the optimiser sees numbers near one
        return 1e-3 * p[:3], Rotation.from_rotvec(1e-2 * p[3:])

    def energy(p: Array) -> float:
        x, rotation = pose(p)
        angle = (Rotation.from_rotvec(vector) * rotation.inv()).as_rotvec()
        return float(1e3 * (0.5 * K * ((handle - x) ** 2).sum() + 0.5 * K_R * (angle**2).sum()))

    def room(p: Array) -> Array:
        x, rotation = pose(p)
        low = x + rotation.apply(corners)
        edge = rotation.apply(along)
        mouth = low - np.outer(low[:, 2] / edge[2], edge)
        sides = np.concatenate([low[:, :2], mouth[:, :2]]).ravel()
        return 1e3 * np.concatenate([0.0102 - sides, 0.0102 + sides, low[:, 2] + 0.04])

    guess = np.array([0.0, 0.0, 1e3 * max(handle[2], BOTTOMED_HEIGHT), 0.0, 0.0, 0.0])
    for _ in range(2):
        found = minimize(
            energy, guess, method="SLSQP", constraints={"type": "ineq", "fun": room},
            options={"maxiter": 300, "ftol": 1e-12},
        )  # fmt: skip
        assert found.success
        guess = found.x
    assert room(guess).min() > -1e-6
    return pose(guess)


@pytest.mark.parametrize(
    ("offset", "vector"),
    [
        ((0.002, 0.0, -0.04), (0.0, 0.01, 0.0)),
        ((0.0015, 0.0, -0.04), (0.0, 0.02, 0.0)),
        ((-0.001, 0.001, -0.045), (0.0, -0.04, 0.03)),
        ((0.001, 0.0015, -0.053), (0.02, 0.01, 0.0)),
    ],
    ids=["2 mm, tilted", "1.5 mm, more tilted", "into a corner, turned", "onto the bottom"],
)
def test_settled_frictionless_pose_is_within_20_micrometres_of_the_rigid_optimum(
    offset: tuple[float, float, float], vector: tuple[float, float, float]
) -> None:
    model, data = scene_with_handle("peg_in_hole", without_friction)
    run = moved_through(
        model,
        data,
        [(0.5, (0, 0, offset[2]), (0, 0, 0)), (0.4, offset, vector), (0.8, offset, vector)],
    )
    assert np.abs(data.qvel).max() < 1e-5
    position, rotation = rigid_optimum(run.handle[-1], np.array(vector))
    assert np.linalg.norm(run.tool[-1] - position) < 20e-6
    # contact that gives by 20 µm at the ends of a peg of 60 mm
    assert (run.rotation[-1] * rotation.inv()).magnitude() < 2e-3
    # the coupling really pushed: the peg is not where the handle is
    assert np.linalg.norm(run.handle[-1] - run.tool[-1]) > 5e-4
