"""A recorded run on the page, with a slider for its time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path

import viser

from hapticbridge.film_process import Stage, is_held
from hapticbridge.view.geometry import Tendons
from hapticbridge.view.page import Page, Sight, Trace
from hapticbridge.view.server import serve, stop
from hapticbridge.view.window import Address

FRAME = 1 / 30
"""Time in s between two selectable instants, unless there would be more than ``MOST``."""

MOST = 18_000
"""Largest number of instants of a run: ten minutes at 30 a second, some 30 MB. A longer run has
longer steps."""

Progress = Callable[[int, int], None]


class Replay:
    """Every instant of a recorded run, ready to be shown in any order.

    Args:
        path: The recording.
        progress: Called with the finished and all instants.

    Attributes:
        stage: The run, at its end.
        sights: Its instants.
        step: Time in s between two of them.
        trace: Its curves.

    Raises:
        RecordingError: The file is no recording, or cannot be simulated again here.
    """

    def __init__(self, path: str | Path, progress: Progress | None = None) -> None:
        self.stage = stage = Stage(path)
        self.step = max(FRAME, stage.duration / MOST)
        self.sights: list[Sight] = []
        self.trace = Trace(is_held=is_held(stage.recording.meta))
        count = max(1, int(stage.duration / self.step) + 1)
        tendons = Tendons(stage.model)
        for number in range(count):
            stage.show(stage.tick_at(min(number * self.step, stage.duration)))
            self.sights.append(
                Sight.of(
                    stage.model, stage.data, stage.row, tendons, stage.contacts(), stage.hand_force
                )
            )
            self.trace.add(stage.passed, stage.slack)
            if progress is not None:
                progress(number + 1, count)

    def at(self, moment: float) -> Sight:
        """Returns the instant nearest to a time in s; the first for a value that is no time."""
        if math.isnan(moment):
            return self.sights[0]
        return self.sights[round(min(max(moment / self.step, 0.0), len(self.sights) - 1.0))]


class Theatre:
    """Server of a replay.

    Args:
        replay: Replay to show.
        address: Address of the page.

    Attributes:
        url: Address to open in a browser.

    Raises:
        HapticBridgeError: The page cannot be served.
    """

    def __init__(self, replay: Replay, address: Address) -> None:
        self._replay = replay
        # viser calls from any number of threads: an older time must not be drawn last
        self._turn = threading.Lock()
        self._server: viser.ViserServer = serve(address)
        self.url = address.url(self._server.get_port())
        stage = replay.stage
        last = replay.sights[-1].time
        with self._server.gui.add_folder(None):
            self.slider = self._server.gui.add_slider(
                "time (s)", 0.0, max(last, replay.step), 1e-3, 0.0
            )
            self._playing = self._server.gui.add_checkbox("play", initial_value=False)
        self._page = Page(self._server, stage.model, stage.parameters, dict(stage.recording.meta))
        self._page.hand_reference = stage.hand_reference
        self._page.tool_reference = stage.tool_reference
        self._page.allow(replay.sights)
        self._page.add_curves()
        if len(replay.trace) > 1:
            self._page.plot(*replay.trace.curves())
        self.show(0.0)
        self.slider.on_update(lambda _: self._follow())

    def show(self, moment: float) -> None:
        """Shows the instant nearest to a time in s."""
        sight = self._replay.at(moment)
        self._page.show(sight)
        self._page.status.content = f"**{sight.time:.3f} s**, {self._page.forces(sight)}"

    def play(self, is_over: threading.Event) -> None:
        """Moves the slider with the time while playback is on, until the server is closed."""
        before = time.monotonic()
        while not is_over.wait(FRAME):
            now, last = time.monotonic(), self._replay.sights[-1].time
            if self._playing.value:
                following = self.slider.value + now - before
                # setting the value shows the instant, as a user's move does
                self.slider.value = following if 0.0 <= following <= last else 0.0
            before = now

    def _follow(self) -> None:
        with self._turn:
            self.show(self.slider.value)

    def close(self) -> None:
        """Stops serving."""
        stop(self._server)
