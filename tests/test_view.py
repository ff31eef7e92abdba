"""The page of a run: what it shows, whom it answers, and that the loop never notices it."""

from __future__ import annotations

import contextlib
import http.client
import io
import json
import os
import signal
import socket
import sys
import threading
import time
import types
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from chromium import browser
from cli_cases import Called
from PIL import Image
from report_runs import LOOSE
from test_view_address import OUTSIDE, outside

from hapticbridge.audit import audit
from hapticbridge.audit.rerun import Rerun
from hapticbridge.bridge import Bridge
from hapticbridge.commands import Command, Couple, Switch
from hapticbridge.commands.command import Stop, line_of
from hapticbridge.errors import HapticBridgeError
from hapticbridge.recording import Recording, Ring, read_recording
from hapticbridge.view.address import COOKIE, Address
from hapticbridge.view.trace import LINES, Trace
from hapticbridge.view.window import Window

pytest.importorskip("viser", reason="needs the extra 'view'")

import websockets.exceptions
from page_client import PATIENCE, hand, said
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from hapticbridge.view.props import props_of
from hapticbridge.view.replay import Replay, Theatre
from hapticbridge.view.show import Show
from hapticbridge.view.sight import Sight

# viser's threads and sockets end with the process
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

FLOOR = """<mujoco model="floor">
  <option timestep="0.001" integrator="discrete" cone="elliptic" gravity="0 0 0"/>
  <statistic center="0 0 0" extent="0.2"/>
  <worldbody>
    <light pos="0 0 1"/>
    <geom type="plane" size="0.1 0.1 0.01"/>
    <body name="ball" pos="0 0 0.03">
      <freejoint/>
      <geom type="sphere" size="0.02" mass="0.1" rgba="1 0 0 1"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def pressed(tick: int) -> tuple[float, ...]:
    return (min(1e-4 * tick, 0.04), 0, max(-1e-4 * tick, -0.012), 1, 0, 0, 0)


@pytest.fixture(scope="module")
def floor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball that is moved aside and pressed onto a floor, and held there."""
    folder = tmp_path_factory.mktemp("view")
    scene, path = folder / "floor.xml", folder / "floor.mcap"
    scene.write_text(FLOOR)
    recorded(path, str(scene), ScriptedDevice(pressed), LOOSE, duration=1.5)
    return path


@pytest.fixture(scope="module")
def replay(floor: Path) -> Replay:
    return Replay(floor)


@contextlib.contextmanager
def served(replay: Replay, address: Address) -> Iterator[tuple[Theatre, int]]:
    theatre = Theatre(replay, address)
    try:
        yield theatre, int(theatre.url.split(":")[2].split("/")[0])
    finally:
        theatre.close()


def test_sights_stand_where_the_record_says_and_contacts_carry_the_force(replay: Replay) -> None:
    records = read_recording(replay.stage.recording.path).ticks
    ball = replay.stage.model.body("ball").id
    for moment in (0.0, 0.4, 1.2):
        sight = replay.at(moment)
        row = records[max(round(sight.time * 1000) - 1, 0)]
        np.testing.assert_allclose(sight.places[ball], row["tool_position"], atol=1e-9)
        np.testing.assert_allclose(sight.handle, row["handle_position"])
    still = replay.at(1.5)
    assert np.linalg.norm(still.force) > 1
    assert len(still.contact_places) == 1
    # at rest what the coupling pushes the floor gives back
    np.testing.assert_allclose(still.contact_forces.sum(axis=0), -still.force, atol=2e-2)
    assert not len(replay.at(0.0).contact_places)


def test_curves_are_those_of_the_record(replay: Replay) -> None:
    time, lines = replay.trace.curves()
    records = read_recording(replay.stage.recording.path).ticks
    assert len(lines) == LINES
    force = np.linalg.norm(records["wrench_on_tool"][:, :3], axis=1)
    assert lines[0].max() == pytest.approx(force.max())  # peaks between two instants are kept
    assert lines[2][-1] == pytest.approx(1e3 * records["device_energy"][-1])
    created = 1e-3 * lines[3]
    assert (1e-3 * lines[4] + created)[-1] == pytest.approx(replay.stage.slack)
    assert time[-1] == pytest.approx(1.5)


def test_late_ticks_are_seen_however_short(floor: Path) -> None:
    rows = read_recording(floor).ticks[:40].copy()
    rows["wake_ns"] = rows["deadline_ns"] + 1000
    rows["wake_ns"][7] += 250_000
    trace = Trace()
    trace.add(rows, 0.0)
    assert trace.curves()[1][-1].tolist() == [251.0]


def test_every_shape_is_drawn_at_its_size(tmp_path: Path) -> None:
    shapes = {
        "box": ("0.1 0.2 0.3", (0.1, 0.2, 0.3)),
        "sphere": ("0.1", (0.1, 0.1, 0.1)),
        "ellipsoid": ("0.1 0.2 0.3", (0.1, 0.2, 0.3)),
        "capsule": ("0.1 0.2", (0.1, 0.1, 0.3)),
        "cylinder": ("0.1 0.2", (0.1, 0.1, 0.2)),
        "plane": ("0.1 0.2 1", (0.1, 0.2, 0.0)),
    }
    geoms = "".join(
        f'<geom type="{kind}" size="{size}" rgba="1 0 0 0.5"/>'
        for kind, (size, _) in shapes.items()
    )
    hidden = '<geom size="1" group="3"/><geom size="1" rgba="1 1 1 0"/>'
    text = f"<mujoco><worldbody>{geoms}{hidden}</worldbody></mujoco>"
    props = props_of(mujoco.MjModel.from_xml_string(text))
    assert len(props) == len(shapes)
    for prop, (_, half) in zip(props, shapes.values(), strict=True):
        corners = prop.triangles.reshape(-1, 3)
        np.testing.assert_allclose(corners.max(axis=0), half, rtol=0.02, atol=1e-9)
        np.testing.assert_allclose(corners.min(axis=0), np.negative(half), rtol=0.02, atol=1e-9)
        assert prop.skin.image.tolist() == [[[255, 0, 0, 128]]]


def live(recording: Recording, capacity: int) -> tuple[Show, Ring]:
    ring = Ring.local(capacity)
    ring.cursors[1] = 1 << 62  # nobody frees anything
    return Show(ring, recording), ring


def glance(show: Show) -> Sight | None:
    show.gather()
    return show.look()


def test_live_view_follows_the_ring_and_reads_it_without_freeing_anything(floor: Path) -> None:
    recording = read_recording(floor)
    show, ring = live(recording, 4096)
    ring.cursors[1] = 0
    assert glance(show) is None
    for start, end in ((0, 33), (33, 700), (700, 1500)):
        ring.append(recording.ticks[start:end])
        sight = glance(show)
        assert sight is not None
        row = recording.ticks[end - 1]
        ball = sight.places[show.model.body("ball").id]
        np.testing.assert_allclose(ball, row["tool_position"], atol=1e-9)
    assert sight is not None
    assert len(sight.contact_places) == 1
    assert glance(show) is None
    assert ring.cursors[1] == 0
    assert not show.warning


def test_records_that_come_while_the_view_reads_are_shown_the_next_time(
    floor: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = read_recording(floor)
    show, ring = live(recording, 4096)
    ring.cursors[1] = 0

    def wait() -> None:  # whoever reads is put aside between any two steps
        head = int(ring.cursors[0])
        ring.rows[head : head + 7] = recording.ticks[head : head + 7]
        ring.cursors[0] = head + 7

    monkeypatch.setattr(ring, "_fence", wait)
    for _ in range(40):
        sight = glance(show)
    assert sight is not None
    assert not show.warning


def behind(recording: Recording, first: int) -> tuple[Show, Ring]:
    """A view that saw 50 records and then none until the ring holds 63 up to another tick."""
    show, ring = live(recording, 64)
    ring.rows[:50] = recording.ticks[:50]
    ring.cursors[0] = 50
    assert glance(show) is not None
    assert not show.warning
    bring(ring, recording, first)
    return show, ring


def bring(ring: Ring, recording: Recording, end: int) -> None:
    ticks = np.arange(end - 64, end)
    ring.rows[ticks % 64] = recording.ticks[ticks]
    ring.cursors[0] = end


def test_a_view_that_fell_behind_says_so_and_picks_the_run_up_again(
    floor: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = read_recording(floor)
    monkeypatch.delattr(Rerun, "restart")  # the scene stays as it was left
    show, ring = behind(recording, 900)
    for end in range(900, 1000, 20):
        bring(ring, recording, end)
        sight = glance(show)
    assert sight is not None
    assert "skipped 0.79 s" in show.warning  # 50 to 837 ms
    assert "mm from where" not in show.warning
    last = recording.ticks[979]
    np.testing.assert_array_equal(sight.grip, last["tool_position"])
    ball = sight.places[show.model.body("ball").id]
    np.testing.assert_allclose(ball, last["tool_position"], atol=2e-4)
    # pressed on the floor again, with the force that the coupling has by the record
    force = sight.contact_forces.sum(axis=0)
    np.testing.assert_allclose(force[2], -last["wrench_on_tool"][2], rtol=0.1)


def test_the_margin_of_a_run_that_was_skipped_is_never_drawn_larger_than_it_is(
    floor: Path, replay: Replay
) -> None:
    recording = read_recording(floor)
    show, ring = behind(recording, 900)
    for end in range(900, 1480, 20):
        bring(ring, recording, end)
        glance(show)
    curves = show.curves()
    assert curves is not None
    drawn, true = curves[1][4][-1], replay.trace.curves()[1][4][-1]
    assert 0 < drawn < true


def test_a_tool_that_cannot_be_put_anywhere_is_led_and_its_distance_is_said(
    tmp_path: Path,
) -> None:
    hinged = FLOOR.replace("<freejoint/>", '<joint axis="0 1 0" pos="0 0 0.1" range="-1 1"/>')
    scene, path = tmp_path / "arm.xml", tmp_path / "arm.mcap"
    scene.write_text(hinged.replace('pos="0 0 0.03"', 'pos="0 0 0.1"'))
    recorded(path, str(scene), ScriptedDevice(pressed), LOOSE, duration=1.5)
    recording = read_recording(path)
    show, ring = behind(recording, 500)
    for end in range(500, 1400, 60):
        bring(ring, recording, end)
        glance(show)
    assert "skipped" in show.warning
    assert "mm from where it is drawn" not in show.warning
    recording.ticks["tool_position"][:, 1] += 0.05  # where no hinge lets it be
    bring(ring, recording, 1450)
    glance(show)
    assert "the tool is 50 mm from where it is drawn" in show.warning


def test_news_that_come_too_late_are_said_and_do_not_hold_the_view_up(floor: Path) -> None:
    recording = read_recording(floor)
    show, ring = live(recording, 4096)
    ring.cursors[1] = 0
    ring.append(recording.ticks[:100])
    glance(show)
    show.note({"event": "switch", "tick": 90, "force": True, "clutch": False})
    ring.append(recording.ticks[100:200])
    sight = glance(show)
    assert sight is not None
    assert "lost the run at 0.1 s" in show.warning
    ball = sight.places[show.model.body("ball").id]
    np.testing.assert_allclose(ball, recording.ticks["tool_position"][199], atol=2e-4)


def answer(
    host: str, port: int, path: str = "/", method: str = "GET", **headers: str
) -> tuple[int, str, str]:
    """Returns status, cookie and body of a request."""
    client = http.client.HTTPConnection(host, port, timeout=20)
    with contextlib.closing(client):
        client.request(method, path, headers=headers)
        got = client.getresponse()
        return got.status, got.getheader("Set-Cookie") or "", got.read().decode("utf-8", "ignore")


def is_let_in(host: str, port: int, path: str = "/", **options: Any) -> bool:
    try:
        with connect(
            f"ws://{host}:{port}{path}", subprotocols=[Subprotocol("viser-v0")], **options
        ):
            return True
    except websockets.exceptions.InvalidStatus as refused:
        assert refused.response.status_code == 403
        return False


def test_the_server_answers_its_own_page_alone(replay: Replay) -> None:
    with served(replay, Address("127.0.0.1", 0)) as (theatre, port):
        assert theatre.url == f"http://127.0.0.1:{port}/"
        assert answer("127.0.0.1", port)[0] == 200
        assert answer("127.0.0.1", port, Host="evil.example")[0] == 403
        assert answer("127.0.0.1", port, Origin="http://evil.example")[0] == 403
        assert is_let_in("127.0.0.1", port)
        assert is_let_in("127.0.0.1", port, origin=f"http://127.0.0.1:{port}")
        assert not is_let_in("127.0.0.1", port, origin="http://evil.example")
        # a second Host beside the right one, as a careless proxy might read it
        assert not is_let_in("127.0.0.1", port, additional_headers={"Host": "evil.example"})
        # viser's own way out to the internet is gone
        handlers = theatre._server._websock_server._incoming_handlers
        gone = ("ShareUrl", "FileTransferStart")  # nor does it keep files for anybody
        assert not any(handlers[kind] for kind in handlers if kind.__name__.startswith(gone))
        with socket.socket() as probe, pytest.raises(OSError, match="refused"):
            probe.connect((OUTSIDE, port))  # served on loopback's first address alone


def test_another_address_needs_the_token(replay: Replay) -> None:
    address = outside()
    with served(replay, address) as (_, port):
        status, cookie, _ = answer(OUTSIDE, port)
        assert (status, cookie) == (403, "")
        assert answer(OUTSIDE, port, "/?token=wrong")[0] == 403
        assert not is_let_in(OUTSIDE, port)
        assert not is_let_in(OUTSIDE, port, additional_headers={"Cookie": f"{COOKIE}=wrong"})
        status, cookie, _ = answer(OUTSIDE, port, f"/?token={address.token}")
        assert status == 200
        assert cookie == f"{COOKIE}={address.token}; Path=/; HttpOnly; SameSite=Strict"
        kept = {"Cookie": cookie.split(";")[0]}
        assert answer(OUTSIDE, port, **kept)[0] == 200
        assert is_let_in(OUTSIDE, port, additional_headers=kept)
        assert not is_let_in(OUTSIDE, port, additional_headers=kept, origin="http://evil.example")


def test_a_port_in_use_is_said_and_not_exchanged(replay: Replay) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(HapticBridgeError, match=f"port {port} is in use"):
            Theatre(replay, Address("127.0.0.1", port))


def test_a_browser_sees_the_tool_move_with_the_slider(replay: Replay, tmp_path: Path) -> None:
    with served(replay, Address("127.0.0.1", 0)) as (theatre, _), browser(tmp_path) as tab:
        page = tab()
        page.open(theatre.url)
        page.wait_for("document.body.innerText.includes('Passivity margin')")
        page.wait_for("document.querySelectorAll('canvas').length >= 5")
        middle, end = np.full(2, np.nan), time.monotonic() + PATIENCE
        for moment, way in ((0.0, 0.0), (1.2, 20.0)):  # by then it was moved 4 cm aside
            theatre.slider.value = moment
            before, is_there = middle, False
            while not is_there:  # and stands still: a page that loads moves its camera
                assert time.monotonic() < end
                last = middle
                page.picture(tmp_path / "shown.png")
                pixels = np.asarray(Image.open(tmp_path / "shown.png").convert("RGB"), dtype=int)
                is_red = (pixels[..., 0] > 100) & (pixels[..., 1:].max(axis=2) < 60)
                if is_red[:, :600].sum() > 50:
                    middle = np.argwhere(is_red[:, :600]).mean(axis=0)
                    is_there = np.abs(middle - last).max() < 1.0
                    is_there = is_there and not np.abs(middle - before).max() <= way
        own = ("data:", "blob:", theatre.url)
        assert [request[:99] for request in page.requests if not request.startswith(own)] == []
        assert page.complaints == []


def test_whatever_a_browser_sends_for_the_time_the_replay_goes_on(
    replay: Replay, capfd: pytest.CaptureFixture[str]
) -> None:
    with served(replay, Address("127.0.0.1", 0)) as (theatre, _), hand(theatre.url) as page:
        for value in (float("nan"), float("inf"), -1e308, "x", None, [1.0], {"a": 1}):
            page.send("time (s)", value=value)
        page.send("play", value="x")
        page.send("time (s)", value=1.2)
        assert said(page, "**1.2").startswith("**1.200 s**")
    assert "Traceback" not in capfd.readouterr().err


def test_of_two_times_that_are_asked_for_at_once_the_newer_stays(
    replay: Replay, monkeypatch: pytest.MonkeyPatch
) -> None:
    with served(replay, Address("127.0.0.1", 0)) as (theatre, _), hand(theatre.url) as page:
        draw, is_drawing = theatre._page.show, threading.Event()

        def slow_at_first(sight: Sight) -> None:
            if sight.time < 1.0:
                is_drawing.set()
                time.sleep(0.3)  # in which the newer would be drawn, if it did not wait
            draw(sight)

        monkeypatch.setattr(theatre._page, "show", slow_at_first)
        page.send("time (s)", value=0.4)
        assert is_drawing.wait(PATIENCE)
        page.send("time (s)", value=1.2)
        said(page, "**1.200 s**")
        time.sleep(0.5)
        assert theatre._page.status.content.startswith("**1.200 s**")


def test_a_replay_that_plays_moves_on_and_begins_again_at_its_end(replay: Replay) -> None:
    is_over = threading.Event()
    with served(replay, Address("127.0.0.1", 0)) as (theatre, _), hand(theatre.url) as page:
        player = threading.Thread(target=theatre.play, args=(is_over,))
        player.start()
        try:
            page.send("time (s)", value=1.2)
            page.send("play", value=True)
            said(page, "**1.4")
            said(page, "**0.")
        finally:
            is_over.set()
            player.join(PATIENCE)
    assert not player.is_alive()


def test_a_killed_view_and_ten_deaf_browsers_do_not_touch_the_run(
    floor: Path, tmp_path: Path
) -> None:
    path, window = tmp_path / "run.mcap", Window(Address("127.0.0.1", 0))
    deaf: list[Any] = []

    def disturb(_: Bridge, tick: int) -> None:
        if tick == 100:
            address = window.url.replace("http", "ws")
            version = [Subprotocol(f"viser-v{sys.modules['viser'].__version__}")]
            deaf.extend(connect(address, subprotocols=version) for _ in range(10))
        if tick == 700:
            assert window.process_id is not None
            os.kill(window.process_id, signal.SIGKILL)

    scene, device = str(floor.with_name("floor.xml")), ScriptedDevice(pressed)
    summary = recorded(path, scene, device, LOOSE, duration=1.5, on_tick=disturb, onlooker=window)
    for client in deaf:
        with contextlib.suppress(Exception):
            client.close()
    assert (summary.ticks, summary.dropped, summary.overruns) == (1500, 0, 0)
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_the_button_of_the_page_stops_the_run_and_the_recording_says_who_did(
    floor: Path, tmp_path: Path
) -> None:
    path, window = tmp_path / "run.mcap", Window(Address("127.0.0.1", 0))
    scene = str(floor.with_name("floor.xml"))
    with (
        Bridge(scene, ScriptedDevice(pressed), LOOSE, recording=path, onlooker=window) as bridge,
        browser(tmp_path) as tab,
    ):
        window.on_command = partial(bridge.command, by="view")
        page = tab()
        page.open(window.url)
        button = "[...document.querySelectorAll('button')].find(b => b.innerText == 'stop the run')"
        page.wait_for(f"!!{button}")
        presser = threading.Timer(1.0, page.value, [f"{button}.click()"])
        presser.start()
        summary = bridge.run(60.0)
        presser.join()
    assert summary.stopped_by == "view"
    assert 0 < summary.ticks < 60_000
    stop = read_recording(path).events[-1]
    assert (stop["event"], stop["reason"]) == ("stop", "view")
    assert audit(path).verdict == "passive"


SWITCH = line_of(Switch(force=False))


@pytest.mark.parametrize(
    ("said", "heard", "refused"),
    [
        (line_of(Stop()), [Stop()], 0),
        (SWITCH + line_of(Couple(900.0, 0.5)), [Switch(force=False), Couple(900.0, 0.5)], 0),
        (b'{"command": "stop", "force": 99}\n' + SWITCH, [Switch(force=False)], 1),
        (b'{"command": "couple", "stiffness": 1e999, "damping": 0}\n', [], 1),
        (b'{"command": "couple", "stiffness": NaN, "damping": 0}\n', [], 1),
        (b'{"command": "couple", "stiffness": true, "damping": 0}\n', [], 1),
        (b'{"command": "switch", "force": 1}\n', [], 1),
        (b'{"command": "exec"}\n[]\n\xff\n\n', [], 4),
        (b"x" * 100_000 + b"\n" + SWITCH, [], 0),  # longer than a command: deaf from then on
        (b"", [], 0),
    ],
)
def test_a_run_hears_commands_and_nothing_else(
    said: bytes, heard: list[Command], refused: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hapticbridge.view.window.INTERVAL", 0.0)
    window = Window(Address("127.0.0.1", 0))
    commands: list[Command] = []
    window.on_command = commands.append
    process = types.SimpleNamespace(stdout=io.BytesIO(said))
    window._process = process  # type: ignore[assignment] # of a process, only what it says
    window._listen()
    assert commands == heard
    answers = [json.loads(window._outbox.get() or b"") for _ in range(window._outbox.qsize())]
    assert [answer["event"] for answer in answers] == ["refused"] * refused


def test_a_view_that_cannot_be_served_is_said_before_the_run(floor: Path, call: Called) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        code, _, err = call("run", floor.with_name("floor.xml"), "--fast", "--view", "--port", port)
    assert code == 2
    assert f"port {port} is in use" in err


def test_without_the_extra_a_sentence_says_how_to_get_it(
    floor: Path, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    for command in (("view", floor), ("run", "peg_in_hole", "--view")):
        code, _, err = call(*command)
        assert code == 2
        assert "hapticbridge[view]" in err


def test_an_event_of_the_run_reaches_the_view(floor: Path) -> None:
    recording = read_recording(floor)
    show, ring = live(recording, 4096)
    ring.cursors[1] = 0
    # as the bridge tells it: what was set before tick 10
    show.note(json.loads(json.dumps({"event": "input", "tick": 10, "writes": [["ctrl", 99, [1]]]})))
    ring.append(recording.ticks[:10])
    glance(show)
    assert not show.warning
    ring.append(recording.ticks[10:20])
    glance(show)
    assert show.warning  # the scene has no such control: applied, not passed over
