"""The simulated device against ODE solvers, closed forms and the theory's own loop."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cli_cases import Called
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation

import hapticbridge as hb
from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, Motion, SimulatedDevice, device_for
from hapticbridge.device.simulated.device import hand_for
from hapticbridge.device.trajectory import lissajous
from hapticbridge.errors import DeviceError
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.scene import load_scene
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand

Array = NDArray[np.float64]

Law = Callable[[float, Array, Array, Array], Array]

T = 2e-3
STILL = Motion([0.0, 1.0], np.zeros((2, 3)))


def run(
    device: SimulatedDevice, wrenches: Array, period: float = T
) -> tuple[NDArray[np.void], Array]:
    """Samples and velocities at the ticks 0 to n; wrench k acts from tick k on."""
    samples = np.zeros(len(wrenches) + 1, SAMPLE_DTYPE)
    velocities = np.zeros((len(wrenches) + 1, 6))
    device.start(period)
    for k in range(len(samples)):
        device.read(samples[k : k + 1])
        velocities[k] = device.velocity
        if k < len(wrenches):
            device.write(wrenches[k])
    return samples, velocities


def along_x(forces: Array) -> Array:
    wrenches = np.zeros((len(forces), 6))
    wrenches[:, 0] = forces
    return wrenches


def turns(samples: NDArray[np.void]) -> Array:
    """Rotation vectors, by SciPy (which puts w last)."""
    vectors: Array = Rotation.from_quat(samples["quaternion"][:, [1, 2, 3, 0]]).as_rotvec()
    return vectors


def integrated(law: Law, start: Array, inputs: Array, targets: Array, period: float) -> Array:
    """Integrates y' = law(t, y, input, target) tick by tick, to near the last digit."""
    states = [start]
    for k in range(len(inputs)):

        def slope(t: float, y: Array, k: int = k) -> Array:
            drift = (targets[k + 1] - targets[k]) / period
            return law(t, y, inputs[k], np.concatenate([targets[k] + t * drift, drift]))

        end = solve_ivp(slope, (0.0, period), states[-1], method="DOP853", rtol=1e-11, atol=1e-15)
        states.append(end.y[:, -1])
    return np.array(states)


@pytest.mark.parametrize("hand", [Hand(), None, Hand(mass=0.0, damping=0.0, stiffness=9000.0)])
def test_translation_agrees_with_integration_of_its_law(hand: Hand | None) -> None:
    rng = np.random.default_rng(1)
    forces = rng.normal(0.0, 5.0, (25, 3))
    rows = np.array([0.0, 0.011, 0.03, 0.06])
    places = rng.normal(0.0, 0.02, (4, 3))
    device = SimulatedDevice(hand=hand, path=Motion(rows, places))
    samples, velocities = run(device, np.column_stack([forces, 0.0 * forces]))
    times, offsets = T * np.arange(26), (places - places[0]).T
    targets = np.column_stack([np.interp(times, rows, offset) for offset in offsets])
    h = hand or Hand(mass=0.0, damping=0.0, stiffness=0.0)

    def law(_: float, y: Array, force: Array, target: Array) -> Array:
        x, v, p, dp = y[:3], y[3:], target[:3], target[3:]
        push = force - 2.0 * v - h.damping * (v - dp) - h.stiffness * (x - p)
        return np.concatenate([v, push / (0.1 + h.mass)])

    expected = integrated(law, np.zeros(6), forces, targets, T)
    # the integrator's own error is 1e-11 relative; positions are of the order of 1 cm
    np.testing.assert_allclose(samples["position"], expected[:, :3], rtol=0, atol=2e-12)
    np.testing.assert_allclose(velocities[:, :3], expected[:, 3:], rtol=0, atol=2e-10)


@pytest.mark.parametrize("hand", [Hand(), None])
def test_rotation_about_one_axis_agrees_with_integration_of_its_law(hand: Hand | None) -> None:
    rng = np.random.default_rng(2)
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    torques = rng.normal(0.15 if hand is None else 1.4, 0.1, 40)
    if hand is None:
        torques *= 0.9
    rows, angles = np.array([0.0, 0.03, 0.08]), np.array([0.0, 0.9, 0.4])
    turned = Rotation.from_rotvec(angles[:, None] * axis).as_quat(scalar_first=True)
    path = Motion(rows, np.zeros((3, 3)), turned)
    wrenches = np.column_stack([np.zeros((40, 3)), torques[:, None] * axis])
    samples, velocities = run(SimulatedDevice(hand=hand, path=path), wrenches)
    h = hand or Hand(rotational_inertia=0.0, rotational_damping=0.0, rotational_stiffness=0.0)
    targets = np.interp(T * np.arange(41), rows, angles)[:, None]

    def law(_: float, y: Array, torque: Array, target: Array) -> Array:
        push = torque - 2e-3 * y[1] - h.rotational_damping * (y[1] - target[1])
        push = push - h.rotational_stiffness * (y[0] - target[0])
        return np.array([y[1], float(push[0]) / (1e-4 + h.rotational_inertia)])

    expected = integrated(law, np.zeros(2), torques[:, None], targets, T)
    assert 1.0 < expected[:, 0].max() < 3.1  # far from small, and below π
    np.testing.assert_allclose(turns(samples), expected[:, :1] * axis, rtol=0, atol=1e-11)
    np.testing.assert_allclose(velocities[:, 3:], expected[:, 1:] * axis, rtol=0, atol=1e-9)


def test_rotation_about_changing_axes_converges_to_its_law() -> None:
    torque = np.array([0.06, -0.03, 0.05])
    h = Hand()

    def law(_: float, y: Array) -> Array:
        q, w = y[:4], y[4:]
        error = Rotation.from_quat(q).as_rotvec()
        push = torque - np.cross([0, 0, 0.5], error) - 0.022 * w - h.rotational_stiffness * error
        # q' = ½ ω ⊗ q, vector part first
        vector = 0.5 * (q[3] * w + np.cross(w, q[:3]))
        rate = np.array([*vector, -0.5 * w @ q[:3]])
        return np.concatenate([rate, push / 1.1e-3])

    end = solve_ivp(law, (0, 0.1), [0, 0, 0, 1, 0, 0, 0], method="DOP853", rtol=1e-10, atol=1e-12)
    expected = Rotation.from_quat(end.y[:4, -1])

    def error(ticks: int) -> float:
        device = SimulatedDevice(path=STILL)
        period = 0.1 / ticks
        device.start(period)
        sample = np.zeros(1, SAMPLE_DTYPE)
        device.read(sample)
        for _ in range(ticks):
            held = torque - np.cross([0, 0, 0.5], turns(sample)[0])
            device.write(np.concatenate([np.zeros(3), held]))
            device.read(sample)
        reached = Rotation.from_quat(sample["quaternion"][0, [1, 2, 3, 0]])
        return float((reached * expected.inv()).magnitude())

    coarse, fine = error(100), error(400)
    # the torque itself is held here, which is of first order: four times finer, four times closer
    assert fine < 2e-3
    assert fine < coarse / 3.5


def test_a_free_device_coasts_and_loses_what_its_damper_takes() -> None:
    m, b = 0.1, 2.0
    forces = np.array([8.0] * 5 + [0.0] * 40)
    samples, velocities = run(SimulatedDevice(hand=None), along_x(forces), period=5e-3)
    v0 = velocities[5, 0]
    assert v0 > 1.0
    for k in range(5, 46):
        t = (k - 5) * 5e-3
        lost = 0.5 * m * (v0**2 - velocities[k, 0] ** 2)
        taken, _ = quad(lambda s: b * (v0 * math.exp(-b * s / m)) ** 2, 0.0, t, epsabs=1e-14)
        assert lost == pytest.approx(taken, abs=1e-13)
    coasted = samples["position"][45, 0] - samples["position"][5, 0]
    assert coasted == pytest.approx(m / b * (v0 - velocities[45, 0]), abs=1e-14)


@given(
    period=st.floats(1e-3, 0.5),
    kick=st.floats(0.5, 50.0),
    friction=st.floats(0.05, 0.4),
    damping=st.sampled_from([0.0, 0.3, 3.0]),
)
@settings(max_examples=40)
def test_friction_stops(period: float, kick: float, friction: float, damping: float) -> None:
    m = 0.1
    device = SimulatedDevice(hand=None, mass=m, damping=damping, friction=friction)
    sample = np.zeros(1, SAMPLE_DTYPE)
    device.start(period)
    device.read(sample)
    device.write(along_x(np.array([kick]))[0])
    device.read(sample)
    x0, v0 = float(sample["position"][0, 0]), float(device.velocity[0])
    device.write(np.zeros(6))
    for _ in range(math.ceil(m * v0 / friction / period) + 1):
        device.read(sample)
    if damping == 0.0:
        distance = m * v0**2 / (2.0 * friction)
    else:
        ratio = damping * v0 / friction
        distance = m / damping * (v0 - friction / damping * math.log1p(ratio))
    assert device.velocity[0] == 0.0
    assert sample["position"][0, 0] - x0 == pytest.approx(distance, rel=1e-9, abs=1e-13)


@given(share=st.floats(-1.0, 1.0))
@settings(max_examples=30)
def test_friction_holds_any_smaller_force_and_yields_to_a_larger_one(share: float) -> None:
    device = SimulatedDevice(hand=None, friction=0.5, damping=0.0)
    samples, velocities = run(device, along_x(np.full(20, 0.5 * share)))
    assert not samples["position"].any() and not velocities.any()
    samples, _ = run(device, along_x(np.full(20, -0.75)))
    moved = -0.5 * 0.25 / 0.1 * (20 * T) ** 2
    assert samples["position"][20, 0] == pytest.approx(moved, rel=1e-12)


def stick_and_slip(
    start: tuple[float, float], force: float, p: float, dp: float, *, period: float, friction: float
) -> tuple[float, float]:
    """One tick of the device in the default hand, by an ODE solver with events."""
    x, v = start
    m, b, h = 0.65, 2.0, Hand()
    t, slip = 0.0, math.copysign(1.0, v) if v else 0.0

    def pull(s: float, x: float) -> float:
        return force + h.damping * dp - h.stiffness * (x - p - dp * s)

    while t < period:
        if slip == 0.0:
            now = pull(t, x)
            if abs(now) <= friction:
                rate = h.stiffness * dp
                loose = (math.copysign(friction, rate) - now) / rate if rate else math.inf
                t += loose
                slip = math.copysign(1.0, rate)
                continue
            slip = math.copysign(1.0, now)
        sign = slip

        def law(s: float, y: Array, sign: float = sign) -> list[float]:
            return [y[1], (pull(s, y[0]) - (b + h.damping) * y[1] - sign * friction) / m]

        def stops(_: float, y: Array) -> float:
            return float(y[1])

        stops.terminal, stops.direction = True, -sign  # type: ignore[attr-defined]
        options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-14}
        solution = solve_ivp(law, (t, period), [x, v], events=stops, **options)
        t, (x, v) = solution.t[-1], solution.y[:, -1]
        if solution.status == 1:
            v, slip = 0.0, 0.0
    return x, v


@pytest.mark.parametrize(("period", "amplitude"), [(0.004, 5e-4), (0.15, 1e-2)])
def test_friction_in_a_moving_hand_is_that_of_events(period: float, amplitude: float) -> None:
    ticks = 60
    rng = np.random.default_rng(4)
    forces = rng.normal(0.0, 0.4, ticks).round(1) * (rng.random(ticks) > 0.6)
    times = period * np.arange(ticks + 1)
    path = amplitude * np.sin(2 * np.pi * times / (20 * period)) ** 3
    hand = Motion(times, np.outer(path, [1.0, 0.0, 0.0]))
    device = SimulatedDevice(friction=0.3, path=hand)
    samples, velocities = run(device, along_x(forces), period)
    expected = [(0.0, 0.0)]
    for k in range(ticks):
        drift = float(path[k + 1] - path[k]) / period
        told = expected[k], float(forces[k]), float(path[k]), drift
        expected.append(stick_and_slip(*told, period=period, friction=0.3))
    stuck = velocities[:, 0] == 0.0
    assert 5 < stuck.sum() < ticks - 5
    # the solver's own error, 1e-11 relative over sixty ticks
    x, v = np.array(expected).T
    np.testing.assert_allclose(samples["position"][:, 0], x, rtol=0, atol=1e-11)
    np.testing.assert_allclose(velocities[:, 0], v, rtol=0, atol=1e-10)


@given(friction=st.floats(0.01, 2.0), stiffness=st.floats(10.0, 300.0), speed=st.floats(1e-3, 1.0))
@settings(max_examples=40)
def test_pulling_hand_breaks_it_loose(friction: float, stiffness: float, speed: float) -> None:
    period, m = 0.1, 0.1
    hand = Hand(mass=0.0, damping=0.0, stiffness=stiffness)
    path = Motion([0.0, period], np.outer([0.0, speed * period], [1.0, 0.0, 0.0]))
    device = SimulatedDevice(mass=m, damping=0.0, friction=friction, hand=hand, path=path)
    samples, velocities = run(device, np.zeros((1, 6)), period)
    # from then on the distance to the spring's rest swings freely about the one that friction holds
    time = max(period - friction / (stiffness * speed), 0.0)
    w = math.sqrt(stiffness / m)
    moved = speed * (time - math.sin(w * time) / w), 2.0 * speed * math.sin(0.5 * w * time) ** 2
    found = samples["position"][1, 0], velocities[1, 0]
    assert found == pytest.approx(moved, rel=1e-9, abs=1e-13)


def test_a_dip_of_the_velocity_below_zero_within_one_period_is_not_missed() -> None:
    # friction brakes a device that the target's pull, growing all the while, later drags on: at
    # both ends of the second period it moves forward, in between it stood still
    m, k, dp, period, friction = 0.1, 50.0, 1.0, 0.1, 1.0
    path = Motion([0.0, period, 2 * period], np.outer([0.0, 0.0, dp * period], [1.0, 0.0, 0.0]))
    hand = Hand(mass=0.0, damping=0.0, stiffness=k)
    device = SimulatedDevice(hand=hand, damping=0.0, friction=friction, path=path)
    samples, velocities = run(device, along_x(np.array([friction + 0.057, 0.0])), period)
    (x0, x1), (v0, v1) = samples["position"][1:, 0], velocities[1:, 0]
    assert v0 == pytest.approx(0.02, rel=0.01)

    def brakes(t: float, y: Array) -> list[float]:  # until it stops
        return [y[1], (-friction - k * (y[0] - dp * t)) / m]

    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-15, "dense_output": True}
    fine = np.linspace(0.0, period, 20001)
    x, v = solve_ivp(brakes, (0.0, period), [x0, v0], **options).sol(fine)
    assert v[-1] > 0.0 > v.min()  # the trap: an end-to-end look sees no stop
    x_stop = float(x[np.argmax(v <= 0.0)])
    # from rest at the limit of friction: r = v − dp swings freely from −dp
    w, s = math.sqrt(k / m), period - (friction / k + x_stop) / dp
    assert v1 == pytest.approx(dp * (1.0 - math.cos(w * s)), rel=1e-4)
    assert x1 == pytest.approx(x_stop + dp * (s - math.sin(w * s) / w), rel=1e-4)


def test_friction_ends_its_search_where_only_rounding_moves() -> None:
    # a stiff, heavily damped hand has dragged the device up to its own speed, and what is left of
    # the acceleration is rounding: a search for all of its zeros would take the whole day
    period, friction = 0.023369139176279544, 1.02e-6
    numbers = {"mass": 0.1026, "damping": 370.2, "friction": friction}
    hand = Hand(mass=0.0, damping=0.0, stiffness=438704.6)
    for speed in np.linspace(0.6, 0.7, 41):
        path = Motion([0.0, period], np.outer([0.0, speed * period], [1.0, 0.0, 0.0]))
        device = SimulatedDevice(hand=hand, path=path, **numbers)  # type: ignore[arg-type]
        _, velocities = run(device, along_x(np.array([-friction])), period)
        assert velocities[1, 0] == pytest.approx(speed, rel=1e-9)


def test_encoder_resolution_rounds_the_report_and_not_the_motion() -> None:
    rng = np.random.default_rng(5)
    wrenches = rng.normal(0.0, 1.0, (300, 6)) * [4, 4, 4, 0.05, 0.05, 0.05]
    true, _ = run(SimulatedDevice(), wrenches)
    seen, _ = run(SimulatedDevice(resolution=1e-4, rotational_resolution=2e-3), wrenches)
    steps = seen["position"] / 1e-4
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.abs(seen["position"] - true["position"]).max() <= 0.5e-4 * (1 + 1e-9)
    steps = turns(seen) / 2e-3
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.abs(turns(seen) - turns(true)).max() <= 1e-3 * (1 + 1e-9)
    assert len(np.unique(seen["position"][:, 0])) > 10


@pytest.mark.parametrize("delay", [1, 2, 7, 100])
def test_delay_is_exactly_that_many_samples(delay: int) -> None:
    wrenches = np.random.default_rng(6).normal(0.0, 1.0, (130, 6))
    late, _ = run(SimulatedDevice(delay=delay), wrenches)
    shifted = np.vstack([np.zeros((delay, 6)), wrenches])[: len(wrenches)]
    expected, _ = run(SimulatedDevice(), shifted)
    assert late.tobytes() == expected.tobytes()


def test_a_wrench_holds_until_the_next_write() -> None:
    expected, _ = run(SimulatedDevice(delay=2), along_x(np.full(20, 3.0)))
    device, samples = SimulatedDevice(delay=2), np.zeros(21, SAMPLE_DTYPE)
    device.start(T)
    for k in range(21):
        device.read(samples[k : k + 1])
        if k == 0:
            wrench = along_x(np.array([3.0]))[0]
            device.write(wrench)
            wrench[:] = np.nan  # the caller's array is the caller's
    assert samples.tobytes() == expected.tobytes()


def test_the_hand_follows_its_path_from_the_first_pose_and_stays_at_its_end(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    start = Rotation.from_rotvec([0, 0, math.pi / 2])
    quaternions = [
        (Rotation.from_rotvec([0, y, 0]) * start).as_quat(scalar_first=True) for y in (0, 0.4)
    ]
    rows = [[5.0, 1.0, 2.0, 3.0, *quaternions[0]], [6.0, 1.02, 1.99, 3.0, *quaternions[1]]]
    lines = [",".join(f"{float(v)!r}" for v in row) for row in rows]
    file.write_text("\n".join(["t,x,y,z,qw,qx,qy,qz", *lines]))
    device = SimulatedDevice(path=file)
    assert device.info.duration == 1.0
    samples, velocities = run(device, np.zeros((2500, 6)))
    assert not samples["position"][0].any()
    # on the way the hand lags behind by (b/k) · speed, 2/135 s
    way, place = np.array([0.02, -0.01, 0.0]), samples["position"]
    np.testing.assert_allclose(place[400], way * (0.8 - 2 / 135), atol=1e-5)
    np.testing.assert_allclose(place[2500], way, atol=1e-12)
    np.testing.assert_allclose(turns(samples)[2500], [0.0, 0.4, 0.0], atol=1e-9)
    np.testing.assert_allclose(velocities[2500], 0.0, atol=1e-10)


def test_the_default_path_is_slow_small_and_starts_at_rest() -> None:
    poses = [lissajous(k * 1e-3) for k in range(60_000)]
    positions = np.array([p for p, _ in poses])
    angles = 2 * np.arccos(np.array([q[0] for _, q in poses]))
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / 1e-3
    assert not positions[0].any()
    assert speed[0] < 1e-4
    assert speed.max() <= 0.042
    assert 0.0099 < np.abs(positions).max() <= 0.01
    assert 0.1 < angles.max() <= 0.1 * math.sqrt(3)


def test_a_force_that_is_not_finite_shows_in_the_sample() -> None:
    for friction in (0.0, 0.1):
        samples, _ = run(SimulatedDevice(friction=friction), along_x(np.array([0.0, math.nan])))
        assert np.isfinite(samples["position"][1]).all()
        assert np.isnan(samples["position"][2, 0])


WORST = WorstHand(2.0, 100.0, 1e-3)
TOO_FAST = SimulatedDevice(friction=0.1, hand=Hand(mass=0, stiffness=1e12))


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: SimulatedDevice(mass=0.0), "mass is 0.0 kg; it must be finite and > 0"),
        (lambda: SimulatedDevice(damping=-1.0), "damping is -1.0"),
        (lambda: SimulatedDevice(friction=math.nan), "friction is nan"),
        (lambda: SimulatedDevice(resolution=math.inf), "resolution is inf"),
        (lambda: SimulatedDevice(force_limit=-2.0), "force limit is -2.0 N"),
        (lambda: SimulatedDevice(delay=101), "delay is 101; it must be 0 to 100 whole samples"),
        (lambda: SimulatedDevice(delay=1.5), "delay is 1.5"),  # type: ignore[arg-type]
        (lambda: Hand(stiffness=-1.0), "hand stiffness is -1.0"),
        (lambda: Hand(mass="heavy"), "hand mass is 'heavy'"),  # type: ignore[arg-type]
        (lambda: TOO_FAST.start(1e-2), "too fast for friction"),
        (
            lambda: SimulatedDevice(hand=WORST).start(2e-3),
            "tuned to a period of 0.001 s, the loop's is 0.002 s",
        ),
        (lambda: SimulatedDevice(hand=WORST, friction=0.1), "friction = 0.1 N"),
        (
            lambda: SimulatedDevice(hand=Hand(), rotational_hand=WORST),
            "a worst hand in translation too",
        ),
    ],
)
def test_bad_parameters_are_refused(build: Callable[[], object], words: str) -> None:
    with pytest.raises(DeviceError, match=re.escape(words)):
        build()


PERIOD = 1e-3


def test_device_on_a_wall_is_the_theorys_loop_sample_by_sample() -> None:
    coupling = Coupling(3000, 0.7, 1.0, 0.0)
    loop = SampledLoop(coupling, PERIOD)
    hand = WorstHand(1.9, 900.0, PERIOD, complex(loop.response(900.0)))
    expected = loop.simulate(hand, 500)
    device, sample = SimulatedDevice(hand=hand), np.zeros(1, SAMPLE_DTYPE)
    device.start(PERIOD)
    device.displace(np.array([1e-3, 0, 0, 0, 0, 0]))
    before, wrench = 0.0, np.zeros(6)
    for k in range(500):
        device.read(sample)
        x = sample[0]["position"][0]
        wrench[0] = -(3000 * x + 0.7 / PERIOD * (x - before))
        before = x
        device.write(wrench)
        assert x == pytest.approx(expected.handle[k], rel=1e-9, abs=1e-15)
        assert -wrench[0] == pytest.approx(expected.force[k], rel=1e-9, abs=1e-9)


def test_rotation_has_a_line_of_its_own_or_stands_still() -> None:
    translation = WorstHand(2.0, np.pi / PERIOD, PERIOD)
    rotation = WorstHand(2e-3, np.pi / PERIOD, PERIOD)
    torque = np.array([0, 0, 0, 0, 0, 0.004])
    turned = []
    for second in (None, rotation):
        device = SimulatedDevice(hand=translation, rotational_hand=second)
        sample = np.zeros(1, SAMPLE_DTYPE)
        device.start(PERIOD)
        device.read(sample)
        device.write(torque)
        device.read(sample)
        turned.append(2 * np.arctan2(sample[0]["quaternion"][3], sample[0]["quaternion"][0]))
    # a damper alone turns by τ T/b
    assert turned == pytest.approx([0.0, 0.004 * PERIOD / 2e-3], abs=1e-15)


def test_a_device_is_displaced_only_between_start_and_first_sample() -> None:
    device, sample = SimulatedDevice(hand=None), np.zeros(1, SAMPLE_DTYPE)
    knock = np.array([1e-3, 0, 0, 0, 0, 0.1])
    with pytest.raises(DeviceError, match="after its start"):
        device.displace(knock)
    device.start(PERIOD)
    device.displace(knock)
    device.read(sample)
    assert sample[0]["position"] == pytest.approx([1e-3, 0, 0], abs=1e-18)
    assert sample[0]["quaternion"] == pytest.approx([np.cos(0.05), 0, 0, np.sin(0.05)], abs=1e-15)
    with pytest.raises(DeviceError, match="before its first sample"):
        device.displace(knock)


def test_a_hand_that_is_firmer_for_a_spring_does_not_say_that_it_lifts(tmp_path: Path) -> None:
    path = tmp_path / "lever.xml"
    path.write_text(
        """<mujoco><option gravity="0 0 0"/><worldbody><body><joint type="slide" stiffness="10"
        springref="0.3"/><geom size=".01" mass=".1"/><site name="grip"/></body></worldbody>
        </mujoco>"""
    )
    said: list[str] = []
    device_for(load_scene(path), "simulated", said.append)
    assert said == [
        "the simulated hand grips with 600 N/m instead of 135, so that it holds this tool"
    ]


@pytest.mark.parametrize(("mass", "stiffness"), [(0.1, 135.0), (0.35, 686.7), (3.0, 135.0)])
def test_hand_is_firm_enough_to_lift_the_tool(
    tmp_path: Path, mass: float, stiffness: float
) -> None:
    """By the weight over a sag of 5 mm; a light tool needs no more, and 29 N are carried."""
    path = tmp_path / "mug.xml"
    path.write_text(
        f"""<mujoco><option gravity="0 0 -9.81"/><worldbody><geom type="plane" size="1 1 1"/>
        <body name="mug" pos="0 0 .05"><freejoint/>
        <geom type="cylinder" size=".04 .05" mass="{mass}"/><site name="grip"/></body>
        </worldbody></mujoco>"""
    )
    said: list[str] = []
    device = device_for(load_scene(path), "simulated", said.append)
    assert isinstance(device, SimulatedDevice)
    assert isinstance(device.hand, Hand)
    assert device.hand.stiffness == pytest.approx(stiffness)
    assert bool(said) == (stiffness > 135.0)
    if not said:
        return
    lifted = []
    for spec in ("simulated", "simulated:hand_stiffness=135,hand_damping=6.5"):
        scene = load_scene(path)
        with hb.Bridge(scene, spec, clock=hb.SimulatedClock()) as bridge:
            highest = 0.0
            for _ in range(8):
                bridge.run(duration=0.5)
                highest = max(highest, float(scene.data.body("mug").xpos[2]) - 0.05)
        lifted.append(highest > 1e-3)
    assert lifted == [True, False]


def test_a_hand_bears_the_whole_weight_of_a_tool_beside_its_centre_of_mass(tmp_path: Path) -> None:
    """3 N, 0.12 m from the grip, hang on the hand although the tool could turn: 3 N/5 mm."""
    path = tmp_path / "mallet.xml"
    path.write_text(
        """<mujoco><option gravity="0 0 -10"/><worldbody><body name="mallet"><freejoint/>
        <geom size=".02" pos=".12 0 0" mass=".3"/><site name="grip"/></body></worldbody></mujoco>"""
    )
    assert hand_for(load_scene(path)).stiffness == pytest.approx(600.0, rel=1e-6)


@pytest.mark.parametrize("hands", [("grip",), ("grip", "other")])
def test_a_hand_that_feels_no_weight_is_no_firmer(
    call: Called, tmp_path: Path, hands: tuple[str, ...]
) -> None:
    path = tmp_path / "weight.xml"
    path.write_text(
        """<mujoco><worldbody>
        <body><freejoint/><geom size=".03" mass=".5"/><site name="grip"/></body>
        <body pos="1 0 0"><freejoint/><geom size=".03" mass=".5"/><site name="other"/></body>
        </worldbody></mujoco>"""
    )
    held = [word for grip in hands for word in ("--hand", f"{grip}=simulated")]
    held = held if len(hands) > 1 else ["--grip", "grip"]
    words = ("run", path, "--fast", "--duration", 0.02, *held)
    for more, is_firmer in (((), True), (("--no-tool-weight",), False)):
        code, _, err = call(*words, *more)
        assert code == 0
        assert ("grips with 981 N/m instead of 135" in err) == is_firmer
        scene = load_scene(path, grip="grip")
        options = hb.BridgeOptions(tool_weight=is_firmer)
        with hb.Bridge(scene, clock=hb.SimulatedClock(), options=options) as bridge:
            assert isinstance(bridge.device, SimulatedDevice)
            assert isinstance(bridge.device.hand, Hand)
            assert (bridge.device.hand.stiffness > 135.0) == is_firmer


def test_a_hand_holds_a_hinged_bar_by_force_and_turn_as_its_springs_share_them(
    tmp_path: Path,
) -> None:
    """K r and K_r bear the torque of 12 N m at r = 2 m together: f = 12 r/(r² + K_r/K)."""
    path = tmp_path / "bar.xml"
    path.write_text(
        """<mujoco><option gravity="0 0 -10"/><worldbody><body><joint axis="0 1 0"/>
        <geom size=".02" pos="1 0 0" mass="1.2"/><site name="grip" pos="2 0 0"/></body></worldbody>
        </mujoco>"""
    )
    force = 12.0 * 2.0 / (4.0 + 1.0 / 135.0)
    assert hand_for(load_scene(path)).stiffness == pytest.approx(force / 0.005, rel=1e-6)
