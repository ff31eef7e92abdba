"""A scene that another program steps: no hand gets more than the credit, bit for bit."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adversary import UNPAID, Attack
from numpy.typing import NDArray

from hapticbridge import Bridge, BridgeOptions, SimulatedClock, Summary, Workspace, audit
from hapticbridge.audit import AuditReport
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import CommandError, HapticBridgeError
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.record import POST_DTYPE, SAMPLE_DTYPE, TickFlag
from hapticbridge.recording import read_recording
from hapticbridge.recording.format import SHOWN_EVENT
from hapticbridge.run.commands import Couple, Repeat, Reset, Switch
from hapticbridge.run.endpoint import posted_scene, program_options
from hapticbridge.run.posted_scene import is_post

CREDIT = 0.05
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def attack(seed: int, **changes: Any) -> float:
    """Returns the most energy in J that a hand got from a program beyond its credit."""
    energy, _, code = Attack.at_random(seed, is_posted=True, scene_ticks=20, **changes).run()
    assert code == OK
    return energy


def test_no_hand_gets_more_from_a_program_than_its_credit() -> None:
    assert max(attack(seed) for seed in range(150)) <= UNPAID


def test_a_tool_that_turns_past_half_a_turn_gives_nothing() -> None:
    """There the torque's work is more than the spring loses; 42 mJ beyond the credit were seen."""
    assert attack(741) <= UNPAID


def test_a_program_that_nobody_pays_for_is_seen_to_give_joules() -> None:
    assert any(attack(seed, pays=False) > 1.0 for seed in range(60))


def post_of(position: Any, quaternion: Any = UPRIGHT, **values: Any) -> NDArray[np.void]:
    """Returns a post of a pose."""
    post = np.zeros(1, POST_DTYPE)
    post["pose"] = [*position, *quaternion]
    for name, value in values.items():
        post[name] = value
    return post


Program = Callable[[Bridge, int], None]


def run(program: Program, path: Path | None = None, duration: float = 2.0, **options: Any) -> Any:
    """Runs a program before each tick of a simulated hand; returns summary and records."""
    device = options.pop("device", "simulated")
    scene = posted_scene(options.pop("credit", CREDIT))
    own = program_options(BridgeOptions(**options))
    with Bridge(scene, device, None, own, clock=SimulatedClock(), recording=path) as bridge:
        summary = bridge.run(duration, lambda tick: program(bridge, tick))
        records = bridge.latest_records(round(duration * 1000))
    return summary, records


def shows(bridge: Bridge, post: NDArray[np.void]) -> None:
    assert bridge.session.posted is not None
    bridge.session.posted.post(post)


def handle_of(bridge: Bridge) -> NDArray[np.float64]:
    pose = bridge.session.kernel.state["pose"][0]
    return np.array(pose["handle_position"])


def follows(bridge: Bridge, tick: int) -> None:
    """A program of 50 Hz whose tool is where the handle was."""
    if tick % 20 == 0:
        shows(bridge, post_of(handle_of(bridge)))


def judged(path: Path) -> AuditReport:
    return audit(path, in_process=True)


def places(bridge: Bridge, position: tuple[float, ...]) -> None:
    event = {"event": "reset", "pose": [*position, *UPRIGHT], "by": "program"}
    bridge.session.commands.waiting.append((Repeat((event,)), "program"))


# The tool is shown where the program says


def test_without_velocity_the_tool_arrives_after_one_interval() -> None:
    def steps(bridge: Bridge, tick: int) -> None:
        if tick % 20 == 0:
            shows(bridge, post_of((1e-4 * (tick >= 100), 0.0, 0.0)))

    _, records = run(steps, duration=0.2, device="simulated:hand=none", credit=1.0)
    x = records["tool_position"][:, 0]
    assert np.all(x[:100] == 0.0)
    assert x[109] == pytest.approx(0.5e-4)
    assert x[119:] == pytest.approx(1e-4)


def test_of_several_poses_within_a_tick_the_newest_counts() -> None:
    def program(bridge: Bridge, tick: int) -> None:
        for x in (0.1, -0.2, 1e-3 * (tick >= 1000)):
            shows(bridge, post_of([x, 0.0, 0.0]))

    _, records = run(program, device="simulated:hand=none")
    assert np.all(np.diff(records["scene_step"]) == 1)
    assert records["tool_position"][-1, 0] == pytest.approx(1e-3, abs=1e-5)
    assert np.abs(records["tool_position"][:, 0]).max() < 1.1e-3


def test_with_a_velocity_it_moves_on_and_a_surface_stops_it() -> None:
    def moves(bridge: Bridge, tick: int) -> None:
        if tick == 0:
            wall = {"planes": 1, "normals": 0.0, "arms": 0.0, "gaps": 0.0}
            post = post_of((0.0, 0.0, 0.0), **wall)
            post["has_velocity"], post["velocity"][0, 0] = 1, 0.01
            post["normals"][0, :3], post["gaps"][0, 0] = (-1.0, 0.0, 0.0), 2e-5
            shows(bridge, post)

    _, records = run(moves, duration=0.05, device="simulated:hand=none", credit=1.0)
    x = records["tool_position"][:, 0]
    assert x[1] == pytest.approx(1e-5)
    assert x[3:] == pytest.approx(2e-5)


def test_a_program_without_a_word_lets_the_force_fade_and_come_back() -> None:
    def pauses(bridge: Bridge, tick: int) -> None:
        if not 500 < tick < 1200:
            follows(bridge, tick)

    with pytest.warns(UserWarning, match=r"no pose for 0\.25 s"):
        _, records = run(pauses, duration=2.0)
    lever = records["lever"]
    assert lever[480] == 1.0
    assert np.all(lever[1000:1200] == 0.0)
    assert np.all(records["wrench_on_device"][1000:1200] == 0.0)
    assert lever[-1] == 1.0


def test_before_the_first_pose_there_is_no_force() -> None:
    _, records = run(lambda bridge, tick: None, duration=1.0)
    assert np.all(records["wrench_on_device"][200:] == 0.0)
    assert np.all(records["scene_tank"] == CREDIT)


# The account


def test_a_tool_that_is_pulled_away_stops_where_the_credit_ends() -> None:
    """At a hand that is held the coupling's force K d + (B/T) d acts on one step of d."""

    def pulls(bridge: Bridge, tick: int) -> None:
        if tick % 20 == 0:
            shows(bridge, post_of((0.0 if tick < 300 else 0.3, 0.0, 0.0)))

    summary, records = run(pulls, device="simulated:hand=none,friction=100", duration=1.5)
    away = float(records["tool_position"][-1, 0] - records["handle_position"][-1, 0])
    law = summary.coupling.law
    expected = math.sqrt(CREDIT / (law.stiffness + law.damping / 1e-3))
    assert away == pytest.approx(expected, rel=0.01)
    assert records["scene_tank"][-1] == pytest.approx(0.0, abs=1e-9)


def test_work_that_the_program_states_is_taken_from_the_tank_and_given_back() -> None:
    def states(bridge: Bridge, tick: int) -> None:
        if tick in (0, 100, 200, 300):
            work = {0: 0.0, 100: 0.02, 200: 0.01, 300: -5.0}[tick]
            shows(bridge, post_of((0.0, 0.0, 0.0), work=work))

    _, records = run(states, device="simulated:hand=none", duration=0.4)
    tank = records["scene_tank"][[99, 199, 299, 399]]
    assert tank == pytest.approx([0.05, 0.03, 0.04, 0.05], abs=1e-6)


def test_the_summary_says_what_is_known_and_the_audit_says_the_same(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    summary, records = run(follows, path)
    report = judged(path)
    known = "another program stepped the scene"
    assert isinstance(summary, Summary)
    assert known in str(summary)
    assert "environment passive" not in str(summary)
    assert (report.verdict, report.agreement) == ("passive", "bit for bit")
    assert known in report.sentence
    assert "50 mJ" in report.sentence
    assert report.credit == summary.credit == CREDIT
    assert report.certified
    assert summary.timekeeping.shown_rate == pytest.approx(50.0, rel=0.01)
    assert records["scene_step"][-1] == 100


@pytest.mark.parametrize("seed", range(4))
def test_every_run_is_repeated_to_the_bit(tmp_path: Path, seed: int) -> None:
    """Poses at random, places, pauses, couplings and switches in any order."""
    rng = np.random.default_rng(seed)

    def acts(bridge: Bridge, tick: int) -> None:
        if rng.random() < 0.05 and not 800 < tick < 1300:
            position = handle_of(bridge) + 0.01 * rng.standard_normal(3)
            q = np.array([1.0, *0.1 * rng.standard_normal(3)])
            post = post_of(position, q / np.linalg.norm(q), work=0.01 * rng.standard_normal())
            if rng.random() < 0.5:
                post["has_velocity"], post["velocity"] = 1, 0.05 * rng.standard_normal(6)
            if rng.random() < 0.3:
                normal = rng.standard_normal(3)
                post["planes"], post["gaps"][0, 0] = 1, 1e-3
                post["normals"][0, :3] = normal / np.linalg.norm(normal)
            shows(bridge, post)
        if rng.random() < 0.003:
            places(bridge, tuple(0.02 * rng.standard_normal(3)))
        if tick % 200 == 100:
            command = rng.choice(["couple", "off", "on"])
            bridge.command(
                Couple(500.0 + 200.0 * rng.random(), 0.5)
                if command == "couple"
                else Switch(force=bool(command == "on"))
            )

    path = tmp_path / "run.mcap"
    with pytest.warns(UserWarning, match="no pose"):
        run(acts, path)
    report = judged(path)
    assert (report.verdict, report.agreement) == ("passive", "bit for bit"), report.reason


def test_a_reset_is_the_programs_own(tmp_path: Path) -> None:
    def resets(bridge: Bridge, tick: int) -> None:
        follows(bridge, tick)
        if tick == 100:
            with pytest.raises(CommandError, match="another program steps the scene; reset it"):
                bridge.command(Reset())
        if tick == 700:
            places(bridge, (0.5, 0.0, 0.1))
            shows(bridge, post_of((0.5, 0.0, 0.1)))

    _, records = run(resets, tmp_path / "run.mcap")
    assert np.linalg.norm(records["handle_position"][701] - (0.5, 0.0, 0.1)) < 1e-3
    assert records["lever"][699] == 1.0
    assert records["lever"][700] < 0.05
    assert np.linalg.norm(records["wrench_on_tool"][700:1000, :3], axis=1).max() < 10.0
    assert judged(tmp_path / "run.mcap").agreement == "bit for bit"


# A hand with a ledger of its own


class YieldingHand:
    """Device in a hand that moves as it likes: with its force, at a share of the speed w/b.

    ``got`` is the largest energy in J so far that the force gave beyond what b burned.
    """

    def __init__(
        self, delay: int = 0, share: float = 0.5, begin: int = 400, every: int = 1
    ) -> None:
        self.info = DeviceInfo(
            name="yielding",
            axes=("x",),
            damping=2.0,
            mass=0.1,
            force_limit=10.0,
            friction=0.0,
            resolution=0.0,
            delay=1e-3 * delay,
            is_delay_measured=True,
            is_real=False,
            rate=1000.0 / every,
        )
        self._every, self._newest = every, 0.0
        self.got, self._net, self._share, self._begin = 0.0, 0.0, share, begin
        self._place, self._tick, self._forces = 0.0, 0, [0.0] * (delay + 1)
        self._buttons = 0

    def start(self, period: float) -> NDArray[np.void]:
        self._period, sample = period, np.zeros(1, SAMPLE_DTYPE)
        sample["quaternion"][0] = UPRIGHT
        return sample

    def read(self, sample: NDArray[np.void]) -> int:
        force, b = self._forces[0], 2.0
        speed = float(np.clip(self._speed(force), -3.0, 3.0))
        self._place += speed * self._period
        self._net += (force - b * speed) * speed * self._period
        self.got = max(self.got, self._net)
        self._tick += 1
        sample["buttons"] = self._buttons
        if self._tick % self._every:
            return int(TickFlag.STALE_SAMPLE)
        sample["position"][0], sample["quaternion"][0] = (self._place, 0.0, 0.0), UPRIGHT
        return 0

    def _speed(self, force: float) -> float:
        return 0.5 * self._share * force if self._tick > self._begin else 0.0

    def write(self, wrench: NDArray[np.float64]) -> None:
        self._newest = float(wrench[0])
        if self._tick % self._every == 0:
            self._forces = [*self._forces[1:], self._newest]

    def close(self) -> None:
        pass


class PullingHand(YieldingHand):
    """Pulls at 0.2 m/s."""

    def _speed(self, force: float) -> float:
        return 0.2


class ClutchingHand(YieldingHand):
    """Stretches the coupling, taps its clutch 20 times, and lets the spring go slowly.

    While the force fades and rises it moves with what a late force is more than the newest one.
    """

    def _speed(self, force: float) -> float:
        tick = self._tick - self._begin
        phase = tick % 100
        self._buttons = int(0 <= tick < 2000 and phase < 18)  # no longer than the fade
        if tick < 0:
            return -0.05 / (self._begin * self._period)
        if tick >= 2000:
            return 0.01 * force
        if phase >= 30:
            return (-0.05 - self._place) / ((100 - phase) * self._period)
        return 0.25 * (force - self._newest)


def got_from(program: Program, hand: YieldingHand, stiffness: float, **options: Any) -> float:
    """Returns the energy in J that a hand got."""
    duration = options.pop("duration", 3.0)
    own = program_options(BridgeOptions(**options))
    coupling = {"stiffness": stiffness, "damping": 0.0}
    scene = posted_scene(CREDIT)
    with Bridge(scene, hand, coupling, own, clock=SimulatedClock()) as bridge:
        if program is unpaid:
            bridge.session.kernel.state["shown"]["tank"] = 1e9
        bridge.run(duration, lambda tick: program(bridge, tick))
    return hand.got


def jumps(bridge: Bridge, tick: int) -> None:
    """Shows the tool 5 mm to both sides of the handle in turn, so that a late force helps it."""
    if tick % 2 == 0:
        side = 0.005 if tick % 4 else -0.005
        shows(bridge, post_of(handle_of(bridge) + np.array([side, 0.0, 0.0]), has_velocity=1))


def unpaid(bridge: Bridge, tick: int) -> None:
    jumps(bridge, tick)
    bridge.session.kernel.state["shown"]["tank"] = 1e9


def test_a_force_that_arrives_after_a_jump_of_the_tool_gives_no_more_than_the_credit() -> None:
    assert got_from(jumps, YieldingHand(delay=1, begin=0), 980.0) <= CREDIT + UNPAID
    assert got_from(unpaid, YieldingHand(delay=1, begin=0), 980.0) > 10.0


@pytest.mark.parametrize(("late", "stiffness"), [({"delay": 1}, 850.0), ({"every": 4}, 212.0)])
def test_a_late_force_gives_nothing_while_it_fades_and_rises(
    late: dict[str, int], stiffness: float
) -> None:
    """Without a charge for it 0.19 and 0.13 J were got from a tool that never moves."""

    def holds(bridge: Bridge, tick: int) -> None:
        if tick % 20 == 0:
            shows(bridge, post_of((0.0, 0.0, 0.0)))

    options: dict[str, Any] = {"clutch": 0, "duration": 6.0, "rate": 1000.0}
    assert got_from(holds, ClutchingHand(**late), stiffness, **options) <= UNPAID


@pytest.mark.parametrize("force_scale", [0.5, 1.0, 3.0])
def test_the_credit_is_that_of_the_hand_at_any_scale_of_the_force(force_scale: float) -> None:
    """A tool that goes on before a hand that follows slowly gives it nearly all of the credit."""

    def leads(bridge: Bridge, tick: int) -> None:
        if tick % 20 == 0:
            shows(bridge, post_of(handle_of(bridge) + np.array([0.003, 0.0, 0.0])))

    hand = YieldingHand(share=0.1)
    got = got_from(leads, hand, 600.0, workspace=Workspace(force_scale=force_scale))
    assert 0.7 * CREDIT < got <= CREDIT + UNPAID


def test_a_work_that_is_stated_and_taken_back_fills_no_tank() -> None:
    """7 nJ are lost in the rounding of 1e8 J, and would be found again."""

    def lies(bridge: Bridge, tick: int) -> None:
        shows(bridge, post_of((0.0, 0.0, 0.0), work=(0.0, 1e8, 7e-9)[tick % 3]))

    _, records = run(lies, device="simulated:hand=none", duration=0.5)
    assert np.all(records["scene_tank"] <= CREDIT)


def test_a_program_that_shows_in_every_tick_has_no_larger_tank() -> None:
    """Without a cap in the tick of a post it held 2 J instead of 1 J after six seconds."""
    tanks: dict[int, float] = {}
    for every in (1, 2):

        def drags(bridge: Bridge, tick: int, every: int = every) -> None:
            if tick % every == 0:
                shows(bridge, post_of(handle_of(bridge) - (0.004, 0.0, 0.0), has_velocity=1))

        _, records = run(drags, device=PullingHand(), duration=6.0)
        tanks[every] = float(records["scene_tank"].max())
    assert tanks[1] == pytest.approx(tanks[2], rel=0.01)


def test_normals_of_another_length_are_no_post() -> None:
    post = post_of((0.0, 0.0, 0.0), planes=1)
    post["normals"][0, :3] = (0.0, 0.6, 0.8)
    assert is_post(post[0])
    post["normals"][0, :3] = (0.0, 0.6, 1e8)
    assert not is_post(post[0])
    post["planes"] = -1
    assert not is_post(post[0])


# What was changed is found


def changed(path: Path, change: Callable[[list[dict[str, Any]], Any], None]) -> AuditReport:
    """Returns the audit of a recording whose events or records were changed."""
    from hapticbridge.recording.reader import read_with_attachments
    from hapticbridge.recording.writer import rewrite

    recording, attachments = read_with_attachments(path)
    events, ticks = [dict(event) for event in recording.events], recording.ticks.copy()
    change(events, ticks)
    other = path.with_name("changed.mcap")
    rewrite(recording, attachments, other, [ticks], events)
    return judged(other)


def test_a_post_that_was_changed_left_out_or_damaged_is_found(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run(follows, path, duration=0.5)
    recording = read_recording(path)
    assert sum(e.get("count", 0) for e in recording.events if e["event"] == SHOWN_EVENT) == 25

    def first(events: list[dict[str, Any]]) -> dict[str, Any]:
        return next(event for event in events[20:] if event["event"] == SHOWN_EVENT)

    def alters(events: list[dict[str, Any]], _: Any) -> None:
        import base64

        posts = np.frombuffer(base64.b64decode(first(events)["posts"]), POST_DTYPE).copy()
        posts["pose"][:, 0] += 1e-3
        first(events)["posts"] = base64.b64encode(posts.tobytes()).decode()

    def damages(events: list[dict[str, Any]], _: Any) -> None:
        first(events)["posts"] = "no posts"

    def omits(events: list[dict[str, Any]], _: Any) -> None:
        events.remove(first(events))

    def enriches(_: Any, ticks: Any) -> None:
        ticks["scene_tank"] += 0.01
        ticks["potential"] += 0.01

    assert changed(path, lambda events, ticks: None).verdict == "passive"
    for change in (alters, damages, omits, enriches):
        assert changed(path, change).verdict == "invalid", change


def test_a_credit_of_nothing_is_refused() -> None:
    with pytest.raises(HapticBridgeError):
        run(follows, credit=-1.0)
