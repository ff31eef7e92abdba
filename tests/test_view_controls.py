"""The controls of the page: what a browser's hand does to a run, and what no hand can."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from audit_cases import COUPLING, ScriptedDevice
from chromium import browser
from report_runs import LOOSE
from test_bridge_commands import FLOOR, STEPS, swaying
from test_commands import allowance

from hapticbridge.audit import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.demand.guard import Limits
from hapticbridge.errors import HapticBridgeError, SafetyTrip
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Couple, Stop, Switch, command_of
from hapticbridge.view.window import Address, Window

pytest.importorskip("viser", reason="needs the extra 'view'")

from page_client import Hand, hand, said
from waiting import PATIENCE, until

from hapticbridge.view.controls import Controls, Outlet
from hapticbridge.view.server import serve, stop

# viser's threads and sockets end with the process
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

CLUTCH = "clutch (the hand moves alone)"
K, B = "stiffness K (N/m)", "damping B (N s/m)"
KR, BR = "turning stiffness K_r (N m/rad)", "turning damping B_r (N m s/rad)"


@contextlib.contextmanager
def running(folder: Path) -> Iterator[tuple[Bridge, Window]]:
    """A run in real time with its page, until the block is over."""
    scene, window = folder / "floor.xml", Window(Address(0))
    scene.write_text(FLOOR)
    failed: list[BaseException] = []

    def run() -> None:
        try:
            bridge.run(2 * PATIENCE)
        except HapticBridgeError as error:
            failed.append(error)

    device, path = ScriptedDevice(swaying), folder / "run.mcap"
    with Bridge(str(scene), device, LOOSE, recording=path, observer=window) as bridge:
        window.on_command = partial(bridge.command, by="view")
        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield bridge, window
        finally:
            bridge.stop("test")
            thread.join()
    assert not failed


def events(path: Path, name: str) -> list[dict[str, Any]]:
    return [event for event in read_recording(path).events if event["event"] == name]


def stiffness(bridge: Bridge) -> float:
    return float(bridge.session.kernel.bound.state["coupling"]["stiffness"][0])


def test_a_slider_of_the_page_moves_the_stiffness_and_the_recording_says_so(tmp_path: Path) -> None:
    with running(tmp_path) as (bridge, window), browser(tmp_path) as tab:
        page = tab()
        page.open(window.url, 1200, 1300)
        page.wait_for("document.querySelectorAll('[role=slider]').length >= 2")
        page.wait_for("document.body.innerText.includes('They end where the device')")
        page.value("document.querySelectorAll('[role=slider]')[0].focus()")
        before = stiffness(bridge)
        page.press("Home")  # its least value
        until(lambda: stiffness(bridge) == pytest.approx(200.0))
        page.wait_for("document.body.innerText.includes('goes to K = 200 N/m')")
        # viser's sorter of splats, which nothing here draws, is refused to evaluate text
        assert all("Evaluating a string as JavaScript" in each for each in page.complaints)
        own = ("data:", "blob:", window.url.partition("?")[0])
        assert [request[:99] for request in page.requests if not request.startswith(own)] == []
    told = events(tmp_path / "run.mcap", "coupling")
    assert before == LOOSE.stiffness
    assert told[-1]["stiffness"] == pytest.approx(200.0)
    assert told[-1]["by"] == "view"
    report = audit(tmp_path / "run.mcap")
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_nothing_that_is_sent_by_hand_exceeds_a_limit(tmp_path: Path) -> None:
    with running(tmp_path) as (bridge, window), hand(window.url) as page:
        page.send(K, value=1e6)
        assert "needs a device of 500 N s/m, and this one has 2" in said(page, "refused")
        # a slider without an end, and values that are none
        page.send(K, max=1e9, value=9e8)
        page.send(B, max=1e9, value=50.0)
        for value in (float("nan"), -5.0, "x"):
            page.send(K, value=value)
        page.send("mark this moment", value=True)
        said(page, "marked at")
        page.send(K, value=1500.0)  # the page still listens, and so does the run
        until(lambda: stiffness(bridge) == pytest.approx(1500.0))
        page.send(KR, value=1e3)
        assert "needs a device of 0.5 N m s/rad, and this one has 0.002" in said(page, "0.5 N m")
        for turning in (float("nan"), -1.0, None, [1.0], "x"):
            page.send(BR, value=turning)
        time.sleep(0.3)
        page.send(KR, value=3.0)
        coupling = bridge.session.kernel.bound.state["coupling"]
        until(lambda: coupling["rotational_stiffness"][0] == pytest.approx(3.0))
    [mark] = events(tmp_path / "run.mcap", "mark")
    assert mark["by"] == "view"
    told = events(tmp_path / "run.mcap", "coupling")
    assert told
    for event in told:
        assert event["stiffness"] * 1e-3 / 2 + event["damping"] <= 2.0 * (1 + 1e-9)
        turning = event["rotational_stiffness"] * 1e-3 / 2 + event["rotational_damping"]
        assert turning <= 2e-3 * (1 + 1e-9)
    assert told[-1]["rotational_stiffness"] == 3.0
    report = audit(tmp_path / "run.mcap")
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


@contextlib.contextmanager
def controls() -> Iterator[tuple[Controls, Hand, list[Any]]]:
    """Controls without a run, a hand on them, and what they asked for."""
    address, asked = Address(0), list[Any]()
    server = serve(address)
    try:
        shown = Controls(server, allowance(), asked.append)
        with hand(address.url(server.get_port())) as page:
            page.find(K)
            yield shown, page, asked
    finally:
        stop(server)


def coupled(**gains: float) -> dict[str, Any]:
    law = allowance().law(replace(COUPLING, **gains))
    return {"event": "coupling", "tick": 1, "by": "caller", "ticks": STEPS, **asdict(law)}


def switched(**bits: bool) -> dict[str, Any]:
    return {"event": "switch", "tick": 1, "by": "caller", "force": True, "clutch": False} | bits


def test_the_page_follows_others_and_what_was_refused_and_asks_for_nothing_again() -> None:
    with controls() as (shown, page, asked):
        page.find(CLUTCH)
        shown.note(coupled(stiffness=1234.567, damping=0.77))
        shown.note(switched(force=False, clutch=True))
        until(lambda: page.shows(K, 1235.0))
        until(lambda: page.shows(B, 0.77))
        until(lambda: page.shows("force", False) and page.shows(CLUTCH, True))
        assert asked == []
        shown.note(switched(force=True))
        page.send(K, value=1800.0)
        page.send("force", value=False)
        until(lambda: len(asked) == 2)
        shown.note({"event": "refused", "reason": "too soon"})
        until(lambda: page.shows(K, 1235.0) and page.shows("force", True))
        # what was on its way all the same is shown, however soon it comes
        shown.note(coupled(stiffness=1800.0))
        until(lambda: page.shows(K, 1800.0))
        shown.note(switched(force=False, fading=True))  # for a moment: its box stays the hand's
        assert "the force is off" in shown.answer.content
        shown.note(switched())
        assert "the force is off" not in shown.answer.content
        page.send(K, value=1235.0)  # moved back it is asked for too
        until(lambda: len(asked) == 3)
        assert page.shows("force", True)
        assert asked[-1].stiffness == 1235.0


def test_a_browser_changes_the_value_of_an_element_and_nothing_else_of_it() -> None:
    with controls() as (shown, page, asked):
        page.send("stop the run", removed=True)
        page.send(K, update_cb=[])
        page.send(K, value=1500.0, update_cb=[])
        page.send(K, props=None)
        page.send(K, value=2000.0)
        page.send("stop the run", value=True)
        until(lambda: Stop() in asked and len(asked) > 1)
        assert [each.stiffness for each in asked if isinstance(each, Couple)] == [2000.0]
        shown.note(coupled(stiffness=1234.567))  # which bounds the sliders, if they are still some
        assert "goes to K = 1235 N/m" in shown.answer.content


def test_paths_and_reasons_are_shown_as_text() -> None:
    with controls() as (shown, _, _asked):
        shown.note({"event": "recording", "path": "![x](/etc/passwd)"})
        shown.note({"event": "refused", "reason": "**`<b>`**"})
        assert shown.answer.content == (
            "recording to ` ![x](/etc/passwd) `  \n**refused:** `` **`<b>`** ``"
        )


def test_commands_reach_the_bridge_slowly_and_the_newest_wins() -> None:
    read, write = os.pipe()
    outlet = Outlet(write)
    for stiffness in range(1, 1000):
        outlet.ask(Couple(float(stiffness), 0.5))
    outlet.ask(Switch(force=False))
    outlet.ask(Switch(clutch=True))
    outlet.ask(Stop())
    thread = threading.Thread(target=outlet.run, daemon=True)
    thread.start()
    with os.fdopen(read, "rb") as stream:
        said = [command_of(stream.readline()) for _ in range(3)]
    assert said == [Stop(), Couple(999.0, 0.5), Switch(force=False, clutch=True)]
    os.close(write)


@pytest.mark.parametrize(("stretch", "why"), [(0.2, "duration"), (1e-6, "stretch limit")])
def test_the_page_keeps_its_last_picture_and_says_why_the_run_ended(
    tmp_path: Path, stretch: float, why: str
) -> None:
    scene, window = tmp_path / "floor.xml", Window(Address(0))
    scene.write_text(FLOOR)
    bridge = Bridge(
        str(scene),
        ScriptedDevice(swaying),
        LOOSE,
        clock=SimulatedClock(),
        observer=window,
        limits=Limits(force=10.0, torque=0.5, stretch=stretch),
    )
    told: list[str] = []
    stack = contextlib.ExitStack()
    with contextlib.suppress(SafetyTrip), bridge:
        page = stack.enter_context(hand(window.url))
        reader = threading.Thread(target=lambda: told.append(said(page, "The run is over")))
        reader.start()
        bridge.run(0.3)
    reader.join()
    with contextlib.suppress(Exception):  # the page is gone
        stack.close()
    assert why in told[0]
    assert "(` " in told[0]  # as text: a reason may name what a foreign scene named
