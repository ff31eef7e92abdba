"""The lossless coupling about a large twist: what its torque costs the device, and who pays."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded, rewritten
from kernel_runs import IDENTITY, T, load, mjcf
from numpy.typing import NDArray

from hapticbridge.audit import audit
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits, guard_parameters_for
from hapticbridge.demand.methods import LOSSLESS_COUPLING as LOSSLESS
from hapticbridge.demand.methods import unguarded_parameters
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.parameters import GuardParameters
from hapticbridge.kernel.pose import (
    dot,
    product,
    quaternion_exp,
    quaternion_of,
    rotation_between,
    scaled,
    store_quaternion,
    vector_of,
)
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import whole_tick
from hapticbridge.recording import Recording, read_recording
from hapticbridge.scene import Scene, load_scene
from hapticbridge.theory.bounds import midpoint_damping

SUBSTEPS = 60
"""Steps of the hand in a tick; its own frequency is below 0.02 rad a step."""

TOOL = mjcf("""
    <body name="tool"><joint type="ball" stiffness="{spring}"/>
      <inertial pos="0 0 0" mass="0.05" diaginertia="{inertia} {inertia} {inertia}"/>
      <site name="grip"/></body>""")

SEEDS = range(24)


def twisted(
    scene: Scene, law: Coupling, twist: float, b_r: float, pays: float | None = None
) -> BoundKernel:
    """Binds a scene to a device with damping b_r, turned by a twist about x.

    ``pays`` is the damping that may pay for the midpoint torque; inf takes all of it.
    """
    requested = LOSSLESS.requested_coupling(law, T)
    parameters = replace(
        unguarded_parameters(scene, requested, T, 1, LOSSLESS),
        coupling=law,
        device_start=(0.0, 0.0, 0.0, math.cos(twist / 2), math.sin(twist / 2), 0.0, 0.0),
        device_damping=2.0,
        device_rotational_damping=b_r,
        guarding=GuardParameters(has_hand=True, twist_damping=b_r if pays is None else pays),
    )
    return BoundKernel(scene.model, scene.data, parameters)


@compiled
def stored(state: NDArray[np.void], row: NDArray[np.void]) -> float:
    """Returns the energy of the rotational spring and of the scene in J."""
    tool, handle = quaternion_of(row[0].tool_quaternion), quaternion_of(row[0].handle_quaternion)
    twist = rotation_between(tool, handle)
    spring = 0.5 * state[0].coupling.rotational_stiffness * dot(twist, twist)
    return float(spring + row[0].kinetic + row[0].potential)


@compiled
def swing(
    sample: NDArray[np.void],
    row: NDArray[np.void],
    hand: tuple[float, float, float, float],
    w: NDArray[np.float64],
    net: float,
) -> float:
    """Moves a hand for a tick in leapfrog steps, with the damper implicit.

    ``w`` is its speed in rad/s; other arguments as for ``hold``. Returns ``net`` and the energy
    in J that the hand got in this tick beyond what b_r burned.
    """
    inertia, b_r, spring, angle = hand
    h = T / SUBSTEPS
    rest = (math.cos(0.5 * angle), math.sin(0.5 * angle), 0.0, 0.0)
    pose, torque = quaternion_of(sample[0].quaternion), vector_of(row[0].wrench_on_device[3:6])
    for _ in range(SUBSTEPS):
        pull = rotation_between(pose, rest)
        for i in range(3):
            w[i] += 0.5 * h / inertia * (torque[i] + spring * pull[i] - b_r * w[i])
        turn = scaled(h, vector_of(w))
        pose = product(quaternion_exp(turn), pose)
        net += dot(torque, turn) - b_r / h * dot(turn, turn)
        pull = rotation_between(pose, rest)
        for i in range(3):
            w[i] += 0.5 * h / inertia * (torque[i] + spring * pull[i])
            w[i] /= 1.0 + 0.5 * h * b_r / inertia
    store_quaternion(sample[0].quaternion, pose)
    return net


def hold(
    kernel: BoundKernel,
    sample: NDArray[np.void],
    hand: tuple[float, float, float, float],
    knock: float,
    ticks: int,
) -> tuple[float, float]:
    """Lets a hand hold the device by a torsion spring, and knocks it in tick 10.

    Args:
        kernel: The bound kernel.
        sample: The device's pose.
        hand: Inertia in kg m², damping b_r, spring in N m/rad, angle at which it rests in rad.
        knock: Change of its speed across the twist, in rad/s.
        ticks: Length of the run.

    Returns:
        Largest speed in the last 100 ticks in rad/s, and the most energy in J that the hand had
        beyond what it put in, what b_r burned, and what spring and scene gave up.
    """
    state, row = kernel.state, kernel.row
    w, net, start, most, fastest = np.zeros(3), 0.0, 0.0, -np.inf, 0.0
    for k in range(ticks):
        if k == 10:
            w[1] += knock
        if not whole_tick(state, sample, row, T):
            return np.inf, np.inf
        if k == 1:  # the handle follows from the first tick on
            net, start = 0.0, stored(state, row)
        if k > 0:
            most = max(most, net + stored(state, row) - start)
        net = swing(sample, row, hand, w, net)
        if k >= ticks - 100:
            fastest = max(fastest, float(np.linalg.norm(w)))
    return fastest, most


def knocked(pays: float | None) -> tuple[float, float]:
    """Knocks a hand of 1e-6 kg m² by 0.06 degrees, about 2 rad on ``virtual_wall``."""
    stiffness, twist, spring = 0.2, 2.0, 0.5
    b_r = 1.02 * 0.5 * stiffness * T
    kernel = twisted(
        load_scene("virtual_wall"), Coupling(500.0, 0.5, stiffness, 0.0), twist, b_r, pays
    )
    sample = np.zeros(1, SAMPLE_DTYPE)
    sample["quaternion"] = [math.cos(twist / 2), math.sin(twist / 2), 0.0, 0.0]
    knock = math.radians(0.06) * math.sqrt((spring + stiffness) / 1e-6)
    hand = 1e-6, b_r, spring, twist * (1.0 + stiffness / spring)
    return hold(kernel, sample, hand, knock, 1500)


def test_a_knock_about_a_large_twist_decays_unless_the_midpoint_torque_is_not_paid_for() -> None:
    speed, created = knocked(math.inf)
    assert speed > 100.0
    assert created > 0.01
    speed, created = knocked(None)
    assert speed < 0.05  # the knock is 0.88 rad/s
    assert created < 1e-12


# --- hands that circle about a twist --------------------------------------------------------------


@compiled
def lead(
    sample: NDArray[np.void],
    row: NDArray[np.void],
    path: tuple[float, float, float, float],
    device: tuple[float, float],
    tick: int,
    given: NDArray[np.float64],
) -> float:
    """Leads the device to its place in a tick; returns the time since the last one in s.

    Arguments as for ``circled``. ``given`` counts the energy in J that the hand got beyond what
    the device burned, and the energy that went to and fro.
    """
    (twist, radius, angle, share), (b_r, late) = path, device
    at = (math.cos(0.5 * twist), math.sin(0.5 * twist), 0.0, 0.0)
    size = radius * min(tick / 50.0, 1.0)
    turn = (0.0, size * math.cos(angle * tick), share * size * math.sin(angle * tick))
    pose = product(quaternion_exp(turn), at)
    elapsed = T * (1.0 + late * (tick % 2))
    step = rotation_between(quaternion_of(sample[0].quaternion) if tick > 0 else at, pose)
    torque = vector_of(row[0].wrench_on_device[3:6])
    work = dot(torque, step) - b_r / elapsed * dot(step, step)
    given[0] += work
    given[1] += abs(work)
    store_quaternion(sample[0].quaternion, pose)
    return elapsed


def circled(
    kernel: BoundKernel,
    path: tuple[float, float, float, float],
    device: tuple[float, float],
    dampings: NDArray[np.float64],
) -> tuple[float, float]:
    """Leads the device in a circle across its twist, each tick about one axis.

    Args:
        kernel: The bound kernel.
        path: Twist and radius in rad, angle of the circle per tick in rad, share of axis 2.
        device: Damping in N m s/rad, and periods by which every second sample is late.
        dampings: What may pay for the midpoint torque in each tick; below 0 as bound.

    Returns:
        As the second result of ``hold``, and the energy in J that went to and fro.
    """
    state, row, sample = kernel.state, kernel.row, np.zeros(1, SAMPLE_DTYPE)
    owed, paying = state["coupling"]["owed"][0], state["coupling"]["twist_damping"]
    given, start, most = np.zeros(2), 0.0, -np.inf
    for k, damping in enumerate(dampings):
        if damping >= 0.0:
            paying[0] = damping
        elapsed = lead(sample, row, path, device, k, given)
        if not whole_tick(state, sample, row, elapsed):
            return np.inf, given[1]
        if k == 1:
            given[0], start = 0.0, stored(state, row)
        if k > 0:
            most = max(most, given[0] + stored(state, row) - start - owed[1])
    return most, given[1]


def wobble(
    seed: int, *, is_whole: bool = False, is_random: bool = False, late: float = 0.0
) -> tuple[float, float]:
    """Circles at random about 0.1 to 2.8 rad; the device has just the damping that is needed.

    The tool turns on a spring or not at all. ``is_whole`` takes the midpoint torque at any twist;
    ``is_random`` takes another share of it in each tick; samples are ``late`` periods in turn.
    """
    rng = np.random.default_rng(seed)
    stiffness, twist = 10 ** rng.uniform(-1.3, 0.7), rng.uniform(0.1, 2.8)
    law = Coupling(500.0, 0.5, stiffness, stiffness * T * rng.choice([0.0, 0.05, 0.4]))
    b_r = float(rng.choice([1.0, 1.2])) * (0.5 * stiffness * T + law.rotational_damping)
    scene = load_scene("virtual_wall")
    if rng.random() < 0.7:
        spring, inertia = (
            stiffness * twist * 10 ** rng.uniform(-0.4, 1.0),
            10 ** rng.uniform(-6, -3),
        )
        scene = load(TOOL.format(spring=spring, inertia=inertia))
        rest = -stiffness * twist / spring  # the spring holds the tool upright
        scene.model.qpos_spring[:4] = [math.cos(rest / 2), math.sin(rest / 2), 0.0, 0.0]
    kernel = twisted(scene, law, twist, b_r, math.inf if is_whole else None)
    dampings = b_r * rng.random(800) if is_random else np.full(800, -1.0)
    path = (
        twist,
        10 ** rng.uniform(-4, -1),
        rng.uniform(-np.pi, np.pi),
        float(rng.choice([1.0, 0.6])),
    )
    return circled(kernel, path, (b_r, late), dampings)


@pytest.mark.parametrize(("is_random", "late"), [(False, 0.0), (True, 0.0), (False, 0.3)])
def test_circling_about_a_twist_gains_nothing(is_random: bool, late: float) -> None:
    """With a share that changes in each tick too, however it changes, and with late samples."""
    for seed in SEEDS:
        gained, through = wobble(seed, is_random=is_random, late=late)
        assert gained < 1e-13 + 1e-9 * through, seed


def test_circling_gains_where_the_midpoint_torque_is_taken_at_any_twist() -> None:
    gained = [wobble(seed, is_whole=True)[0] for seed in SEEDS]
    assert sum(each > 1e-6 for each in gained) >= 4


def test_up_to_the_twist_that_is_paid_for_the_torque_is_the_midpoint_one_to_the_bit() -> None:
    law, b_r, twist = Coupling(500.0, 0.5, 0.2, 0.0), 1.2e-4, 0.19
    assert (
        midpoint_damping(0.2, 0.0, T, twist)
        < b_r
        < midpoint_damping(0.2, 0.0, T, 1.1 * twist / 0.5)
    )
    found = []
    for pays in (None, math.inf, 0.0):
        kernel = twisted(load(TOOL.format(spring=1.0, inertia=1e-5)), law, twist, b_r, pays)
        circled(kernel, (twist, 0.1, 0.3, 0.5), (b_r, 0.0), np.full(300, -1.0))
        found.append(kernel.row.tobytes())
    assert found[0] == found[1] != found[2]


@pytest.mark.parametrize("damping", [0.0, 5e-5])
def test_what_a_twist_costs_is_the_least_damping_that_no_frequency_exceeds(damping: float) -> None:
    """A law K φ + C δe behind a strict environment, frequency by frequency."""
    stiffness, twist = 0.2, 1.3
    u = 1.0 - np.exp(-1j * np.linspace(-np.pi, np.pi, 200_001)[:-1])
    u = u[np.abs(u) > 1e-6]
    law = stiffness + (damping / T + 0.25j * stiffness * twist) * u
    worst = 0.5 * T * np.max(u.real / (u / law).real)  # (2): 1 − cos ωT is the real part of u
    assert midpoint_damping(stiffness, damping, T, twist) == pytest.approx(worst, rel=1e-8)
    plain = midpoint_damping(stiffness, damping, T, 0.0)
    assert plain == pytest.approx(0.5 * stiffness * T + damping, rel=1e-15)


# --- who pays -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sheet", "pays"),
    [
        ({}, 2e-3),
        ({"rate": 250.0}, 0.0),
        ({"delay": 1e-3}, 0.0),
        ({"rotational_damping": None}, 0.0),
        ({"axes": ("x", "y", "z"), "rotational_damping": None}, math.inf),
    ],
)
def test_a_device_pays_with_its_damping_if_it_is_known_and_in_time(
    sheet: dict[str, Any], pays: float
) -> None:
    info = replace(ScriptedDevice(lambda _: IDENTITY).info, **sheet)
    guard = guard_parameters_for(info, Limits(force=10.0, torque=0.5), T)
    assert guard.twist_damping == pays
    assert GuardParameters.from_json(guard.to_json()) == guard


def turning(tick: int) -> tuple[float, ...]:
    """Turns to 2 rad in half a second, circles there, and turns back."""
    twist = 2.0 * math.sin(0.5 * math.pi * min(tick / 500.0, 1.0, (1500 - tick) / 500.0))
    wobble = (0.0, 0.02 * math.cos(0.4 * tick), 0.02 * math.sin(0.4 * tick))
    half = (math.cos(0.5 * twist), math.sin(0.5 * twist), 0.0, 0.0)
    return (0.0, 0.0, 0.0, *product(quaternion_exp(wobble), half))


def recorded_about_a_twist(folder: Path, b_r: float) -> tuple[Path, Recording]:
    """Records ``turning`` behind a coupling of 0.2 N m/rad, in front of a tool that cannot turn."""
    path = folder / "run.mcap"
    device = ScriptedDevice(turning, rotational_damping=b_r)
    coupling = LOSSLESS.requested_coupling(Coupling(500.0, 0.5, 0.2, 1e-5), T)
    limits = Limits(force=10.0, torque=0.5, angle=2.8)
    scene = load_scene("virtual_wall")
    recorded(path, scene, device, coupling, duration=1.5, controller=None, limits=limits)
    return path, read_recording(path)


def test_a_run_beyond_the_twist_that_is_paid_for_stays_lossless_and_is_audited(
    tmp_path: Path,
) -> None:
    path, recording = recorded_about_a_twist(tmp_path, 1.3e-4)
    report = audit(path)
    found = report.verdict, report.certified, report.resimulation
    assert found == ("passive", True, "bit for bit")
    assert recording.ticks["wrench_on_tool"][:, 3].max() > 0.35
    assert np.all(recording.ticks["flags"][5:] & TickFlag.MIDPOINT)


def test_another_damping_that_pays_does_not_pass_the_audit(tmp_path: Path) -> None:
    _, recording = recorded_about_a_twist(tmp_path, 1.3e-4)
    guard = GuardParameters.from_json(recording.meta["guard"])
    for pays in (1e-4, 1.0):
        changed = {"guard": replace(guard, twist_damping=pays).to_json()}
        report = audit(rewritten(recording, tmp_path / "other.mcap", meta=changed))
        assert report.verdict == "invalid"
