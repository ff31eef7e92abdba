"""Claims of the audit about what a device was given that nothing paid for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, balance_of, recorded
from kernel_runs import PLAIN, T
from random_hands import random_motion

from hapticbridge.audit import audit
from hapticbridge.audit.energy import EnergyBalance, stored_in_springs
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.device import SimulatedDevice
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.recording import read_recording
from hapticbridge.run.description import parameters_of
from hapticbridge.run.options import Workspace

RUN = replace(
    PLAIN,
    coupling=Coupling(2000.0, 0.5, 2.0, 5e-4),
    device_damping=1.5,
    device_rotational_damping=1.5e-3,
)


def held(run: RunParameters, stretch: np.ndarray) -> np.ndarray:
    """Returns what the coupling's springs hold at some stretches."""
    gains = np.tile([run.coupling.stiffness, run.coupling.damping, 0.0, 0.0], (len(stretch), 1))
    motion: Any = SimpleNamespace(stretch=stretch, twist=np.zeros_like(stretch))
    return stored_in_springs(run, gains, (motion.stretch, motion.twist))


def test_the_balance_is_the_identity_behind_the_bound() -> None:
    """Any motion of handle and tool out of rest."""
    generator = np.random.default_rng(5)
    count, k, b = 40, RUN.coupling.stiffness, RUN.coupling.damping
    h, x = generator.normal(0, 1e-3, (2, count, 3))
    h[0] = x[0] = 0.0
    d, moved = (np.diff(v, axis=0, prepend=np.zeros((1, 3))) for v in (h, x))
    e, de = h - x, d - moved
    force = k * e + b / T * de
    kept = np.sum(force * moved) + held(RUN, e)[-1]

    def norm(v: np.ndarray, weight: float) -> np.ndarray:
        return np.asarray(weight * np.sum(v**2, axis=-1))

    own = 1.5  # N s/m, burnt over every tick
    last = count - 1
    given = -np.sum(force[:-1] * d[1:]) - np.sum(norm(d[1:], own / T))
    middle, before = slice(1, last), slice(0, last - 1)
    squares = (
        norm(moved[middle], (k + b / T) / 2)
        + norm(de[before] + d[middle], b / T / 2)
        + norm(d[middle], (own - b) / T - k / 2)
    ).sum()
    squares += norm(de[last - 1] + d[last], b / T / 2)
    squares += norm(d[last], own / T - k / 2 - b / T / 2)
    squares += norm(moved[last], k / 2) - b / T * np.sum(de[last] * moved[last])
    assert given + kept == pytest.approx(-squares, rel=1e-12)


@pytest.mark.parametrize(
    ("changed", "spring"),
    # K = 2000 N/m: 1 N at 0.5 mm, 0.5 N at 0.25 mm
    [
        ({"force_limit": 1.0}, 0.25e-3 + 1.5e-3),
        ({"force_limit": 1.0, "force_scale": 2.0}, 0.0625e-3 + 0.5 * 1.75e-3),
        ({}, 4e-3),
    ],
)
def test_a_spring_that_is_limited_stores_force_times_length_beyond_the_limit(
    changed: dict[str, Any], spring: float
) -> None:
    stretch = np.array([[0.0, 0.0, 0.0], [2e-3, 0.0, 0.0]])
    assert held(replace(RUN, **changed), stretch) == pytest.approx([0.0, spring])


def test_half_the_force_is_half_the_energy(tmp_path: Path) -> None:
    lost = []
    for force_scale in (1.0, 0.5):
        path = tmp_path / f"{force_scale}.mcap"
        device = ScriptedDevice(lambda k: (1e-5 * k, 0, 1e-5 * k, 1, 0, 0, 0))
        coupling = Coupling(1000.0, 0.5, 1.0, 5e-4)
        recorded(
            path,
            "point_mass",
            device,
            coupling,
            duration=0.2,
            workspace=Workspace(force_scale=force_scale),
        )
        lost.append(unpaid(path, 0.0, 0.0))
    assert np.abs(lost[0]).max() > 1e-6
    np.testing.assert_allclose(lost[1], 0.5 * lost[0], rtol=1e-9, atol=1e-15)


def balance(path: Path, damping: float | None = None, rotational: float = 1.0) -> EnergyBalance:
    """Returns a recording's balance, as if its device had this damping."""
    recording = read_recording(path)
    parameters = replace(
        parameters_of(recording.meta), device_damping=damping, device_rotational_damping=rotational
    )
    return balance_of(recording, parameters)[1]


def unpaid(path: Path, damping: float | None = None, rotational: float = 1.0) -> np.ndarray:
    """Returns what the device of a recording was given beyond what is paid for, in J."""
    return balance(path, damping, rotational).excess_device_energy


@pytest.mark.parametrize(
    ("seed", "limit", "options"),
    [
        (1, 10.0, {}),
        (2, 0.3, {}),  # the force is limited most of the time
        (3, 10.0, {"workspace": Workspace(scale=2.0)}),
        (4, 10.0, {"workspace": Workspace(force_scale=0.5)}),
    ],
)
def test_a_device_that_bears_the_coupling_is_never_kicked(
    seed: int, limit: float, options: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    device = SimulatedDevice(damping=10.0, path=random_motion(seed, 1.0))
    limits = Limits(force=limit, torque=0.5, ramp=0.1)
    coupling = Coupling(2000.0, 0.5, 2.0, 5e-4)
    recorded(path, "peg_in_hole", device, coupling, duration=1.0, limits=limits, **options)
    lost = unpaid(path, 10.0)
    assert lost.max() <= 1e-12
    assert lost.min() < -1e-4  # and it is not zero by nature


def test_a_weight_that_the_springs_hold_at_the_start_was_not_given_by_the_device(
    tmp_path: Path,
) -> None:
    scene = tmp_path / "falling.xml"
    scene.write_text(
        '<mujoco><worldbody><body name="tool"><freejoint/><geom size="0.015" mass="0.1"/>'
        '<site name="grip"/></body></worldbody></mujoco>',
        encoding="utf-8",
    )
    path = tmp_path / "run.mcap"
    device = SimulatedDevice(damping=2.0, path=random_motion(1, 0.5))
    # more than the device bears, so that its port is judged tick by tick
    recorded(path, scene, device, Coupling(6000.0, 3.0, 2.0, 5e-4), duration=0.5)
    assert unpaid(path, 2.0)[0] <= 0.0  # 80 µJ, m² g²/(2 K), if the springs began empty


def test_where_damping_is_unknown_nobody_can_tell(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, "point_mass", "simulated", duration=0.1)
    assert not unpaid(path).any()


@pytest.mark.parametrize("limit", [0.3, 1e3])
def test_what_the_scene_creates_within_its_slack_is_not_the_devices_fault(
    limit: float, tmp_path: Path
) -> None:
    # a force that is limited or still rises lets through only a share of the slack
    path, period = tmp_path / "run.mcap", 5e-4
    coupling = Coupling(3971.0, 1.97, 0.2, 1.5e-3)
    device = ScriptedDevice(
        lambda k: (2e-4 * np.sin(25 * period * k), 0, 0, 1, 0, 0, 0), strength=limit
    )
    limits = Limits(force=limit, torque=0.05 * limit, ramp=0.3)
    options: dict[str, Any] = {"method": "implicitfast", "rate": 1 / period, "limits": limits}
    recorded(path, "point_mass", device, coupling, duration=0.5, **options)
    found = balance(path, coupling.stiffness * period / 2 + coupling.damping)
    created = found.environment_energy
    assert created.max() > 1e-9
    assert np.all(created <= found.slack + 1e-12)
    assert found.excess_device_energy.max() <= 1e-12


class Turning(ScriptedDevice):
    """A device that a strong hand turns to and fro, with its data sheet changed.

    On ``virtual_wall`` it turns against a tool that cannot turn.
    """

    def __init__(self, **changed: Any) -> None:
        super().__init__(lambda k: (0, 0, 0, *self._turned(5e-3 * np.sin(0.05 * k))))
        self.info = replace(self.info, **changed)

    @staticmethod
    def _turned(angle: float) -> tuple[float, ...]:
        return float(np.cos(angle / 2)), float(np.sin(angle / 2)), 0.0, 0.0


@pytest.mark.parametrize(
    ("changed", "coupling", "certified", "port"),
    [
        # K_r T/2 alone is beyond what 2e-3 N m s/rad bear
        ({}, Coupling(1000.0, 0.5, 80.0, 5e-4), False, "device"),
        ({"rotational_damping": None}, Coupling(1000.0, 0.5, 80.0, 5e-4), None, ""),
        ({"rotational_damping": None}, Coupling(9000.0, 0.5, 80.0, 5e-4), False, ""),
        ({"is_prescribed": True}, Coupling(1000.0, 0.5, 80.0, 5e-4), None, ""),
    ],
)
def test_a_device_is_blamed_only_where_all_its_damping_is_known_and_it_is_free_to_move(
    changed: dict[str, Any], coupling: Coupling, certified: bool | None, port: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    summary = recorded(path, "virtual_wall", Turning(**changed), coupling, duration=0.3)
    report = audit(path)
    assert (report.certified, report.port) == (certified, port)
    assert summary.is_certified is certified


def test_a_weld_kicks_no_device_whose_motion_is_prescribed(tmp_path: Path) -> None:
    for is_prescribed, port in ((False, "device"), (True, "")):
        path = tmp_path / f"{is_prescribed}.mcap"
        device = Turning(is_prescribed=is_prescribed, damping=0.0, rotational_damping=0.0)
        coupling = Coupling(1000.0, 0.5, 80.0, 5e-4)
        summary = recorded(path, "point_mass", device, coupling, duration=0.3, method="weld")
        assert (summary.fault or (0, ""))[1] == port
        assert audit(path).port == port
