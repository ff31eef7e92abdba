"""Map ``geometry``: length decides for direct rendering, and not behind the coupling."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from map_runs import boundary_of

from hapticbridge.lab.maps import geometry
from hapticbridge.lab.maps.base import PERIOD, Point
from hapticbridge.scene import load_scene


def test_the_printed_limit_is_its_own_inverse() -> None:
    # THEORY: L = 2 √(b_θ/(T K_c)); 2e-3 N m s/rad, 1 ms and 10 kN/m give 28.28 mm
    assert float(geometry.length_limit(1e4)) == pytest.approx(28.284e-3, rel=1e-4)
    lengths = np.geomspace(*geometry.LENGTH, 7)
    np.testing.assert_allclose(
        geometry.length_limit(geometry.contact_stiffness_limit(lengths)), lengths, rtol=1e-12
    )


@pytest.mark.parametrize("stiffness", [60.0, 1e4, 2e5])
def test_direct_rendering_fails_beyond_the_length_that_theory_gives(stiffness: float) -> None:
    found = geometry.evaluate(
        {"what": "limit", "method": "direct", "length": 0.0, "stiffness": stiffness}
    )
    # 15 % are promised; the search is 0.2 % wide
    assert found["limit"] == pytest.approx(float(geometry.length_limit(stiffness)), rel=5e-3)


@pytest.mark.parametrize("length", [geometry.LENGTH[0], 0.06, geometry.LENGTH[1]])
def test_behind_the_coupling_the_limit_is_that_of_6_at_every_length(length: float) -> None:
    found = geometry.evaluate(
        {"what": "limit", "method": "implicit", "length": length, "stiffness": 0.0}
    )
    # 2 (b_θ − B_r)/T = 3; the peg and its contacts give by 3 %, and the search is 0.2 % wide
    assert 2.99 <= float(found["limit"]) <= 3.1


@pytest.mark.parametrize("length", geometry.LENGTH)
@pytest.mark.parametrize("method", ["compensated", "lossless"])
def test_what_takes_its_lag_off_bears_a_third_more_at_every_length(
    method: str, length: float
) -> None:
    # nothing is left of B_r at 2 b_θ/T = 4; the same give, on the safe side
    assert geometry.is_stable(method, length, 3.98)
    assert not geometry.is_stable(method, length, 4.12)


@pytest.mark.parametrize("stiffness", [0.4, 2.0])
def test_in_its_hole_lossless_is_implicit_with_the_damper_that_it_uses(
    stiffness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = geometry.torque(geometry.run("lossless", 0.1, stiffness))
    damping = max(geometry.ROTATIONAL_DAMPING - stiffness * PERIOD / 2, 0.0)
    assert not np.allclose(
        found, geometry.torque(geometry.run("implicit", 0.1, stiffness)), rtol=1e-3
    )
    monkeypatch.setattr("hapticbridge.lab.maps.geometry.ROTATIONAL_DAMPING", damping)
    np.testing.assert_array_equal(found, geometry.torque(geometry.run("implicit", 0.1, stiffness)))


def test_a_peg_too_long_is_felt_to_grow_from_the_first_ticks_on_and_its_twin_is_not() -> None:
    stiffness = 1e4
    limit = float(geometry.length_limit(stiffness))
    long, short = 1.05 * limit, 0.95 * limit
    grown = geometry.run("direct", long, stiffness)
    # at Nyquist the knock changes sign and grows by K T/b_θ − 1 = 2 · 1.05² − 1 a tick
    assert geometry.first_growth(grown, "direct", long, stiffness) == 1
    ratio = geometry.torque(grown)[1:5] / geometry.torque(grown)[:4]
    np.testing.assert_allclose(ratio, 2 * 1.05**2 - 1, rtol=2e-3)
    assert not geometry.is_stable("direct", long, stiffness)
    calm = geometry.run("direct", short, stiffness)
    assert geometry.first_growth(calm, "direct", short, stiffness) == -1
    assert geometry.is_stable("direct", short, stiffness)


def test_thrown_far_out_a_peg_rendered_directly_creates_energy_that_the_ledger_dates() -> None:
    far: Point = {"what": "cell", "method": "direct", "length": 0.5, "stiffness": 1e5}
    found = geometry.evaluate(far)
    assert not found["stable"]
    assert found["environment"] == "active"
    assert float(found["created"]) > 1.0
    assert 0 <= int(found["first_active"]) < 5
    twin = geometry.evaluate(far | {"method": "implicit", "stiffness": 2.0})
    assert twin["stable"]
    assert twin["environment"] == "strict"
    assert twin["first_active"] == -1


def test_the_peg_fills_its_hole_and_touches_nothing_else() -> None:
    scene = load_scene("planar_peg")
    for length in geometry.LENGTH:
        geometry.set_length(scene.model, length)
        mujoco.mj_setConst(scene.model, scene.data)
        scene.reset()
        scene.data.qpos[2] = 1e-3
        mujoco.mj_fwdPosition(scene.model, scene.data)
        contacts = scene.data.contact
        names = {scene.model.geom(int(i)).name for pair in contacts.geom for i in pair}
        assert names == {"peg", "hole_east", "hole_west"}
        deep = contacts.dist < 0
        # each end presses on one wall, by L/2 times the angle
        np.testing.assert_allclose(contacts.dist[deep], -length / 2 * 1e-3, rtol=1e-2)
        assert sorted(np.sign(contacts.pos[deep, 2])) == [-1, -1, 1, 1]


def test_the_map_says_what_its_table_holds(tmp_path: Path) -> None:
    boundary = boundary_of(geometry, tmp_path, 16)
    assert boundary["direct"]["largest_deviation"] < 0.15
    for name in geometry.BEHIND:
        assert boundary[name]["largest_over_smallest"] < 1.05
        assert boundary[name]["largest_deviation"] < 0.03
    assert boundary["lossless"]["smallest"] > 1.3 * boundary["implicit"]["largest"]
