"""A page or a visitor that misbehaves changes nothing of a run."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice, recorded
from report_runs import LOOSE
from test_bridge_commands import FLOOR, swaying

from hapticbridge.audit import audit
from hapticbridge.clock import SimulatedClock
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge
from hapticbridge.view.window import Address, Window

pytest.importorskip("viser", reason="needs the extra 'view'")

from page_client import Hand, hand, said

# viser's threads and sockets end with the process
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

TICKS = 1500

Deed = Callable[[Window, contextlib.ExitStack], None]


def _process(window: Window) -> int:
    assert window.process_id is not None
    return window.process_id


def killed(window: Window, _: contextlib.ExitStack) -> None:
    os.kill(_process(window), signal.SIGKILL)


def standing_still(window: Window, _: contextlib.ExitStack) -> None:
    os.kill(_process(window), signal.SIGSTOP)


def watched_by_ten(window: Window, stack: contextlib.ExitStack) -> None:
    """Ten browsers, none of which reads a word: the slowest that there are."""
    for _ in range(10):
        stack.enter_context(hand(window.url))


def flooded(window: Window, stack: contextlib.ExitStack) -> None:
    """A browser that asks for ten thousand impossible things at once."""
    page: Hand = stack.enter_context(hand(window.url))
    for number in range(10_000):
        page.send("stiffness K (N/m)", value=1e6 + number)


def shouted_at(window: Window, stack: contextlib.ExitStack) -> None:
    """A browser that sends more than a message may hold, and noise."""
    page: Hand = stack.enter_context(hand(window.url))
    with contextlib.suppress(Exception):
        page.socket.send(b"\xff" * 100)
        page.socket.send(b"x" * (1 << 20))


def run(folder: Path, name: str, deed: Deed | None) -> tuple[Path, Any, float]:
    scene, path = folder / "floor.xml", folder / f"{name}.mcap"
    scene.write_text(FLOOR)
    window = None if deed is None else Window(Address(0))
    with contextlib.ExitStack() as stack:

        def disturb(tick: int) -> None:
            if deed is not None and window is not None and tick == 300:
                deed(window, stack)
            if tick % 10 == 0 and deed is not None:
                time.sleep(1e-3)  # so that what was done has the time to do harm

        with Bridge(
            str(scene),
            ScriptedDevice(swaying),
            LOOSE,
            recording=path,
            clock=SimulatedClock(),
            observer=window,
        ) as bridge:
            if window is not None:
                window.on_command = partial(bridge.command, by="view")
            summary = bridge.run(TICKS * 1e-3, disturb)
            began = time.monotonic()
    return path, summary, time.monotonic() - began


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return read_recording(run(tmp_path_factory.mktemp("alone"), "alone", None)[0]).ticks


@pytest.mark.parametrize("deed", [killed, standing_still, watched_by_ten, flooded, shouted_at])
def test_a_page_in_trouble_changes_no_number_of_the_run(
    deed: Deed, undisturbed: Any, tmp_path: Path
) -> None:
    path, summary, seconds = run(tmp_path, "seen", deed)
    assert seconds < 30  # one that stands still is killed after 2 s; else it would never end
    assert (summary.ticks, summary.dropped, summary.overruns) == (TICKS, 0, 0)
    disturbed = read_recording(path).ticks
    for name in TICK_DTYPE.names or ():
        np.testing.assert_array_equal(disturbed[name], undisturbed[name])
    report = audit(path)
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_a_page_that_slept_goes_on_with_the_run(tmp_path: Path) -> None:
    scene, path = tmp_path / "floor.xml", tmp_path / "run.mcap"
    scene.write_text(FLOOR)
    window = Window(Address(0))
    told: list[str] = []

    def disturb(_: Bridge, tick: int) -> None:
        if tick == 300:
            time.sleep(0.5)  # it has seen the beginning
            os.kill(_process(window), signal.SIGSTOP)
        if tick == 9000:  # the ring holds 8000
            os.kill(_process(window), signal.SIGCONT)
            with hand(window.url) as page:
                told.append(said(page, "**9."))  # what it shows is of now

    device = ScriptedDevice(swaying)
    summary = recorded(
        path, str(scene), device, LOOSE, duration=9.1, on_tick=disturb, observer=window
    )
    assert (summary.ticks, summary.dropped) == (9100, 0)
    assert told
    assert audit(path).resimulation == "bit for bit"
