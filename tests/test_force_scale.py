"""Claims about hands whose force scale differs from the scale of their motion."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from two_hands import TONGS

import hapticbridge as hb
from hapticbridge.cli.main import main
from hapticbridge.demand.trip import Trip, TripCode
from hapticbridge.device import GrippingDevice, SimulatedDevice
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel.hand_energy import INSTANT, HandEnergy
from hapticbridge.report import write_report
from hapticbridge.run.hands import Grasp, GripAxis
from hapticbridge.run.options import Workspace
from hapticbridge.whatif import what_if

SLIDER = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body name="t">
<joint type="slide" axis="1 0 0" {spring}/><geom type="box" size=".05 .01 .01" mass="0.1"/>
<site name="left" pos="-.04 0 0"/><site name="right" pos=".04 0 0"/></body></worldbody></mujoco>"""

SPRUNG = SLIDER.format(spring='stiffness="200" springref="0.04"')
STORED = 0.5 * 200.0 * 0.04**2
"""Energy in J of the spring of ``SPRUNG`` at the start."""

SHEET: dict[str, Any] = {
    "axes": ("x",),
    "damping": 2.0,
    "friction": 0.0,
    "resolution": 0.0,
    "delay": 0.0,
    "is_delay_measured": True,
    "is_real": False,
}


class Bar:
    """A bar in two devices' handles, or in one: ends at ``reaches`` times its own motion x in m.

    It is a passive hand with 0.1 kg and 2 N s/m at each end, and a brake of ``brake`` N s/m. The
    ledger is exact: F and x are those of short steps in continuous time.

    Attributes:
        forces: Force of each device on its end in N.
        pushed: Work in J of a push of 0.3 N in the first 0.1 s, if there is one.
        got: Energy in J that the bar has got from both devices beyond what their damping burned.
    """

    def __init__(self, *reaches: float, push: float = 0.0, brake: float = 0.0) -> None:
        self.reaches, self.push, self.brake = np.array(reaches), push, brake
        self.forces = np.zeros(len(reaches))
        self.position = self.velocity = self.time = self.pushed = self.got = 0.0

    def step(self, period: float) -> None:
        steps = 20
        squares = float(self.reaches @ self.reaches)
        push = self.push if self.time < 0.1 else 0.0
        for _ in range(steps):
            force = float(self.forces @ self.reaches) - 2.0 * squares * self.velocity
            total = force + push - self.brake * self.velocity
            self.velocity += period / steps * total / (0.1 * squares)
            moved = period / steps * self.velocity
            self.position += moved
            self.pushed += push * moved
            self.got += force * moved
        self.time += period


class End:
    """Device at one end of a bar; the first one moves it."""

    def __init__(self, bar: Bar, end: int = 0) -> None:
        self.bar, self.end = bar, end
        self.info = hb.DeviceInfo(name=f"end {end}", force_limit=5.0, **SHEET)

    def start(self, period: float) -> NDArray[np.void]:
        self.period, self.is_begun = period, False
        sample = np.zeros(1, hb.SAMPLE_DTYPE)
        sample["quaternion"] = 1.0, 0.0, 0.0, 0.0
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        if self.is_begun and self.end == 0:
            self.bar.step(self.period)
        self.is_begun = True
        place = self.bar.position * self.bar.reaches[self.end]
        sample[0] = (place, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self.bar.forces[self.end] = wrench[0]

    def close(self) -> None:
        self.bar.forces[self.end] = 0.0


def scene_at(folder: Path, text: str) -> Path:
    path = folder / "slider.xml"
    path.write_text(text)
    return path


def held(bar: Bar, *workspaces: Workspace) -> list[Grasp]:
    """Returns grasps of both ends of the slider by the ends of a bar."""
    left, right = workspaces
    return [
        Grasp("left", End(bar), workspace=left),
        Grasp("right", End(bar, 1), workspace=right),
    ]


SAME, FIVE = Workspace(), Workspace(scale=0.2, force_scale=1.0)


@pytest.mark.parametrize("reach", [0.3, 1.0, 2.5])
@pytest.mark.parametrize("workspaces", [(FIVE, FIVE), (Workspace(scale=0.4), SAME)])
def test_a_bar_gets_nothing_from_two_handles_of_one_ratio(
    workspaces: tuple[Workspace, Workspace], reach: float, tmp_path: Path
) -> None:
    bar = Bar(1.0, reach, push=0.3)
    scene, path = scene_at(tmp_path, SLIDER.format(spring="")), tmp_path / "run.mcap"
    clock = hb.SimulatedClock()
    with hb.Bridge(scene, held(bar, *workspaces), clock=clock, recording=path) as bridge:
        summary = bridge.run(1.0)
    assert bar.pushed > 1e-5
    assert bar.got < 1e-6  # rounding
    assert summary.is_certified
    assert hb.audit(path, in_process=True).certified


@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        (SAME, FIVE, "is 1 for the hand at 'left' and 5 for that at 'right'"),
        (FIVE, SAME, "is 5 for the hand at 'left' and 1 for that at 'right'"),
        (SAME, Workspace(force_scale=1.00001), "is 1 for the hand at 'left' and 1.00001 for that"),
        (Workspace(scale=0.3, force_scale=0.7), Workspace(scale=0.9), "is 2.333333333 for the"),
    ],
)
def test_hands_between_which_energy_would_be_multiplied_are_refused(
    left: Workspace, right: Workspace, words: str, tmp_path: Path
) -> None:
    bar = Bar(1.0, 2.5)
    scene = scene_at(tmp_path, SLIDER.format(spring=""))
    with pytest.raises(HapticBridgeError) as refused:
        hb.Bridge(scene, held(bar, left, right), clock=hb.SimulatedClock())
    alike = left.energy_ratio * right.scale
    assert f"force_scale / scale {words}" in str(refused.value)
    [told] = re.findall(r"equal, as with force_scale (.*) at 'right'$", str(refused.value))
    assert float(told) == pytest.approx(alike, rel=1e-9)
    mended = Workspace(scale=right.scale, force_scale=float(told))
    hb.Bridge(scene, held(bar, left, mended), clock=hb.SimulatedClock())


def test_ratios_that_differ_by_rounding_and_those_of_prescribed_motions_are_accepted(
    tmp_path: Path,
) -> None:
    scene, clock = scene_at(tmp_path, SLIDER.format(spring="")), hb.SimulatedClock()
    three, rounded = Workspace(force_scale=3.0), Workspace(scale=0.1, force_scale=0.3)
    assert three.energy_ratio != rounded.energy_ratio
    hb.Bridge(scene, held(Bar(1.0, 1.0), three, rounded), clock=clock)
    motion = tmp_path / "motion.csv"
    motion.write_text("t,x,y,z\n0,0,0,0\n1,0.001,0,0\n")
    hands = [Grasp("left", f"trajectory:{motion}", workspace=FIVE), Grasp("right", workspace=SAME)]
    with hb.Bridge(scene, hands, clock=clock) as bridge:
        summary = bridge.run(0.1)
    assert summary.is_certified is None
    assert "counts 5 times" not in str(summary)


def test_a_grip_axis_takes_the_ratio_of_its_hand(tmp_path: Path) -> None:
    scene, path = tmp_path / "tongs.xml", tmp_path / "run.mcap"
    scene.write_text(TONGS)
    device = GrippingDevice(SimulatedDevice(), SimulatedDevice(dof=3, force_limit=8.0), 0.03)
    grasp = Grasp("left", device, workspace=FIVE, grip_axis=GripAxis("hinge", scale=-10.0))
    with hb.Bridge(scene, [grasp], clock=hb.SimulatedClock(), recording=path) as bridge:
        bridge.run(0.2)
        [_, fingers] = bridge.session.hand_parameters
    assert (fingers.scale, fingers.force_scale) == (10.0, 50.0)
    report = hb.audit(path, in_process=True)
    assert (report.certified, report.resimulation) == (True, "bit for bit")
    changed = what_if(path, {"joint:hinge:scale": 5.0}, in_process=True)
    assert changed.runs[-1].report.certified
    with pytest.raises(RecordingError, match="of the grip axis at 'joint:hinge' follows its scale"):
        what_if(path, {"joint:hinge:force_scale": 5.0}, in_process=True)


def test_a_hand_gets_the_ratio_times_what_the_scene_had_stored_and_the_run_says_so(
    tmp_path: Path,
) -> None:
    got = {}
    for ratio, workspace in ((1.0, SAME), (5.0, FIVE)):
        bar, path = Bar(1.0, brake=20.0), tmp_path / f"{ratio:g}.mcap"
        scene = hb.load_scene(scene_at(tmp_path, SPRUNG), grip="left")
        options: Any = {"clock": hb.SimulatedClock(), "workspace": workspace, "recording": path}
        with hb.Bridge(scene, End(bar), **options) as bridge:
            summary = bridge.run(5.0)
        report, page = hb.audit(path, in_process=True), tmp_path / "page.html"
        assert bar.got < ratio * STORED
        assert summary.is_certified
        assert report.certified
        energy = summary.hand_energy
        assert bar.got < ratio * energy.scene < ratio * STORED
        write_report(hb.read_recording(path), report, page, None)
        scales = "energy of the scene counts 5 times at the hand: force_scale / scale"
        for text in (str(summary), report.reason, page.read_text()):
            assert (scales in text) is (ratio == 5.0)
        stored = "5 times what the scene" if ratio == 5.0 else "the scene"
        assert summary.headline.endswith(f"gets more than it puts in or {stored} had stored")
        got[ratio] = bar.got
    assert "gave the hand up to 728 mJ, 5 times the 146 mJ that it released" in str(summary)
    assert got[5.0] > 2.0 * STORED > 2.0 * got[1.0]


def test_what_another_hand_put_in_is_not_told_as_the_scenes_storage(tmp_path: Path) -> None:
    scene, path = scene_at(tmp_path, SLIDER.format(spring="")), tmp_path / "run.mcap"
    hands = [Grasp("left", End(Bar(1.0, push=5.0))), Grasp("right", End(Bar(1.0, brake=20.0)))]
    with hb.Bridge(scene, hands, clock=hb.SimulatedClock(), recording=path) as bridge:
        summary = bridge.run(0.3)
    shared, _, right = str(summary).partition("hand at 'right'")
    assert "gave the hand" not in shared
    assert re.search(r"\n  scene and hands +gave the hand \d+(\.\d+)? mJ", right)
    told = "the scene's storage or another hand at 'right' gave the hand"
    assert told in hb.audit(path, in_process=True).reason


def test_the_works_of_ports_count_as_the_hand_gets_them() -> None:
    pushed = {"gross": 2.5e-3, "motors": 0.6e-3}
    assert HandEnergy(**pushed, ratio=5.0).limit.startswith("motors of")
    assert not HandEnergy(**pushed).limit
    assert not HandEnergy(gross=2.5e-3, springs=0.5e-3, motors=0.6e-3, ratio=5.0).limit
    assert "the coupling's springs held 500 µJ" in HandEnergy(springs=5e-4, ratio=5.0).sentence
    assert "springs" not in HandEnergy(springs=5e-4).sentence
    told = HandEnergy(net=3e-3, scene=5e-4, ratio=5.0).sentence
    assert "beyond what it put in, 5 times what the scene released (500 µJ at the end)" in told
    unpaid = HandEnergy(unpaid=2.0 * INSTANT, ratio=0.5).fault
    assert unpaid.endswith("by inputs 0 J, which count 0.5 times")
    trip = Trip(TripCode.GAVE_ENERGY, 1)
    for name, start in (("motors", "the scene's motors"), ("springs", "the coupling's springs")):
        works = {"net": 0.04, name: 5e-3}
        assert trip.remedy(HandEnergy(**works, ratio=5.0)).startswith(start)
        assert trip.remedy(HandEnergy(**works)) == "lower --stiffness"


def test_the_command_line_gives_all_hands_one_ratio(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = scene_at(tmp_path, SLIDER.format(spring=""))
    hands = ["--hand", "left=simulated", "--hand", "right=simulated", "--scale", "0.2"]
    more = ["--force-scale", "1", "--fast", "--duration", "0.1"]
    assert main(["run", str(scene), *hands, *more]) == 0
    assert capsys.readouterr().out.count("counts 5 times at the hand") == 2
