"""The page of a run: what it shows, whom it answers, and that the loop never notices it."""

from __future__ import annotations

import contextlib
import http.client
import io
import json
import socket
import subprocess
import threading
import time
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from cli_cases import Called
from report_runs import LOOSE

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.commands import Command, Couple, Switch
from hapticbridge.commands.command import Stop, line_of
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.film_process import Stage
from hapticbridge.recording import Attachment, Ring, read_recording
from hapticbridge.recording.snapshot import Snapshot
from hapticbridge.view.window import Address, Window

pytest.importorskip("viser", reason="needs the extra 'view'")

import websockets.exceptions
from page_client import PATIENCE, hand, said
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from hapticbridge.view.geometry import Tendons
from hapticbridge.view.page import Sight
from hapticbridge.view.process import LiveRun, run_of
from hapticbridge.view.replay import Replay, Theatre, contacts_of
from hapticbridge.view.server import serve, stop

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
    )
    assert len(sights) == 28  # of 900 ticks, one in 33
    assert summary.dropped == 0  # it frees no record
    assert watcher.live is not None
    time, lines = watcher.live.trace.curves()
    ticks = read_recording(path).ticks
    at = np.searchsorted(ticks["deadline_ns"], np.round(1e9 * time).astype(np.int64))
    np.testing.assert_allclose(lines[2], 1e3 * ticks["device_energy"][at])
    force = np.linalg.norm(ticks["wrench_on_tool"][:, :3], axis=1)
    assert lines[0].max() == pytest.approx(force[: at[-1] + 1].max())
    stage, touched = Stage(path), 0
    lift = stage.model.body("lift").id
    for sight in sights:
        stage.show(stage.tick_at(sight.time))
        contacts = contacts_of(stage.model, stage.data)
        again = Sight.of(stage.model, stage.data, stage.row, Tendons(stage.model), contacts)
        assert sight.time == again.time
        np.testing.assert_array_equal(sight.places, again.places)
        np.testing.assert_array_equal(sight.turns, again.turns)
        np.testing.assert_array_equal(sight.contact_places, again.contact_places)
        np.testing.assert_allclose(sight.contact_forces, again.contact_forces, atol=1e-12)
        np.testing.assert_array_equal(sight.grip, again.grip)
        touched += len(sight.contact_places) > 0
    assert touched > 5
    assert np.ptp([sight.places[lift, 2] for sight in sights]) > 0.008
    assert audit(path).resimulation == "bit for bit"


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


@pytest.mark.parametrize(
    ("host", "origin", "reason"),
    [
        ("127.0.0.1:8080", None, ""),
        ("localhost:8080", "http://localhost:8080", ""),
        ("[::1]:8080", "http://[::1]:8080", ""),
        ("evil.example:8080", None, "not the host"),
        ("127.0.0.1.evil.example", None, "not the host"),
        ("", None, "not the host"),
        ("[::1", None, "not the host"),
        ("127.0.0.1:8080", "http://evil.example", "another page"),
        ("127.0.0.1:8080", "http://127.0.0.1:9999", "another page"),
        ("127.0.0.1:8080", "https://127.0.0.1:8080", "another page"),
        ("127.0.0.1:8080", "null", "another page"),
    ],
)
def test_only_requests_of_its_own_page_are_answered(
    host: str, origin: str | None, reason: str
) -> None:
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
    address = Address(8080)
    said = address.refusal(f"/?token={address.token}", headers)
    assert (reason in said) if reason else said == ""


@pytest.mark.parametrize("way", ["query", "cookie"])
def test_token_opens_and_nothing_else_does(way: str) -> None:
    address = Address()
    assert len(address.token) >= 32
    assert address.token != Address().token
    assert address.token not in repr(address)

    def refusal(token: str) -> str:
        headers = {"host": "127.0.0.1:80"}
        if way == "cookie":
            return address.refusal("/", headers | {"cookie": f"a=b; hapticbridge_80={token}"})
        return address.refusal(f"/x?a=b&token={token}", headers)

    assert refusal(address.token) == ""
    for wrong in ("", address.token[:-1], address.token + "x", "ü", address.token.swapcase()):
        assert "token" in refusal(wrong)
    assert "token" in address.refusal("/", {"host": "localhost"})
    assert "token" in address.refusal("//[", {"host": "localhost"})  # not a path


def test_the_server_answers_its_own_page_alone_and_a_browser_keeps_its_token(
    replay: Replay,
) -> None:
    address, host = Address(0), "127.0.0.1"
    with served(replay, address) as (theatre, port):
        secret, evil = f"/?token={address.token}", "http://evil.example"
        kept, wrong = f"hapticbridge_{port}={address.token}", f"hapticbridge_{port}=wrong"
        assert theatre.url == f"http://{host}:{port}{secret}"
        # path, headers, whether it is answered
        requests: list[tuple[str, dict[str, str], bool]] = [
            (secret, {}, True),
            (secret, {"Host": "evil.example"}, False),
            (secret, {"Origin": evil}, False),
            ("/", {}, False),
            ("/?token=wrong", {}, False),
            ("/", {"Cookie": kept}, True),
            ("/", {"Cookie": wrong}, False),
        ]
        for path, headers, is_answered in requests:
            assert (answer(host, port, path, **headers)[0] == 200) is is_answered
            # a second Host beside the right one, as a careless proxy might read it
            options = {"additional_headers": headers}
            assert is_let_in(host, port, path, **options) is is_answered
        assert is_let_in(host, port, secret, origin=f"http://{host}:{port}")
        assert answer(host, port)[1] == ""
        _, cookie, _ = answer(host, port, secret)
        assert cookie == f"{kept}; Path=/; HttpOnly; SameSite=Strict"
        # through a tunnel from another port, which gets a cookie of its own
        _, cookie, _ = answer(host, port, secret, Host="localhost:9000")
        assert f"hapticbridge_9000={address.token}" in cookie
        with socket.socket() as probe, pytest.raises(OSError, match="refused"):
            probe.connect(("127.0.0.2", port))  # served on loopback's first address alone


def test_visers_way_out_to_the_internet_and_its_store_of_files_are_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    address, asked = Address(0), list[str]()
    server = serve(address)
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(server, name, lambda name=name: asked.append(name))
    box, upload = server.gui.add_checkbox("box", False), server.gui.add_upload_button("upload")
    try:
        with hand(address.url(server.get_port())) as page:
            page.find("upload")
            file = {"filename": "a", "mime_type": "", "part_count": 0, "size_bytes": 0}
            page.say(type="ShareUrlRequest")
            page.say(type="ShareUrlDisconnect")
            place = {"source_component_uuid": page.find("upload")["uuid"], "transfer_uuid": "b"}
            page.say(type="FileTransferStartUpload", **place, **file)
            page.send("box", value=True)  # heard after all that
            end = time.monotonic() + PATIENCE
            while not box.value:
                assert time.monotonic() < end
                assert "FileTransferPartAck" not in {each["type"] for each in page.read(0.05)}
            assert "FileTransferPartAck" not in {each["type"] for each in page.read(0.05)}
        assert (asked, upload.value.content) == ([], b"")
    finally:
        stop(server)


def test_a_port_that_cannot_be_had_is_named_and_not_exchanged(
    replay: Replay, floor: Path, call: Called
) -> None:
    for port in (65536, -1):
        with pytest.raises(HapticBridgeError, match=f"port is {port}"):
            Address(port)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(HapticBridgeError, match=f"port {port} is in use"):
            Theatre(replay, Address(port))
        code, _, err = call("run", floor.with_name("floor.xml"), "--fast", "--view", "--port", port)
    assert (code, f"port {port} is in use" in err) == (2, True)


def test_whatever_a_browser_sends_for_the_time_the_replay_plays_on(
    replay: Replay, capfd: pytest.CaptureFixture[str]
) -> None:
    is_over = threading.Event()
    with served(replay, Address(0)) as (theatre, _), hand(theatre.url) as page:
        for value in (float("nan"), float("inf"), -1e308, "x", None, [1.0], {"a": 1}):
            page.send("time (s)", value=value)
        page.send("play", value="x")
        page.send("time (s)", value=1.2)
        assert said(page, "**1.2").startswith("**1.200 s**")
        player = threading.Thread(target=theatre.play, args=(is_over,))
        player.start()
        try:
            page.send("play", value=True)
            said(page, "**1.4")
            said(page, "**0.")  # from its end it begins again
        finally:
            is_over.set()
            player.join(PATIENCE)
    assert not player.is_alive()
    assert "Traceback" not in capfd.readouterr().err


SWITCH = line_of(Switch(force=False))


class SayingProcess:
    """A view's process that serves its page and says something; it keeps what it is told."""

    def __init__(self, said: bytes) -> None:
        self.is_heard, self.is_told = threading.Event(), threading.Event()
        lines = [b'{"url": "u"}\n', *said.splitlines(keepends=True)]
        self.stdout = types.SimpleNamespace(readline=self.readline, close=lambda: None)
        self.stdin = types.SimpleNamespace(
            write=self.write, flush=lambda: None, close=self.is_told.set
        )
        self.said, self.told = io.BytesIO(b"".join(lines)), b""

    def readline(self, limit: int = -1) -> bytes:
        line = self.said.readline(limit)
        if not line.endswith(b"\n"):  # the end, or a line that is too long
            self.is_heard.set()
        return line

    def write(self, piece: bytes) -> None:
        self.told += piece

    def wait(self, _timeout: float) -> None:
        """Has ended."""


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
    process = SayingProcess(said)
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: process)
    window, commands = Window(Address(0)), list[Command]()
    window.on_command = commands.append
    window.start("ring", "snapshot", {}, ())
    process.is_heard.wait(PATIENCE)
    window.close()
    process.is_told.wait(PATIENCE)
    assert commands == heard
    job, *answers = [json.loads(line) for line in process.told.splitlines()]
    assert job["ring"] == "ring"
    assert [answer["event"] for answer in answers] == ["refused"] * refused


def test_without_the_extra_a_sentence_says_how_to_get_it(
    floor: Path, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    for command in (("view", floor), ("run", "peg_in_hole", "--view")):
        code, _, err = call(*command)
        assert code == 2
        assert "hapticbridge[view]" in err
