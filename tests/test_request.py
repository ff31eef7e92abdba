"""Every choice of a user is recorded, audited, and asked for again by a what-if."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import golden_cases as golden
import mujoco
import pytest
from audit_cases import ScriptedDevice, other_request, rewritten
from two_hands import TONGS

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.dataclass_json import from_json, to_json
from hapticbridge.demand.guard import Limits
from hapticbridge.device import GrippingDevice
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel.record import FORMAT
from hapticbridge.recording import Recording, read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.hands import Grasp, GripAxis
from hapticbridge.run.options import BridgeOptions, Workspace
from hapticbridge.run.request import RunRequest, request_of, setups_of
from hapticbridge.whatif import what_if
from hapticbridge.whatif.recorded import RecordedRun, changed_request

OPTION_CLASSES = BridgeOptions, Workspace, Limits, hb.Coupling, Grasp, GripAxis

NOT_REPEATED = {"live", "probe", "realtime"}
"""Options that a repetition turns off: it is shown nowhere, and its time is not real."""

NOT_RECORDED = {("Grasp", "device")}
"""Fields that a recording lacks: the open device, whose data sheet and name it has."""

PINNED = {"coupling", "method", "contact", "contact_stiffness", "substeps", "scene_rate"}
"""Fields that a what-if with any change sets to what the recorded run had."""

TURNED = (0.36, 0.48, -0.8, -0.8, 0.6, 0.0, 0.48, 0.64, 0.6)

LIMITS = Limits(
    force=5.0,
    torque=0.2,
    hold_force=2.0,
    hold_torque=0.1,
    ramp=0.02,
    stretch=0.1,
    angle=1.0,
    energy=math.inf,
    reach=0.3,
)


class RealTime:
    """A clock that is named real and never late."""

    name = "real"
    may_wait = True

    def __init__(self) -> None:
        self._period = self._now = 0

    def start(self, period_ns: int) -> None:
        self._period = period_ns

    def wait(self) -> tuple[int, int, int]:
        self._now += self._period
        return self._now, self._now, 0

    def now(self) -> int:
        return self._now


def drift(tick: int) -> tuple[float, ...]:
    return (4e-5 * tick, 2e-5 * tick, 0.0, 1.0, 0.0, 0.0, 0.0)


def one_hand(scene: str = "point_mass", **choices: Any) -> Callable[[Path], Bridge]:
    """Returns a bridge of one hand; ``sheet`` are fields of its device's data sheet."""

    def bridge(path: Path) -> Bridge:
        own: dict[str, Any] = {"clock": hb.SimulatedClock, "sheet": {}, "coupling": None}
        own |= choices
        own["clock"] = own["clock"]()  # a new one for each run
        sheet, coupling = own.pop("sheet"), own.pop("coupling")
        moved = ScriptedDevice(drift, buttons=lambda tick: 2 + 4 * (tick % 20 > 10), **sheet)
        return Bridge(scene, moved, coupling, recording=path, **own)

    return bridge


def two_hands(path: Path) -> Bridge:
    """Tongs held by a hand and its fingers, all named for the one grasp."""
    held = ScriptedDevice(drift, buttons=lambda _: 2, delay=0.0)
    fingers = ScriptedDevice(lambda tick: (1e-5 * tick, 0, 0, 1, 0, 0, 0), axes=("x",))
    grasp = Grasp(
        "left",
        GrippingDevice(held, fingers, 0.03),
        coupling=hb.Coupling(600.0, 0.4, 0.5, 1e-4),
        workspace=Workspace(scale=1.2),
        limits=LIMITS,
        clutch=0,
        dead_man=1,
        grip_axis=GripAxis("hinge", -8.0, {"stiffness": 3.0}),
    )
    scene = hb.load_scene(mujoco.MjSpec.from_string(TONGS), ("left", "joint:hinge"))
    return Bridge(scene, [grasp], clock=hb.SimulatedClock(), recording=path)


REAL: dict[str, Any] = {"is_real": True}

RUNS: dict[str, Callable[[Path], Bridge]] = {
    "nothing": one_hand(),
    "all at once": one_hand(
        rate=500.0,
        method="implicit",
        contact="scene",
        i_know=True,
        controller="damper",
        clutch=0,
        dead_man=1,
        mark=2,
        tool_weight=False,
        pipelined=True,
        limits=LIMITS,
        workspace=Workspace(scale=1.5, force_scale=0.7, axes=TURNED),
        coupling=hb.Coupling(500.0, 0.4, 0.3, 1e-4),
    ),
    "some gains and substeps": one_hand(coupling={"stiffness": 700.0}, substeps=3),
    "a slower scene": one_hand(scene_rate=250.0),
    "pulses": one_hand(impact_pulses=0.5, pulse="steel"),
    "absolute poses": one_hand(workspace=Workspace(absolute=True)),
    "a massless tool": one_hand(method="direct", contact_stiffness=300.0),
    "a real device": one_hand(clock=RealTime, sheet=REAL, live=True, realtime=True, probe=False),
    "a grip axis": two_hands,
}


def defaults(kind: type) -> dict[str, Any]:
    """Returns the default of each field that has one."""
    return {each.name: each.default for each in fields(kind) if each.default is not MISSING}


def chosen(value: Any) -> Iterator[tuple[str, str]]:
    """Yields class and name of every field of a request that differs from its default."""
    if isinstance(value, tuple):
        for each in value:
            yield from chosen(each)
    elif is_dataclass(value):
        usual = defaults(type(value))
        for each in fields(value):
            own = getattr(value, each.name)
            if each.name not in usual or own != usual[each.name]:
                yield type(value).__name__, each.name
                yield from chosen(own)


@dataclass(frozen=True)
class Recorded:
    """A short run: the request as the bridge had it, and the recording."""

    path: Path
    request: RunRequest
    recording: Recording


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Recorded]:
    kept: dict[str, Recorded] = {}

    def run(name: str) -> Recorded:
        if name not in kept:
            path = tmp_path_factory.mktemp("request") / "run.mcap"
            with RUNS[name](path) as bridge:
                bridge.run(0.1)
            kept[name] = Recorded(path, bridge.request, read_recording(path, hand=0))
        return kept[name]

    return run


def test_the_runs_choose_a_value_for_every_field(tmp_path: Path) -> None:
    """A new field of an options class fails here until a run below chooses another value."""
    found = {each for make in RUNS.values() for each in chosen(make(tmp_path / "run.mcap").request)}
    every = {(kind.__name__, each.name) for kind in OPTION_CLASSES for each in fields(kind)}
    assert every - found - NOT_RECORDED == set()


def test_other_fields_of_a_recording_need_another_format() -> None:
    """A changed field fails here until ``kernel.record.FORMAT`` is the next; then freeze."""
    assert golden.format_fields() == golden.FORMAT_FIELDS.read_text(encoding="utf-8")


def test_the_changelog_names_the_format_of_recordings() -> None:
    changelog = Path(__file__).parents[1] / ".github" / "CHANGELOG.md"
    assert f"- **Recordings** have format {FORMAT}." in changelog.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", RUNS)
def test_a_request_is_recorded_as_asked_and_audited(
    name: str, runs: Callable[[str], Recorded]
) -> None:
    run = runs(name)
    assert request_of(run.recording.meta) == run.request
    report = audit(run.path, in_process=True)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit"), report.reason


@pytest.mark.parametrize("name", RUNS)
def test_nothing_changed_asks_for_all_again_and_runs_to_the_bit(
    name: str, runs: Callable[[str], Recorded]
) -> None:
    run = runs(name)
    before, again, *_ = what_if(run.path, {}, in_process=True).runs
    assert before.recording.ticks.tobytes() == again.recording.ticks.tobytes()
    asked, repeated = run.request, request_of(again.recording.meta)
    off: dict[str, Any] = dict.fromkeys(NOT_REPEATED, False)
    limits = repeated.options.limits if name == "a real device" else asked.options.limits
    assert repeated.options == replace(asked.options, **off, limits=limits)
    names = [replace(grasp, device="") for grasp in repeated.grasps]
    assert names == [replace(grasp, device="") for grasp in asked.grasps]
    assert (repeated.parameters, repeated.as_is) == (asked.parameters, asked.as_is)


@pytest.mark.parametrize("name", RUNS)
def test_a_change_leaves_every_other_choice(
    name: str, runs: Callable[[str], Recorded], tmp_path: Path
) -> None:
    run = runs(name)
    count = len(run.request.grips)
    recordings = [read_recording(run.path, hand=hand) for hand in range(count)]
    hands = RecordedRun.from_hands(recordings, tmp_path)
    settings = [hand.settings.changed({"rate": 800.0}) for hand in hands]
    new = changed_request(hands, settings)
    kept = PINNED | NOT_REPEATED | {"rate", "limits"}
    for each in fields(BridgeOptions):
        if each.name not in kept:
            own, asked = (getattr(r.options, each.name) for r in (new, run.request))
            assert own == asked, each.name
    assert new.options.rate == 800.0
    for own, asked in zip(new.grasps, run.request.grasps, strict=True):
        axis = own.grip_axis and replace(own.grip_axis, coupling=None)
        before = asked.grip_axis and replace(asked.grip_axis, coupling=None)
        assert axis == before
        assert replace(own, coupling=None, grip_axis=None) == replace(
            asked, coupling=None, grip_axis=None
        )
    assert hands[0].setup.coupling == new.grasps[0].coupling


def test_a_real_devices_ramp_is_repeated_on_a_simulated_one(
    runs: Callable[[str], Recorded], tmp_path: Path
) -> None:
    run = runs("a real device")
    [hand] = RecordedRun.from_hands([run.recording], tmp_path)
    assert hand.parameters.ramp_ticks == 500
    asked = run.request.options.limits
    assert changed_request([hand], [hand.settings]).options.limits == replace(asked, ramp=0.5)


# A stored number that the request does not give


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda r: r["options"].update(rate=500.0), "'period_s'"),
        (lambda r: r["options"].update(controller="off"), "'controller'"),
        (lambda r: r["options"].update(clutch=3), "'clutch'"),
        (lambda r: r["options"].update(method="implicit"), "'method'"),
        (lambda r: r["options"].update(scene_rate=500.0), "'scene_ticks'"),
        (lambda r: r["options"]["workspace"].update(scale=2.0), "'scale'"),
        (lambda r: r["grasps"][0].update(coupling={"stiffness": 900.0}), "'stiffness'"),
        (lambda r: r["grasps"][0].update(coupling={"softness": 1.0}), "no gain 'softness'"),
        (lambda r: r["grasps"][0].update(grip="elsewhere"), "'grip'"),
        (lambda r: r["options"]["workspace"].update(scale=1e-300), "request"),
        (lambda r: r["devices"][0].update(damping=9.0), "'damping' is 2.0, but"),
        (lambda r: r["devices"][0].update(damping=-9.0), ".devices[0] is refused"),
        (lambda r: r.update(clock="real"), "'clock'"),
        (lambda r: r.update(scene="other.xml"), "scene"),
        (lambda r: r.update(parameters={"mass": 0.2}), "scene_sha256"),
        (lambda r: r.update(surplus=1), "'surplus'"),
        (lambda r: r.pop("options"), "'options'"),
        (lambda r: r.update(devices=[]), "0 devices"),
    ],
)
def test_a_request_that_gives_other_numbers_is_named(
    change: Callable[[dict[str, Any]], Any],
    field: str,
    runs: Callable[[str], Recorded],
    tmp_path: Path,
) -> None:
    recording = runs("nothing").recording
    meta = other_request(recording, change)
    report = audit(rewritten(recording, tmp_path / "a.mcap", meta=meta), in_process=True)
    assert report.verdict == "invalid"
    assert field in report.reason, report.reason


# Text form


@dataclass(frozen=True)
class Sample:
    """A dataclass of each type of field."""

    number: float
    count: int = 0
    pair: tuple[float, ...] = ()
    limits: Limits | None = None


@pytest.mark.parametrize(
    "value",
    [
        Sample(-0.0),
        Sample(math.inf, 2**60, (1e-320, 0.1)),
        Sample(0.1 + 0.2, limits=LIMITS),
    ],
)
def test_a_dataclass_reads_back_as_it_was_written(value: Sample) -> None:
    again = from_json(Sample, to_json(value), "sample")
    assert again == value
    assert math.copysign(1.0, again.number) == math.copysign(1.0, value.number)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "sample is not JSON"),
        ("[" * 100_000, "sample is not JSON"),
        ("[]", "sample is []; it must be an object"),
        ("{}", "sample has no 'count', 'limits', 'number', 'pair'"),
        ("1e999", "sample is inf; it must be an object"),
        (("number", "nan"), "sample.number is nan; it must be a finite number or 'inf'"),
        (("number", "true"), "sample.number is True"),
        (("number", '"1"'), "sample.number is '1'"),
        (("number", "1" * 400), "sample.number is 111"),
        (("count", "1.0"), "sample.count is 1.0; it must be a whole number"),
        (("pair", '[1, "x"]'), "sample.pair[1] is 'x'"),
        (("pair", "3"), "sample.pair is 3; it must be a list"),
        (("limits", "7"), "sample.limits is 7; it must be an object or null"),
        (("limits", '{"force": 1}'), "sample.limits has no 'angle'"),
        (("surplus", "1"), "sample has unknown fields 'surplus'"),
    ],
)
def test_a_hostile_text_is_an_error_that_names_the_field(
    text: str | tuple[str, str], message: str
) -> None:
    if isinstance(text, tuple):
        known = {"number": "1", "count": "1", "pair": "[]", "limits": "null"}
        known[text[0]] = text[1].replace("nan", "NaN")
        text = "{" + ", ".join(f'"{name}": {value}' for name, value in known.items()) + "}"
    with pytest.raises(RecordingError, match=re.escape(message)):
        from_json(Sample, text, "sample")


def test_a_value_out_of_range_is_refused_by_its_own_class() -> None:
    bad = to_json(Sample(1.0, limits=LIMITS)).replace('"force": 5.0', '"force": -5.0')
    with pytest.raises(HapticBridgeError, match="force limit is -5"):
        from_json(Sample, bad, "sample")


def test_the_setups_of_a_recording_need_no_scene(runs: Callable[[str], Recorded]) -> None:
    run = runs("a grip axis")
    first, fingers = setups_of(run.recording.meta)
    assert (first.scene.grip, fingers.scene.grip) == ("left", "joint:hinge")
    assert fingers.workspace == Workspace(scale=8.0, axes=(-1, 0, 0, 0, 1, 0, 0, 0, -1))
