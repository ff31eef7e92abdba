"""The probe before the force: directions, delays, refusals, and what it gives the hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import rewritten
from numpy.typing import NDArray
from own_device import Array, OwnDevice
from random_hands import random_hand
from scipy.linalg import expm
from two_hands import SCENES, two_handed

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.probe import Direction, Probed, ProbedHand, probe_devices
from hapticbridge.device import DeviceInfo, Hand, Motion, SimulatedDevice
from hapticbridge.kernel.record import SAMPLE_DTYPE

T = 1e-3

ARM, FINGERS, LIGHT = (0.65, 135.0, 6.5), (0.1, 30.0, 2.0), (0.04, 10.0, 0.5)
"""Mass in kg, stiffness in N/m and damping in N s/m of hands, handle included."""

Turn = Callable[[Array], Array]


def _right(wrench: Array) -> Array:
    return wrench


def _reversed_y(wrench: Array) -> Array:
    return wrench * (1.0, -1.0, 1.0, 1.0, 1.0, 1.0)


def _exchanged(wrench: Array) -> Array:
    x, y, *rest = wrench
    return np.array([y, -x, *rest])


class Wired(OwnDevice):
    """An own device whose motors get another wrench than was written."""

    def __init__(self, hand: tuple[float, float, float], turn: Turn = _right, **changes: Any):
        mass, stiffness, damping = hand
        own = dict[str, Any](mass=mass, start=(0.0, 0.0)) | changes
        super().__init__((stiffness, damping), **own)
        self._turn, self.reads = turn, 0

    def read(self, sample: NDArray[np.void]) -> int:
        self.reads += 1
        return super().read(sample)

    def write(self, wrench: Array) -> None:
        super().write(self._turn(wrench))


def opened(device: OwnDevice, **options: Any) -> hb.Bridge:
    options = dict[str, Any](probe=True, clock=hb.SimulatedClock()) | options
    return hb.Bridge("virtual_wall", device, **options)


@pytest.mark.parametrize("hand", [ARM, FINGERS, LIGHT])
def test_a_device_that_moves_as_it_is_pushed_runs(
    hand: tuple[float, float, float], tmp_path: Path
) -> None:
    device, path = Wired(hand), tmp_path / "run.mcap"
    with opened(device, recording=path) as bridge:
        summary = bridge.run(0.5)
    assert summary.probe == "x, y, z answered the right way"
    assert summary.is_certified
    assert device.gained <= 1e-3  # with what the force itself moved
    report = audit(path)
    assert report.certified
    assert report.resimulation == "bit for bit"
    [event] = [e for e in hb.read_recording(path).events if e["event"] == "probe"]
    assert event["axes"] == {"x": "right", "y": "right", "z": "right"}
    assert event["added_delay"] == 0.0


@pytest.mark.parametrize("hand", [ARM, FINGERS, LIGHT])
@pytest.mark.parametrize(
    ("turn", "words"),
    [
        (_reversed_y, "along y moved the device 'own' backwards: its axis y is reversed"),
        (_exchanged, "along x moved the device 'own' along y: its axis x is exchanged"),
    ],
)
def test_a_wrong_axis_is_refused_before_the_force(
    hand: tuple[float, float, float], turn: Turn, words: str, tmp_path: Path
) -> None:
    device, path = Wired(hand, turn), tmp_path / "run.mcap"
    with opened(device, recording=path) as bridge, pytest.raises(hb.SafetyTrip, match=words):
        bridge.run(0.5)
    assert device.gained <= 8e-3
    summary = bridge.summary()
    assert (summary.verdict, summary.is_certified) == ("empty", None)
    assert "passive" not in str(summary)
    recording = hb.read_recording(path)
    assert len(recording.ticks) == 0
    assert [e["event"] for e in recording.events][-3:] == ["probe", "trip", "stop"]
    report = audit(path)
    assert (report.verdict, report.exit_code, report.certified) == ("empty", 1, None)
    nothing = "the recording holds no tick, so there is nothing to judge"
    assert report.reason.startswith(
        f"{nothing}; the guard tripped at tick 0: a small force {words}"
    )


def test_a_wrong_axis_behind_a_soft_coupling_gives_next_to_nothing() -> None:
    """Without the probe it swings at 2 Hz, and the hand got up to 7 J."""
    device = Wired(ARM, _exchanged)
    coupling = hb.Coupling(150.0, 0.1)
    with (
        hb.Bridge(
            "virtual_wall", device, coupling, clock=hb.SimulatedClock(), probe=True
        ) as bridge,
        pytest.raises(hb.SafetyTrip, match="its axis x is exchanged"),
    ):
        bridge.run(1.0)
    assert device.gained <= 8e-3


@pytest.mark.parametrize(("late", "stated"), [(5, 0), (3, 0), (5, 5), (0, 3)])
def test_a_delay_counts_if_it_is_longer_than_the_stated_one(
    late: int, stated: int, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    sheet: dict[str, Any] = {"delay": 1e-3 * stated, "is_delay_measured": True}
    device = Wired(FINGERS, late=lambda _: late, **sheet)
    with opened(device, recording=path) as bridge:
        summary = bridge.run(0.3)
    [event] = [e for e in hb.read_recording(path).events if e["event"] == "probe"]
    added = 1e-3 * max(late - stated, 0)
    assert event["added_delay"] == pytest.approx(added, abs=4e-4)
    assert ("the force acts" in summary.probe) == (late > stated)
    assert summary.is_certified is (late <= stated)
    report = audit(path)
    assert report.certified is (late <= stated)
    assert ("forces follow" in report.reason) == (late > stated)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("added_delay", ("soon", -1.0, 9.0)),
        ("axes", ("x", {"x": "left"}, {"w": "right"}, {"x": 1}, {"x": []})),
    ],
)
def test_a_result_that_no_probe_gives_is_refused_by_the_audit(
    tmp_path: Path, name: str, values: tuple[object, ...]
) -> None:
    path, damaged = tmp_path / "run.mcap", tmp_path / "damaged.mcap"
    with opened(Wired(FINGERS), recording=path) as bridge:
        bridge.run(0.1)
    for value in values:
        events = [
            each | {name: value} if each["event"] == "probe" else each
            for each in hb.read_recording(path).events
        ]
        report = audit(rewritten(hb.read_recording(path), damaged, events=events))
        assert report.verdict == "invalid"
        assert name in report.reason


def test_a_hand_that_holds_too_firmly_is_not_judged_and_the_certificate_says_so(
    tmp_path: Path,
) -> None:
    """1 N moves it by 1 µm, and the encoder's step is 20 µm."""
    device = Wired((0.5, 1e6, 100.0), _reversed_y, step=2e-5, resolution=2e-5)
    path = tmp_path / "run.mcap"
    with opened(device, recording=path) as bridge:
        summary = bridge.run(0.3)
    still = "the positions of x, y, z never changed (sensor, cable, axis or a firm hand)"
    assert summary.probe == still
    assert device.gained <= 1e-3
    said = "; the probe could not tell if the motors of x, y, z push the right way"
    assert said in summary.certification.words
    judged = audit(path).certification
    assert judged is not None
    assert said in judged.words


def test_an_axis_whose_position_never_changes_is_told_from_one_that_answers_unclearly() -> None:
    class Stuck(Wired):
        """An own device whose second encoder is broken."""

        def read(self, sample: NDArray[np.void]) -> int:
            flags = super().read(sample)
            sample["position"][0, 1] = 0.01
            return flags

    with opened(Stuck(FINGERS)) as bridge:
        summary = bridge.run(0.1)
    still = "the position of y never changed (sensor, cable, axis or a firm hand)"
    assert summary.probe == f"x, z answered the right way, {still}"
    assert (
        "the probe could not tell if the motors of y push the right way"
        in summary.certification.words
    )


@pytest.mark.parametrize(
    ("sheet", "options", "words"),
    [
        ({"rate": 100.0}, {}, "it gives a sample in 10 ms, and a probe needs one in 4 ms"),
        ({"buttons": 1}, {"dead_man": 0}, "its force needs a button"),
    ],
)
def test_a_device_that_cannot_be_probed_is_told_why(
    sheet: dict[str, Any], options: dict[str, Any], words: str
) -> None:
    device = Wired(FINGERS, _reversed_y, **sheet)
    with opened(device, **options, rate=1000.0) as bridge:
        bridge.session.start_clock()
        assert device.through == 0.0
        assert bridge.summary().probe == f"not probed: {words}"


@pytest.mark.parametrize(
    ("is_real", "probe", "is_probed"),
    [(True, None, True), (True, False, False), (False, None, False), (False, True, True)],
)
def test_real_devices_are_probed_unless_it_is_declined(
    is_real: bool, probe: bool | None, is_probed: bool
) -> None:
    device = Wired(FINGERS)
    device.info = replace(device.info, is_real=is_real)
    clock = hb.RealClock() if is_real else hb.SimulatedClock()
    assert opened(device, probe=probe, clock=clock).setup.is_probed is is_probed


def test_a_prescribed_motion_is_never_probed() -> None:
    device = Wired(FINGERS)
    device.info = replace(device.info, is_prescribed=True, damping=None)
    assert not opened(device).setup.is_probed


class Port:
    """Port to one simulated device, whose motors get another wrench."""

    def __init__(self, device: SimulatedDevice, turn: Turn) -> None:
        self._device, self._turn = device, turn

    def read(self, sample: NDArray[np.void]) -> list[int]:
        return [self._device.read(sample)]

    def write(self, wrench: Array) -> None:
        self._device.write(np.asarray(self._turn(wrench[0])))


def probed(device: SimulatedDevice, turn: Turn) -> Probed:
    clock, sample = SimulatedClock(), device.start(T)
    clock.start(round(1e9 * T))
    hands = [ProbedHand(device.info, Limits(force=10.0, torque=0.5), T)]
    [found] = probe_devices(Port(device, turn), sample, hands, clock)
    return found


def test_random_hands_are_told_from_reversed_axes() -> None:
    """Two fingers to an arm that grips hard, at rest, with steps of 20 µm."""
    still = Motion([0.0, 9.0], [(0.0, 0.0, 0.0)] * 2)
    for seed in range(12):
        hand = random_hand(seed)
        device = SimulatedDevice(hand=hand, path=still, resolution=2e-5)
        right, wrong = probed(device, _right), probed(device, np.negative)
        assert [each.direction for each in right.answers[:3]] == [Direction.RIGHT] * 3
        assert not any(each.is_wrong for each in right.answers)
        assert right.delay == 0.0
        assert [each.direction for each in wrong.answers] == [Direction.REVERSED]


def test_a_hand_that_trembles_is_not_taken_for_a_reversed_axis() -> None:
    """A firm hand moves by 0.3 mm at 7 to 12 Hz, more than 1 N moves it."""
    firm = Hand(mass=0.4, stiffness=3000.0, damping=40.0)
    for seed in range(12):
        generator, times = np.random.default_rng(seed), np.arange(0.0, 6.0, 2e-3)
        turns = 2.0 * np.pi * generator.uniform(7.0, 12.0, 3) * times[:, None]
        tremor = 3e-4 * np.sin(turns + generator.uniform(0.0, 6.0, 3))
        for hand in (firm, random_hand(seed)):
            device = SimulatedDevice(hand=hand, path=Motion(times, tremor), dof=3)
            assert not any(each.is_wrong for each in probed(device, _right).answers)


def moving(seed: int) -> Motion:
    """Returns slow reaches of up to 30 mm and a tremor of a hand, drawn at random."""
    generator, times = np.random.default_rng(seed), np.arange(0.0, 12.0, 2e-3)
    rates, sizes = generator.uniform(0.2, 1.5, (3, 4)), generator.uniform(0.0, 1.0, (3, 4))
    phases, reach = generator.uniform(0.0, 7.0, (3, 4)), 0.03 * generator.uniform(0.02, 1.0, 3)
    turns = 2.0 * np.pi * rates[:, :, None] * times + phases[:, :, None]
    shares = reach[:, None] * sizes / sizes.sum(axis=1, keepdims=True)
    slow = np.einsum("ij,ijk->ki", shares, np.sin(turns) - np.sin(phases)[:, :, None])
    size = 3e-4 * generator.uniform(0.1, 2.0)
    shakes = 2.0 * np.pi * generator.uniform(4.0, 13.0, 3) * times[:, None]
    shaken = size * np.sin(shakes + generator.uniform(0.0, 6.0, 3))
    way = (slow if generator.random() < 0.5 else 0.0) + shaken
    return Motion(times, way - way[0])


@pytest.mark.parametrize("seed", [400, *range(12)])
def test_a_hand_that_moves_by_itself_is_not_taken_for_a_reversed_axis(seed: int) -> None:
    """Two like findings are not enough: of 500 such hands, that of seed 400 had them."""
    device = SimulatedDevice(hand=random_hand(seed), path=moving(seed), dof=3)
    assert not any(each.is_wrong for each in probed(device, _right).answers)


class Leaning:
    """Port to a device in a hand whose stiff and heavy direction is turned against its axes."""

    def __init__(self) -> None:
        c, s = np.cos(2.853), np.sin(2.853)
        axes = np.array([[c, -s], [s, c]])
        mass, stiffness, damping = (
            axes @ np.diag(values) @ axes.T
            for values in ((0.406, 2.805), (497.3, 215.3), (1.49, 1.09))
        )
        matrix, inverse = np.zeros((6, 6)), np.linalg.inv(mass)
        matrix[:2, 2:4] = np.eye(2)
        matrix[2:4] = inverse @ np.hstack([-stiffness, -damping, np.eye(2)])
        self._step, self._state = expm(matrix * T), np.zeros(6)

    def read(self, sample: NDArray[np.void]) -> list[int]:
        self._state = self._step @ self._state
        sample["position"][0, :2] = self._state[:2]
        return [0]

    def write(self, wrench: Array) -> None:
        self._state[4:] = wrench[0, :2]


def test_a_hand_that_yields_sideways_is_not_taken_for_exchanged_axes() -> None:
    """It moves as far along x as along y under a force along y, and fits better there."""
    sample, clock = np.zeros(1, SAMPLE_DTYPE), SimulatedClock()
    sample["quaternion"][:, 0] = 1.0
    clock.start(round(1e9 * T))
    info = DeviceInfo(
        name="own", axes=("x", "y"), damping=1.0, delay=0.0, force_limit=10.0, is_real=False
    )
    hands = [ProbedHand(info, Limits(force=10.0), T)]
    [found] = probe_devices(Leaning(), sample, hands, clock)
    assert not any(each.is_wrong for each in found.answers)


def test_a_stop_ends_the_probe_and_the_run() -> None:
    device = Wired(FINGERS)
    with opened(device) as bridge:
        bridge.stop()
        summary = bridge.run(1.0)
    assert summary.ticks == 0
    assert summary.probe == ""
    assert device.through == 0.0


def test_a_second_run_is_not_probed_again() -> None:
    device = Wired(FINGERS)
    with opened(device) as bridge:
        bridge.run(0.1)
        reads = device.reads
        bridge.run(0.1)
    assert device.reads == reads + 100


def test_the_axis_of_one_of_two_hands_is_named() -> None:
    good, bad = Wired(ARM), Wired(ARM, _reversed_y)
    bad.info = replace(bad.info, name="second")
    grasps = [hb.Grasp("left", good), hb.Grasp("right", bad)]
    scene = two_handed(SCENES["bar"])
    with (
        hb.Bridge(scene, grasps, clock=hb.SimulatedClock(), probe=True) as bridge,
        pytest.raises(hb.SafetyTrip, match="the device 'second' backwards"),
    ):
        bridge.run(0.3)
    first, second = bridge.session.probed
    assert first is not None
    assert second is not None
    assert not any(each.is_wrong for each in first.answers)
