"""Process of the live view: every body where the run has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from report_runs import LOOSE
from two_hands import GRIPS, SCENES, two_handed
from view_cases import AT_ONCE, FLOOR, Canvas, pressed, tapped_wall

import hapticbridge as hb
from hapticbridge.audit import audit
from hapticbridge.errors import RecordingError
from hapticbridge.recording import Attachment, Ring, read_recording
from hapticbridge.recording.ring import Snapshot
from hapticbridge.replay.stage import Stage
from hapticbridge.run.bridge import Bridge

pytest.importorskip("viser", reason="needs the extra 'view'")


from hapticbridge.view.geometry import Tendons
from hapticbridge.view.page import Ghost, Held, Sight
from hapticbridge.view.process import LiveRun, run_of
from hapticbridge.view.replay import Replay

# viser's threads and sockets end with the process
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


class Watcher:
    """An onlooker in the bridge's own process."""

    live: LiveRun | None = None

    def start(
        self,
        ring: str,
        snapshot: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
    ) -> None:
        files = {item.name: item.data for item in attachments}
        self.live = LiveRun(Ring.attach(ring), snapshot, run_of(dict(metadata), files))

    def event(self, event: Mapping[str, object]) -> None:
        """Is not interested."""

    def close(self) -> None:
        """Has nothing to close."""


LIFTED = FLOOR.replace(
    "</worldbody>",
    """<body name="lift" mocap="true" pos="0 0 0.5"><geom size="0.01"/></body>
    <body name="loose" pos="0.08 0 0.04"><freejoint/><geom size="0.03" mass="0.1"/></body>
    </worldbody>""",
)


@pytest.mark.parametrize(("cone", "pipelined"), [("elliptic", True), ("pyramidal", False)])
def test_a_live_view_has_every_body_where_the_run_simulated_again_has_it(
    tmp_path: Path, cone: str, pipelined: bool
) -> None:
    scene, path = tmp_path / "lifted.xml", tmp_path / "run.mcap"
    scene.write_text(LIFTED.replace("elliptic", cone))
    watcher, sights = Watcher(), list[Sight]()

    def look(bridge: Bridge, tick: int) -> None:
        assert watcher.live is not None
        bridge.set_input(mocap={"lift": (0, 0, 0.5 + 1e-5 * tick)})
        sight = watcher.live.look()
        if sight is not None:
            sights.append(sight)

    summary = recorded(
        path,
        str(scene),
        ScriptedDevice(pressed),
        LOOSE,
        duration=0.9,
        on_tick=look,
        observer=watcher,
        pipelined=pipelined,
        limits=AT_ONCE,
    )
    assert len(sights) == 28  # of 900 ticks, one in 33
    assert summary.dropped == 0  # it frees no record
    assert watcher.live is not None
    time, lines = watcher.live.trace.curves()
    ticks = read_recording(path).ticks
    at = np.searchsorted(ticks["deadline_ns"], np.round(1e9 * time).astype(np.int64))
    np.testing.assert_allclose(lines[3], 1e3 * ticks["device_energy"][at])
    for line, wrench in zip(lines, ("wrench_on_device", "wrench_on_tool"), strict=False):
        force = np.linalg.norm(ticks[wrench][:, :3], axis=1)
        assert line.max() == pytest.approx(force[: at[-1] + 1].max())
    stage, touched = Stage(path), 0
    lift = stage.model.body("lift").id
    for sight in sights:
        stage.show(stage.tick_at(sight.time))
        hands = tuple(Held.from_record(*each) for each in stage.hands())
        seen = stage.contacts(), stage.row, hands
        again = Sight.from_scene(stage.model, stage.data, Tendons(stage.model), *seen)
        assert sight.time == again.time
        np.testing.assert_array_equal(sight.places, again.places)
        np.testing.assert_array_equal(sight.turns, again.turns)
        np.testing.assert_array_equal(sight.contact_places, again.contact_places)
        np.testing.assert_allclose(sight.contact_forces, again.contact_forces, atol=1e-12)
        (held,), (expected,) = sight.hands, again.hands
        np.testing.assert_array_equal(held.grip, expected.grip)
        np.testing.assert_array_equal(held.hand_force, expected.hand_force)
        assert np.linalg.norm(sight.contact_forces, axis=1).all()
        touched += len(sight.contact_places) > 0
    assert touched > 5
    assert np.ptp([sight.places[lift, 2] for sight in sights]) > 0.008
    assert audit(path).resimulation == "bit for bit"


@pytest.mark.parametrize("scene", ["bar", "tongs"])
def test_a_live_view_shows_every_hand_that_has_a_handle(tmp_path: Path, scene: str) -> None:
    watcher, sights, path = Watcher(), list[Sight](), tmp_path / "run.mcap"
    hands = [hb.Grasp("left"), hb.Grasp("right", "simulated:damping=3")]
    if scene == "tongs":  # a grip axis has no place in the scene
        hands = [hb.Grasp("left", grip_axis=hb.GripAxis("hinge"))]
    loaded = two_handed(SCENES[scene], GRIPS.get(scene, ("left", "right")))

    def look(_: int) -> None:
        assert watcher.live is not None
        if (sight := watcher.live.look()) is not None:
            sights.append(sight)

    how: Any = {"clock": hb.SimulatedClock(), "recording": path, "observer": watcher}
    with hb.Bridge(loaded, hands, **how) as bridge:
        bridge.run(0.6, look)
    assert len(sights) > 15
    first, second = (hb.read_recording(path, hand=each).ticks for each in (0, 1))
    assert watcher.live is not None
    count = 2 if scene == "bar" else 1
    assert len(watcher.live.scenery.tools) == count
    for sight in sights:
        tick = int(np.searchsorted(first["deadline_ns"], round(1e9 * sight.time)))
        own, *others = sight.hands
        assert own.handle.tolist() == first["handle_position"][tick].tolist()
        assert len(sight.hands) == count
        for other in others:
            assert other.handle.tolist() == second["handle_position"][tick].tolist()
            assert other.tool_force.tolist() == second["wrench_on_tool"][tick, :3].tolist()
            assert other.hand_force == pytest.approx(second["wrench_on_device"][tick, :3])
    time, lines = watcher.live.trace.curves()
    at = np.searchsorted(first["deadline_ns"], np.round(1e9 * time).astype(np.int64))
    np.testing.assert_allclose(lines[3], 1e3 * first["device_energy"][at])
    replay = Replay(path, in_process=True)
    assert len(replay.sights[-1].hands) == count
    for hand, held in enumerate(replay.sights[-1].hands):
        canvas: Any = Canvas()
        Ghost(canvas, replay.scenery, hand).show(held, 1.0, 1.0)
        name = "/handle 2" if hand else "/handle"
        assert canvas.__dict__[name].position.tolist() == held.handle.tolist()


def test_a_live_view_shows_each_blow_with_the_energy_of_the_run_simulated_again(
    tmp_path: Path,
) -> None:
    watcher, sights = Watcher(), list[Sight]()

    def look(_bridge: Bridge, _tick: int) -> None:
        assert watcher.live is not None
        if (sight := watcher.live.look()) is not None:
            sights.append(sight)

    stage, blows = Stage(tapped_wall(tmp_path, on_tick=look, observer=watcher)), set[float]()
    for sight in sights:
        stage.show(stage.tick_at(sight.time))
        assert (sight.blow is None) == (stage.blow is None)
        if sight.blow is not None and stage.blow is not None:
            assert sight.blow.words == stage.blow.words
            # it is where the next picture has a contact, or where the grip was
            assert np.linalg.norm(sight.blow.place - stage.blow.place) < 0.025
            blows.add(sight.blow.time)
    assert len(blows) == 2


def test_a_picture_that_is_being_written_is_not_shown() -> None:
    model = mujoco.MjModel.from_xml_string(FLOOR)
    snapshot = Snapshot.shared(model)
    try:
        other = Snapshot.attach(str(snapshot.name), model)
        assert other.read() is None  # there is none yet
        snapshot.head[:3] = 2, 7, 1
        snapshot.numbers[0] = 0.5
        picture = other.read()
        assert picture is not None
        assert (picture.number, picture.slack, len(picture.contacts)) == (7, 0.5, 1)
        snapshot.head[0] = 3
        assert other.read() is None
        with pytest.raises(RecordingError, match="bytes, the scene"):
            Snapshot.attach(str(snapshot.name), mujoco.MjModel.from_xml_string("<mujoco/>"))
    finally:
        snapshot.close()
    with pytest.raises(RecordingError, match="no ring at"):
        Snapshot.attach(str(snapshot.name), model)
