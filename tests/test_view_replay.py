"""Replay of a recording: what it shows, and whom it plays for."""

from __future__ import annotations

import base64
import contextlib
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from chromium import browser
from cli_cases import Called
from view_cases import pressed_floor, tapped_wall

from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import install_command
from hapticbridge.recording import read_recording
from hapticbridge.replay.stage import Stage
from hapticbridge.view.window import Address

pytest.importorskip("viser", reason="needs the extra 'view'")

import msgspec
from page_client import hand, said
from waiting import PATIENCE

from hapticbridge.view.page import Sight
from hapticbridge.view.replay import Replay, Theatre

# viser's threads and sockets end with the process
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Replay:
    return Replay(pressed_floor(tmp_path_factory.mktemp("view")))


@contextlib.contextmanager
def served(replay: Replay, address: Address) -> Iterator[tuple[Theatre, int]]:
    theatre = Theatre(replay, address)
    try:
        yield theatre, int(theatre.url.split(":")[2].split("/")[0])
    finally:
        theatre.close()


def test_sights_stand_where_the_record_says_and_contacts_carry_the_force(replay: Replay) -> None:
    records = read_recording(replay.recording.path).ticks
    ball = Stage(replay.recording).model.body("ball").id
    for moment in (0.0, 0.4, 1.2):
        sight = replay.sight_at(moment)
        row = records[max(round(sight.time * 1000) - 1, 0)]
        np.testing.assert_allclose(sight.places[ball], row["tool_position"], atol=1e-9)
        np.testing.assert_allclose(sight.hands[0].handle, row["handle_position"])
    still = replay.sight_at(1.1)  # before a handle that stands still is probed
    assert np.linalg.norm(still.hands[0].hand_force) > 1
    np.testing.assert_allclose(
        still.hands[0].hand_force, -still.hands[0].tool_force
    )  # as force_scale is 1
    assert len(still.contact_places) == 1
    # at rest what the coupling pushes the floor gives back
    np.testing.assert_allclose(
        still.contact_forces.sum(axis=0), -still.hands[0].tool_force, atol=2e-2
    )
    assert not len(replay.sight_at(0.0).contact_places)


def test_a_port_that_cannot_be_had_is_named_and_not_exchanged(replay: Replay, call: Called) -> None:
    for port in (65536, -1):
        with pytest.raises(HapticBridgeError, match=f"port is {port}"):
            Address(port)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(HapticBridgeError, match=f"port {port} is in use"):
            Theatre(replay, Address(port))
        code, _, err = call(
            "run",
            replay.recording.path.with_name("floor.xml"),
            "--fast",
            "--view",
            "--port",
            port,
        )
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


def test_without_the_extra_a_sentence_says_how_to_get_it(
    replay: Replay, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    for command in (("view", replay.recording.path), ("run", "peg_in_hole", "--view")):
        code, _, err = call(*command)
        assert code == 2
        assert install_command("view") in err


def embedded(page: str) -> dict[str, Any]:
    """Returns what a saved page holds: its duration and the messages that move the scene."""
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found is not None
    packed = base64.b64decode(found[1])
    size = int.from_bytes(packed[:8], "little")
    plain = zstandard.ZstdDecompressor().decompress(packed[8:], max_output_size=size)
    length = int.from_bytes(plain[:8], "little")
    held: dict[str, Any] = msgspec.msgpack.decode(plain[8 : 8 + length])
    return held


def test_a_saved_page_holds_the_whole_run(replay: Replay, call: Called, tmp_path: Path) -> None:
    page = tmp_path / "run.html"
    code, out, _ = call("view", replay.recording.path, "--save", page)
    assert code == 0
    assert f"wrote {page}" in out
    held = embedded(page.read_text(encoding="utf-8"))
    assert held["durationSeconds"] == pytest.approx(len(replay.sights) * replay.step)
    # the tool's body is at the recorded place at the time that the page has reached
    ball = Stage(replay.recording).model.body("ball").id
    moves = [
        (time, message["position"])
        for time, message in held["messages"]
        if (message["type"], message.get("name")) == ("SetPositionMessage", f"/body{ball}")
    ]
    assert len(moves) > 10
    for time, position in moves:
        np.testing.assert_allclose(position, replay.sight_at(time).places[ball], atol=1e-6)


def test_page_and_saved_page_show_a_blow_for_a_time(tmp_path: Path) -> None:
    replay = Replay(tapped_wall(tmp_path))
    (first, *_) = (sight for sight in replay.sights if sight.blow is not None)
    again = Sight.from_parts(first.parts(), replay.scenery.bodies, 0).blow
    assert first.blow is not None
    assert again is not None
    assert again.parts() == first.blow.parts()
    broken = [*first.parts()[:-1], [0.0] * 6]
    with pytest.raises(RecordingError, match="cannot be drawn"):
        Sight.from_parts(broken, replay.scenery.bodies, 0)
    with served(replay, Address(0)) as (theatre, _), hand(theatre.url) as client:
        client.send("time (s)", value=first.time)
        assert said(client, f"**{first.time:.3f}").endswith(first.blow.words)
        held = embedded(theatre.page())["messages"]
    marks = [(time, each) for time, each in held if each.get("name") == "/blow"]
    seen = [
        (time, each["visible"])
        for time, each in marks
        if each["type"] == "SetSceneNodeVisibilityMessage"
    ]
    # it is not seen at first; two blows are 1/3 s apart, and a blow is marked for longer
    assert seen == [(0.0, False), (pytest.approx(first.time, abs=replay.step), True)]
    places = [each["position"] for _, each in marks if each["type"] == "SetPositionMessage"]
    np.testing.assert_allclose(places[-2:], [first.blow.place] * 2, atol=1e-3)
    words = [
        each["updates"]["text"]
        for _, each in held
        if each.get("name") == "/blow/words" and "updates" in each
    ]
    assert first.blow.words in words


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("run.png", "must end in .html"),
        ("mine.html", "exists; choose another file or add --overwrite"),
        ("no/such.html", "no does not exist"),
    ],
)
def test_a_page_that_cannot_be_saved_is_refused_before_the_run_is_simulated(
    replay: Replay,
    call: Called,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    sentence: str,
) -> None:
    (tmp_path / "mine.html").write_text("mine", encoding="utf-8")
    monkeypatch.setattr("hapticbridge.view.replay.Replay", pytest.fail)
    code, _, err = call("view", replay.recording.path, "--save", tmp_path / name)
    assert code == 2
    assert sentence in " ".join(err.split())
    assert (tmp_path / "mine.html").read_text(encoding="utf-8") == "mine"


def test_a_browser_plays_a_saved_page_without_a_request(replay: Replay, tmp_path: Path) -> None:
    page = tmp_path / "run.html"
    with served(replay, Address(0)) as (theatre, _):
        page.write_text(theatre.page(), encoding="utf-8")
    with browser(tmp_path) as tab:
        shown = tab()
        shown.open(page.as_uri())
        shown.wait_for("document.querySelector('canvas') !== null")
        asked = [each for each in shown.requests if not each.startswith(("data:", "blob:"))]
        assert asked == [page.as_uri()]
