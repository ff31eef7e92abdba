"""Runs on a device with a loop of its own, whose firmware is compiled here, in virtual time."""

from __future__ import annotations

import contextlib
import ctypes
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_attack import built_loop
from cli_cases import Called, facts_of
from emulated.board_model import POSE, BoardSheet, LoopBoard
from emulated.hid_seam import DrivingClock, HidSeam
from firmware_build import COMPILER

import hapticbridge as hb
from hapticbridge.cli.guide import page
from hapticbridge.demand.certificate import conditions_of
from hapticbridge.demand.guard import FADE
from hapticbridge.demand.own_loop import REPORT_DTYPE, ROUNDING, OwnLoopTally
from hapticbridge.device import Motion, SimulatedDevice
from hapticbridge.device.own_loop import BoardSetting, LoopReport, LoopState, ShownTool
from hapticbridge.device.rawhid.device import RawHidDevice, open_rawhid
from hapticbridge.device.simulated.device import hand_for
from hapticbridge.device.watchdog import watchdog_time
from hapticbridge.errors import DeviceError, SafetyTrip
from hapticbridge.kernel.pose import product, quaternion_exp, rotation_between
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.run.commands import Couple, Reset, Switch
from hapticbridge.run.own_loop import OwnLoop

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler on this machine")

STIFF = {"stiffness": 15e3, "damping": 0.0}


@pytest.fixture(scope="module", name="library")
def _library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return built_loop(tmp_path_factory.mktemp("loop"))


class Bench:
    """A board behind the real driver, in a hand that goes with a scene."""

    def __init__(
        self,
        library: ctypes.CDLL,
        scene: str = "virtual_wall",
        sheet: BoardSheet | None = None,
        link: float = 0.5e-3,
        path: str | Motion | None = None,
        **options: object,
    ) -> None:
        self.scene, own = hb.load_scene(scene), sheet or BoardSheet()
        hand = hand_for(self.scene)
        friction = 0.1 if np.isnan(own.friction) else own.friction
        mechanics = SimulatedDevice(
            hand=hand,
            mass=own.mass,
            damping=own.damping,
            friction=friction,
            rotational_inertia=own.rotational_inertia,
            rotational_damping=own.rotational_damping,
            path=path,
        )
        self.mechanics, self.board = mechanics, LoopBoard(library, mechanics, own, link)
        self.seam, self.said = HidSeam(self.board), list[str]()
        self.device = self.opened(**options)

    def opened(self, **options: object) -> RawHidDevice:
        """Opens the board, which has run since its start."""
        return open_rawhid(options, self.said.append, self.seam, lambda: self.seam.now)

    def bridge(self, coupling: Any = None, **options: Any) -> hb.Bridge:
        clock = DrivingClock(self.seam)
        return hb.Bridge(self.scene, self.device, coupling=coupling, clock=clock, **options)

    @property
    def gained(self) -> float:
        """Energy in J that the motors gave the handle beyond what its damping burned."""
        return self.board.work - self.board.burned


def test_the_boards_loop_bears_what_the_hosts_does_not(library: ctypes.CDLL) -> None:
    """The same device behind the same link, 2 ms to and fro, at the same wall."""
    stiff = Bench(library, link=1e-3)
    with stiff.bridge(STIFF) as bridge:
        summary = bridge.run(2.0)
    assert summary.is_certified
    assert summary.environment == "strict"
    assert stiff.gained < ROUNDING

    usual = Bench(library, link=1e-3, loop_rate=0.0)
    assert usual.device.info.loop_period is None
    with usual.bridge() as bridge:
        summary = bridge.run(2.0)
        assert bridge.setup.law.stiffness < 1e3
    assert summary.is_certified
    assert usual.gained < ROUNDING

    swinging = Bench(
        library, sheet=BoardSheet(friction=0.0, resolution=0.0), link=1e-3, loop_rate=0.0
    )
    with swinging.bridge(STIFF) as bridge:
        summary = bridge.run(2.0)
    assert not summary.is_certified
    assert swinging.gained > 1e3 * ROUNDING


SCENES = "virtual_wall", "screwdriver", "hammer", "point_mass"


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("link", [0.0, 2e-3, 10e-3])
def test_no_hand_gains_energy_whatever_the_link(
    library: ctypes.CDLL, scene: str, link: float
) -> None:
    bench = Bench(library, scene, BoardSheet(friction=0.0, resolution=0.0), link)
    with bench.bridge() as bridge:
        summary = bridge.run(1.5)
        own = bridge.session.setup.law
    assert own.damping == 0.0
    assert summary.is_certified
    assert bench.gained < ROUNDING


def test_a_scene_may_be_scaled_turned_and_slow(library: ctypes.CDLL, tmp_path: Path) -> None:
    """The board's tool, in the device's frame, is where the scene has it."""
    turned = hb.Workspace(scale=2.0, axes=((0, 1, 0), (0, 0, 1), (1, 0, 0)))
    bench = Bench(library, "point_mass", BoardSheet(friction=0.0, resolution=0.0))
    path, found = tmp_path / "run.mcap", {}
    options: dict[str, Any] = {"workspace": turned, "rate": 250.0, "recording": path}
    with bench.bridge(**options) as bridge:

        def on_tick(tick: int) -> None:
            report = bench.device.loop_report
            if tick > 100 and report is not None and report.tool not in found:
                [row] = bridge.latest_records(1)
                found[report.tool] = row["tool_position"].copy()

        summary = bridge.run(1.5, on_tick)
        parameters = bridge.session.parameters
    shown, tool = np.array(list(found)), np.array(list(found.values()))
    origin = np.array(parameters.device_origin[:3])
    axes = np.array(parameters.axes).reshape(3, 3)
    mapped = parameters.handle_origin[:3] + 2.0 * (shown - origin) @ axes.T
    assert np.ptp(tool, axis=0).max() > 0.01
    assert np.abs(mapped - tool).max() < 0.1 * np.ptp(tool, axis=0).max()
    assert summary.is_certified
    assert bench.gained < ROUNDING
    assert hb.audit(path, in_process=True).verdict == "passive"


SIX_AXES = BoardSheet(axes=0b111111 | POSE, friction=0.0, resolution=0.0)

KNOB = """<mujoco><worldbody><body><joint type="hinge" axis="0 0 1" range="-20 20" limited="true"/>
<geom type="cylinder" size=".03 .01" mass=".1"/><site name="grip"/></body></worldbody></mujoco>"""


def test_a_knob_feels_the_stop_of_a_hinge(library: ctypes.CDLL, tmp_path: Path) -> None:
    """A device that only turns: 1 mN m s/rad, 10 kHz, a stop at 20 degrees."""
    (tmp_path / "knob.xml").write_text(KNOB)
    times = np.linspace(0.0, 3.0, 301)
    half = 0.5 * 0.6 * np.sin(np.pi * np.clip(times / 3.0, 0.0, 1.0)) ** 2
    table = np.column_stack(
        [times, np.zeros((301, 3)), np.cos(half), np.zeros((301, 2)), np.sin(half)]
    )
    sheet = replace(
        SIX_AXES, axes=0b100000, rotational_damping=1e-3, rotational_inertia=1e-5, torque_limit=0.05
    )
    motion, path = Motion(times, table[:, 1:4], table[:, 4:]), tmp_path / "run.mcap"
    bench = Bench(library, str(tmp_path / "knob.xml"), sheet, path=motion)
    assert (bench.device.info.axes, bench.device.info.loop_period) == (("rz",), 1e-4)
    with bench.bridge(recording=path) as bridge:
        summary = bridge.run(1.6)
        ticks = bridge.latest_records(800)
    stiffness = bridge.setup.law.rotational_stiffness
    assert stiffness > 5.0  # 0.4 behind the link
    deepest = ticks[np.argmax(np.abs(ticks["wrench_on_device"][:, 5]))]
    assert -deepest["wrench_on_device"][5] == pytest.approx(0.05, rel=1e-3)
    assert summary.is_certified
    assert bench.gained < ROUNDING
    assert hb.audit(path, in_process=True).verdict == "passive"


@pytest.mark.parametrize("scene", ["peg_in_hole", "screwdriver", "hex_key"])
@pytest.mark.parametrize("link", [0.0, 5e-3])
def test_a_six_axis_board_gives_no_hand_energy(
    library: ctypes.CDLL, tmp_path: Path, scene: str, link: float
) -> None:
    bench, path = Bench(library, scene, SIX_AXES, link), tmp_path / "run.mcap"
    with bench.bridge(recording=path) as bridge:
        summary = bridge.run(1.5)
    law = bridge.setup.law
    assert law.rotational_stiffness > 10.0
    assert law.rotational_damping == 0.0
    assert summary.is_certified
    assert [each.axis for each in summary.certification.conditions] == ["translation", "rotation"]
    assert summary.peak_torque > 2e-3
    assert bench.gained < ROUNDING
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.agreement) == ("passive", "bit for bit")


def test_the_boards_torque_bears_what_the_hosts_does_not(library: ctypes.CDLL) -> None:
    """The same six-axis device behind 2 ms, at the same rotational stiffness."""
    stiff = {"rotational_stiffness": 20.0, "rotational_damping": 0.0}
    board = Bench(library, "hex_key", SIX_AXES, 1e-3)
    with board.bridge(stiff) as bridge:
        summary = bridge.run(2.0)
    assert summary.is_certified
    assert board.gained < ROUNDING
    host = Bench(library, "hex_key", SIX_AXES, 1e-3, loop_rate=0.0)
    assert host.device.info.loop_period is None
    with host.bridge() as bridge:
        assert bridge.run(0.5).is_certified
        assert bridge.setup.law.rotational_stiffness < 2.0
    assert host.gained < ROUNDING
    swinging = Bench(library, "hex_key", SIX_AXES, 1e-3, loop_rate=0.0)
    with contextlib.suppress(SafetyTrip), swinging.bridge(stiff) as bridge:
        bridge.run(2.0)
    assert bridge.summary().is_certified is False
    assert swinging.gained > 100.0 * ROUNDING


def test_rotations_of_a_turned_and_scaled_scene_are_shown_as_they_are(
    library: ctypes.CDLL, tmp_path: Path
) -> None:
    """The board is shown the tool's rotation in the device's frame; angles are not scaled."""
    turned = hb.Workspace(scale=2.0, axes=((0, 1, 0), (0, 0, 1), (1, 0, 0)))
    path, times = tmp_path / "run.mcap", np.linspace(0.0, 1.5, 151)
    half = 0.2 * np.sin(np.pi * np.clip(times - 0.5, 0.0, 1.0))  # after the rise of the force
    away = np.column_stack([np.cos(half), np.zeros((151, 2)), np.sin(half)])
    motion = Motion(times, np.zeros((151, 3)), away)
    bench = Bench(library, "peg_in_hole", SIX_AXES, path=motion)
    found: list[tuple[Any, Any]] = []
    show = bench.device.show

    def note(shown: ShownTool) -> int:
        if rows := len(bridge.latest_records(1)):
            found.append((shown.rotation, bridge.latest_records(rows)["tool_quaternion"][0].copy()))
        return show(shown)

    bench.device.show = note  # type: ignore[method-assign]
    with bench.bridge(workspace=turned, recording=path) as bridge:
        summary = bridge.run(1.4)
        parameters = bridge.session.parameters
    axes = np.array(parameters.axes).reshape(3, 3)
    w, *begin = parameters.handle_origin[3:]
    angles = []
    for rotation, tool in found:
        x, y, z = (axes @ np.array(rotation)).tolist()
        mapped = product(quaternion_exp((x, y, z)), (w, begin[0], begin[1], begin[2]))
        angles.append(np.linalg.norm(rotation_between(tuple(tool), mapped)))
    assert max(np.linalg.norm(rotation) for rotation, _ in found) > 0.3
    assert max(angles) < 0.03
    assert summary.is_certified
    assert bench.gained < ROUNDING
    assert hb.audit(path, in_process=True).verdict == "passive"


def test_a_boards_rotation_that_it_does_not_render_stays_with_the_bridge(
    library: ctypes.CDLL,
) -> None:
    """A board from before, and a handle about two axes; one about one axis beside lines has it."""
    for axes, has_own in (
        (0b111111, False),
        (0b011111 | POSE, False),
        (0b100111 | POSE, True),
        (0b111000 | POSE, True),
    ):
        bench = Bench(library, "point_mass", replace(SIX_AXES, axes=axes))
        assert (bench.device.info.loop_period is not None) is has_own
        idle = [each for each in bench.said if "the loop on the board of 'board' does not" in each]
        assert len(idle) == (not has_own)
        assert not Bench(library, "point_mass", SIX_AXES, loop_rate=0.0).said
        with bench.bridge() as bridge:
            summary = bridge.run(0.4)
        assert summary.is_certified
        assert bench.gained < ROUNDING


def test_states_without_their_rotation_are_lost(library: ctypes.CDLL) -> None:
    bench = Bench(library, "peg_in_hole", SIX_AXES)

    def lose(tick: int) -> None:
        bench.board.loses_turns = 200 <= tick < 220

    with bench.bridge() as bridge:
        summary = bridge.run(0.4, lose)
    assert 18 <= bench.device.states.lost <= 21
    assert summary.is_certified
    assert bench.gained < ROUNDING


def test_a_recorded_run_repeats_to_the_bit_with_commands(
    library: ctypes.CDLL, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    bench = Bench(library, "screwdriver")
    commands: dict[int, Any] = {
        400: Couple(stiffness=3e3, damping=0.0),
        700: Switch(force=False),
        900: Switch(force=True),
        1200: Reset(),
    }
    with bench.bridge(recording=path) as bridge:

        def on_tick(tick: int) -> None:
            if tick in commands:
                bridge.command(commands[tick])

        bridge.run(1.0, on_tick)
        bridge.run(1.0, on_tick)
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.agreement) == ("passive", "bit for bit")
    assert report.certification is not None
    assert report.certification.own_loop is not None
    live = bridge.summary().certification.own_loop
    assert report.certification.own_loop == live
    assert "its board alone knows" in report.unchecked
    assert bench.gained < ROUNDING


def test_a_force_that_is_off_stays_off_and_comes_back(library: ctypes.CDLL) -> None:
    bench = Bench(library)
    with bench.bridge() as bridge:
        bridge.run(0.8)
        assert np.linalg.norm(bench.board.force) > 1.0
        bridge.command(Switch(force=False))
        bridge.run(0.5)
        assert np.linalg.norm(bench.board.force) == 0.0
        bridge.command(Switch(force=True))
        bridge.run(0.5)
        assert np.linalg.norm(bench.board.force) > 1.0
    bench.seam.advance(bench.seam.now + 0.05)
    assert np.linalg.norm(bench.board.force) == 0.0


def test_periods_that_the_board_misses_count(library: ctypes.CDLL) -> None:
    bench = Bench(library, sheet=BoardSheet(resolution=0.0, friction=0.0))
    with bench.bridge({"stiffness": 30e3, "damping": 0.0}) as bridge:
        bench.board.skip_every = 4
        summary = bridge.run(1.0)
    own = summary.certification.own_loop
    assert own is not None
    assert own.missed > 2000
    assert summary.certification.is_by_time
    assert not summary.is_certified
    assert "10 kHz" in str(summary)
    assert "--realtime" not in str(summary)
    assert "less work for the board" in str(summary)


def reports(*rows: tuple[int, float, float, float]) -> Any:
    return np.array(list(rows), REPORT_DTYPE)


def test_a_board_that_gives_more_than_the_scene_released_is_found() -> None:
    tally = OwnLoopTally.begin(1e-4, 0.0)
    # the scene released 5 mJ, and took it again: the hand may keep what it got
    tally.add(reports((0, 0.0, 1.0, 0.0), (1, -5e-3, 0.999, 4e-3), (2, 0.0, 0.995, -5e-3)), {})
    assert tally.account.first_excess is None
    tally.add(reports((3, 0.0, 0.9949, -5e-3)), {})
    first = tally.account.first_excess
    assert first is not None
    assert first == (3, pytest.approx(1e-4))
    assert "does not keep its account" in tally.account.fault


def test_what_a_board_cannot_have_is_left_to_the_bridge(library: ctypes.CDLL) -> None:
    with pytest.raises(DeviceError, match="loop_rate is 5000 Hz; it must be 0"):
        Bench(library, loop_rate=5e3)
    refused = Bench(library, "point_mass")
    with refused.bridge(method="weld", i_know=True) as bridge:
        assert not bridge.setup.info.loop_period


def test_a_silent_host_lets_the_force_go_in_the_time_that_the_guide_says(
    library: ctypes.CDLL,
) -> None:
    bench, forces = Bench(library), []

    def cut(tick: int) -> None:
        bench.board.is_cut = tick >= 800
        forces.append(float(np.linalg.norm(bench.board.force)))

    with bench.bridge() as bridge:
        bridge.run(0.86, cut)
    after = forces[800:]
    silence, fade = 1e3 * watchdog_time(1e-3), 1e3 * FADE
    end = round(silence + fade)
    assert after[round(silence) - 2] > 0.9 * after[0] > 1.0
    assert after[end - 4] > 0.0
    assert after[end + 2] == 0.0
    words = f"at least {silence:g} ms | the force fades in another {fade:g} ms: at 1 kHz it is zero"
    assert f"{words} {end} ms after the last pose" in page("stiff-device")


@pytest.mark.parametrize("loop_delay", [1e-5, 1.5e-4])
@pytest.mark.parametrize("stiffness", [1e3, 15e3, 60e3])
def test_bound_states_the_condition_of_a_run(
    library: ctypes.CDLL, call: Called, stiffness: float, loop_delay: float
) -> None:
    bench = Bench(library, sheet=BoardSheet(loop_delay=loop_delay))
    coupling = {"stiffness": stiffness, "damping": 3.0}
    with bench.bridge(coupling) as bridge:
        (condition,) = conditions_of(bridge.setup.loop)
        assert bridge.conditions() == (condition.sentence(),)
    own = f"--loop-rate 1e4 --loop-delay {loop_delay}"
    device = "simulated:damping=2,friction=0.1,resolution=1e-5"
    judged = f"bound --stiffness {stiffness} --damping 3 {own} --device {device}"
    code, out, err = call(*judged.split())
    assert condition.sentence() in out.replace("\n", " ")
    assert (code, err) == (int(not condition.holds), "")
    assert "in its own loop" in out


JUDGED = "bound --stiffness 15000 --loop-rate 1e4 --loop-delay 1e-5"


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (f"{JUDGED} --device-damping 2 --plot x.png", "for a loop on the computer"),
        (JUDGED, "--loop-rate goes with --device or --device-damping"),
        ("bound --stiffness 1 --loop-rate 1e4 --device-damping 2", "needs --loop-delay"),
        ("bound --stiffness 1 --loop-delay 1e-5 --device-damping 2", "has no effect"),
        ("run point_mass --device simulated:loop_rate=1e4", "'hapticbridge bound --loop-rate HZ"),
    ],
)
def test_a_loop_that_cannot_be_judged_is_refused(call: Called, command: str, message: str) -> None:
    code, out, err = call(*command.split())
    assert (code, out, message in err.replace("\n", " ")) == (2, "", True)


def test_bound_judges_a_board_that_is_not_built(call: Called) -> None:
    for damping, is_enough in ((1.0, True), (0.9, False)):
        code, facts = facts_of(call, *JUDGED.split(), "--device-damping", damping)
        # K (T_b/2 + 1.5 t)
        assert (code, facts["needed"]) == (int(not is_enough), pytest.approx(0.975, rel=1e-3))


class Jerky:
    """A device whose own loop reports a force at the end of each move, and none before it."""

    info = hb.DeviceInfo(
        name="jerky", axes=("x",), force_limit=10.0, damping=2.0, delay=0.0, loop_period=1e-4
    )  # fmt: skip
    loop_report: LoopReport | None = None
    place, is_posed = (0.0, 0.0, 0.0), False

    def __init__(self) -> None:
        self.info = replace(self.info, is_real=False)
        self.loop_state: LoopState | None = None
        self.ticks = 0

    def start(self, period: float) -> Any:
        sample = np.zeros(1, hb.SAMPLE_DTYPE)
        sample["quaternion"][0, 0] = 1.0
        return sample

    def read(self, sample: Any) -> int:
        self.ticks += 1
        phase = self.ticks % 3  # back, out with a force, out without it
        self.place = (0.5e-3 * (phase > 0), 0.0, 0.0)
        force = (9.0 * (phase == 1), 0.0, 0.0)
        rest = (0.0,) * 3
        self.loop_state = LoopState(1, self.ticks, 0, 0, self.place, rest, force, 0.0, 0.0, 0)
        sample["position"][0], sample["quaternion"][0] = self.place, (1.0, 0.0, 0.0, 0.0)
        return 0

    def write(self, wrench: Any) -> None:
        pass

    def close(self) -> None:
        pass

    def set_loop(self, setting: BoardSetting) -> None:
        pass

    def show(self, shown: ShownTool) -> int:
        return 0


def test_work_between_two_samples_counts_as_the_least(tmp_path: Path) -> None:
    """A force that is there at the end of a move may have come there."""
    path = tmp_path / "run.mcap"
    clock = hb.SimulatedClock()
    with hb.Bridge("point_mass", Jerky(), clock=clock, recording=path) as bridge:
        summary = bridge.run(0.2)
    assert summary.hand_energy.unpaid == 0.0
    assert summary.hand_energy.net == 0.0
    report = hb.audit(path, in_process=True)
    assert report.agreement == "bit for bit"
    assert report.hand_energy.unpaid == 0.0


def test_another_run_on_the_same_board_begins_anew(library: ctypes.CDLL, tmp_path: Path) -> None:
    """The next run owes nothing for what the scene of the last one took or released."""
    bench = Bench(library, "screwdriver")
    with bench.bridge() as bridge:
        bridge.run(1.0)
    report = bench.device.loop_report
    assert report is not None
    assert report.work != 0.0
    bench.device = bench.opened()
    with bench.bridge(recording=tmp_path / "run.mcap") as bridge:
        bridge.run(0.6)
    own = bridge.summary().certification.own_loop
    assert own is not None
    assert own.first_excess is None
    assert own.passed > -ROUNDING
    assert bench.gained < ROUNDING
    assert hb.audit(tmp_path / "run.mcap", in_process=True).verdict == "passive"


def test_a_force_that_is_let_go_fades_in_the_time_of_the_host(library: ctypes.CDLL) -> None:
    """The slow ramp of a start is none of a dead-man button's."""
    bench, forces = Bench(library), []
    with bench.bridge(limits=hb.Limits(ramp=0.5)) as bridge:

        def on_tick(tick: int) -> None:
            if tick == 1500:
                bridge.command(Switch(force=False))
            forces.append(float(np.linalg.norm(bench.board.force)))

        bridge.run(1.6, on_tick)
    assert forces[1499] > 1.0
    assert forces[1530] == 0.0


@pytest.mark.parametrize("is_cut", [True, False])
def test_a_run_ends_what_an_earlier_program_has_left(
    library: ctypes.CDLL, tmp_path: Path, *, is_cut: bool
) -> None:
    """A program that dies behind a broken link leaves its coupling, its count and a tank."""
    bench, path = Bench(library), tmp_path / "run.mcap"

    def die(tick: int) -> None:
        if tick == 800:
            assert np.linalg.norm(bench.board.force) > 1.0
            bench.board.is_cut = is_cut
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), bench.bridge() as bridge:
        bridge.run(1.0, die)
    bench.board.is_cut = False
    bench.device = bench.opened()
    forces = []
    with bench.bridge(limits=hb.Limits(force=0.5), recording=path) as bridge:
        bridge.run(0.3, lambda _: forces.append(float(np.linalg.norm(bench.board.force))))
    assert 0.1 < max(forces) <= 0.5 * (1.0 + 1e-6)
    assert forces[0] == 0.0
    assert hb.audit(path, in_process=True).verdict == "passive"


class Answering:
    """A device that is shown tools, and answers the newest alone."""

    place, loop_report, is_posed = (0.0, 0.0, 0.0), None, False

    def __init__(self, info: hb.DeviceInfo) -> None:
        self.info, self.loop_state = info, loop_state(0, 0.0)
        self.shown: list[float] = []

    def read(self, _sample: object) -> int:
        return 0

    def set_loop(self, _setting: object) -> None:
        """Takes any coupling."""

    def show(self, shown: ShownTool) -> int:
        self.shown.append(shown.work)
        return len(self.shown)


def loop_state(echo: int, passed: float) -> LoopState:
    return LoopState(0, 0, 0, 0, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, passed, 0.0, echo)


@pytest.mark.parametrize(("passed", "is_paid"), [(-5e-3, True), (-6e-3, False)])
def test_what_a_tool_released_counts_if_no_report_answers_it(
    library: ctypes.CDLL, passed: float, *, is_paid: bool
) -> None:
    """The device may have used the work of a tool before that of the one which it answers."""
    bench = Bench(library, "point_mass")
    with bench.bridge() as bridge:
        bound, device = bridge.session.kernel.bound, Answering(bench.device.info)
        loop = OwnLoop(device, bound, bridge.session.parameters)  # type: ignore[arg-type]
        sample = np.zeros(1, SAMPLE_DTYPE)
        loop.read(sample)
        for work in (0.0, -5e-3, 1e-3):
            bound.state["energy"]["coupling_work"] = work
            loop.write(np.zeros(6))
        assert device.shown == pytest.approx([0.0, -5e-3, 1e-3])
        device.loop_state = loop_state(3, passed)
        loop.read(sample)
        assert loop.take_notes() is not None
    assert (loop.tally.account.first_excess is None) is is_paid
    assert loop.tally.account.work == pytest.approx(1e-3)


def test_a_board_that_does_not_count_its_periods_is_not_certified(library: ctypes.CDLL) -> None:
    bench = Bench(library)
    bench.board.has_counters = False
    with bench.bridge() as bridge:
        summary = bridge.run(1.5)
    assert summary.certification.is_by_time


def test_counters_of_a_board_may_begin_anew(library: ctypes.CDLL) -> None:
    tally = OwnLoopTally.begin(1e-4, 0.0)
    tally.add(reports(), {"changes": 1.0, "ticks": 2**32 - 10, "missed": 3})
    tally.add(reports(), {"changes": 3.0, "ticks": 20, "missed": 4})
    own = tally.account
    assert (own.periods, own.missed, own.changes) == (30, 1, 2.0)


class Leaving:
    """A hand that goes with a scene, and then gives way to the force at a constant speed."""

    def __init__(self, hand: SimulatedDevice, period: float, leaves_at: float) -> None:
        self._hand, self._step, self._left = hand, 0.1 * period, round(leaves_at / period)
        self._towards, self._place = np.zeros(3), np.zeros(3)

    def start(self, period: float) -> Any:
        return self._hand.start(period)

    def write(self, wrench: Any) -> None:
        if self._left > 0:
            self._hand.write(wrench)
            self._towards = np.array(wrench[:3]) / max(float(np.linalg.norm(wrench[:3])), 1e-9)

    def read(self, sample: Any) -> None:
        self._left -= 1
        if self._left > 0:
            self._hand.read(sample)
            self._place = sample["position"][0].copy()
        else:
            self._place += self._step * self._towards
            sample["position"][0] = self._place


class Stalling(DrivingClock):
    """Time in which a host does nothing for ``stall`` s, once."""

    stall = 0.0

    def wait(self) -> tuple[int, int, int]:
        period = super().wait()[0]
        skipped = round(self.stall / 1e-3)
        for _ in range(skipped):
            period = super().wait()[0]
        self.stall = 0.0
        return period, period, skipped


def test_a_silence_accuses_no_board(library: ctypes.CDLL, tmp_path: Path) -> None:
    """The host stalls for 150 ms, in which the hand leaves a wall and the force ends."""
    bench = Bench(library)
    leaving = Leaving(bench.mechanics, bench.board.sheet.period, 0.82)
    bench.board = LoopBoard(library, leaving, None, 0.5e-3)  # type: ignore[arg-type]
    bench.seam.plugged[0] = bench.board
    bench.device, clock = bench.opened(), Stalling(bench.seam)

    def stall(tick: int) -> None:
        if tick == 800:
            assert np.linalg.norm(bench.board.force) > 1.0
            clock.stall = 0.15

    path = tmp_path / "run.mcap"
    with hb.Bridge(bench.scene, bench.device, clock=clock, recording=path) as bridge:
        summary = bridge.run(1.1, stall)
    assert summary.is_certified
    report = hb.audit(path, in_process=True)
    assert (report.verdict, report.agreement) == ("passive", "bit for bit")
    assert report.certification is not None
    assert report.certification.verdict is True


def test_a_loop_that_does_not_state_its_delay_is_refused(library: ctypes.CDLL) -> None:
    for unknown in (0.0, float("nan")):
        sheet = BoardSheet(loop_delay=unknown)
        with pytest.raises(DeviceError, match="does not state its loop_delay"):
            Bench(library, sheet=sheet)
        assert Bench(library, sheet=sheet, loop_rate=0.0).device.info.loop_period is None
        stated = Bench(library, sheet=sheet, loop_delay=3e-5).device.info
        assert (stated.loop_period, stated.loop_delay) == (1e-4, 3e-5)


def test_a_certificate_with_unknown_friction_says_so_in_its_first_line(
    library: ctypes.CDLL,
) -> None:
    bench = Bench(library, sheet=BoardSheet(friction=float("nan")))
    with bench.bridge({"stiffness": 1e3, "damping": 0.0}) as bridge:
        summary = bridge.run(0.5)
    assert summary.is_certified
    assert summary.headline.endswith(", if its friction holds the encoder's steps")


@pytest.mark.parametrize("limit", [80.0, 90.0, float("nan")])
def test_the_motors_temperature_is_reported_and_warned_of_near_its_limit(
    library: ctypes.CDLL, tmp_path: Path, limit: float
) -> None:
    bench, path = Bench(library), tmp_path / "run.mcap"
    with warnings.catch_warnings(record=True) as said, bench.bridge(recording=path) as bridge:
        warnings.simplefilter("always")
        bench.board.firmware.heat(72.4, limit)
        bridge.run(0.2)
        bench.board.firmware.heat(71.0, limit)
        summary = bridge.run(0.2)
    own = summary.certification.own_loop
    assert own is not None
    assert own.temperature == pytest.approx(72.4)
    assert "its motors reached 72 °C" in str(summary)
    assert ("are switched off at" in str(summary)) is not np.isnan(limit)
    sentence = "board: its motors reached 72 °C, and are switched off at 80 °C; let them rest"
    assert [str(each.message) for each in said] == [sentence] * (limit == 80.0)
    audited = hb.audit(path, in_process=True).certification
    assert audited is not None
    assert audited.own_loop == own


def test_a_board_without_a_thermometer_says_nothing_of_temperature(library: ctypes.CDLL) -> None:
    with Bench(library).bridge() as bridge:
        summary = bridge.run(0.2)
    assert "°C" not in str(summary)


FAULTS = {
    8: "a fault of its own (status 0x09) and gives no force; restart and home it",
    8 + 64: "that a motor or its driver is too hot (status 0x49) and gives no force; let it cool",
    8 + 128: "that an encoder is not read (status 0x89) and gives no force; check its cable",
    8 + 192: "that a motor's driver has switched off (status 0xc9) and gives no force; check",
}


@pytest.mark.parametrize("status", FAULTS)
def test_a_fault_is_said_by_its_name(library: ctypes.CDLL, status: int) -> None:
    bench = Bench(library)

    def fail(tick: int) -> None:
        bench.board.status = status * (tick > 100)

    with pytest.raises(SafetyTrip) as trip, bench.bridge() as bridge:
        bridge.run(0.2, fail)
    assert FAULTS[status] in str(trip.value)
    assert np.linalg.norm(bench.board.force) == 0.0
