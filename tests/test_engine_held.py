"""What every engine shares, with an engine in Python: no library, and no MuJoCo, is needed."""

from __future__ import annotations

import numpy as np
import pytest
from engine_stand_in import StandIn
from engine_tasks import AMPLITUDE, COUPLING, MASS, driven_error, driven_mass, driven_path, opened

from hapticbridge.lab.engines.base import (
    Body,
    Engine,
    Pose,
    Task,
    composed,
)
from hapticbridge.pose import quaternion_exp
from hapticbridge.theory.rigid_body import drive_mass


def test_a_held_coupling_drives_a_mass_as_the_held_scheme_says() -> None:
    engine: Engine = StandIn()
    expected = drive_mass(COUPLING, MASS, driven_mass(1e-3)[1], 1e-3, "held").position
    assert np.abs(driven_path(engine, 1e-3) - expected).max() < 1e-12 * AMPLITUDE
    assert driven_error(engine, 2e-3) / driven_error(engine, 1e-3) == pytest.approx(2, rel=0.1)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_wrong_mass_shows_as_a_worse_error(factor: float) -> None:
    assert driven_error(StandIn(factor), 1e-3) > 5 * driven_error(StandIn(), 1e-3)


def test_wrench_is_about_the_grip_and_acts_at_the_centre_of_mass() -> None:
    frame = Pose((0.01, -0.02, 0.03), quaternion_exp((0.3, -0.5, 0.7)))
    grip, start = Pose((0.0, 0.05, 0.02)), Pose((0.1, 0.2, 0.3), quaternion_exp((-0.4, 0.2, 0.9)))
    moment, mass = 2e-3, 0.2
    task = Task("pull", Body(mass, (moment,) * 3, frame), coupling=COUPLING, grip=grip, start=start)
    at = composed(start, grip)
    away = tuple(np.add(at.position, (1e-3, 0.0, 2e-3)))
    with opened(StandIn(), task, 1e-4) as simulation:
        assert np.abs(simulation.wrench()).max() < 1e-9  # the handle rests at the grip
        simulation.step(away, at.quaternion)
        wrench = simulation.wrench()
        # nothing moved yet: the wrench was held from before the handle left
        assert wrench.force == pytest.approx(
            (COUPLING.stiffness + COUPLING.damping / 1e-4) * np.subtract(away, at.position)
        )
        simulation.step(away, at.quaternion)
        velocity = simulation.velocity()
    lever = np.subtract(at.position, composed(start, frame).position)
    torque = wrench.torque + np.cross(lever, wrench.force)
    assert velocity.linear == pytest.approx(np.array(wrench.force) / mass * 1e-4)
    assert velocity.angular == pytest.approx(torque / moment * 1e-4)
