"""A recorded run on the page, with a slider for its time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import viser

from hapticbridge.audit.recorded_scene import bounds_for
from hapticbridge.confinement import Worker, in_bounds
from hapticbridge.recording import RecordingFile, open_recording
from hapticbridge.replay.stage import MIN_REFERENCE, Stage, is_held
from hapticbridge.run.description import parameters_of
from hapticbridge.view.geometry import Scenery, Tendons, checked
from hapticbridge.view.page import Held, Page, Sight, Trace
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

    Of several hands, the curves are those of the first one.

    The run is simulated in a child process with limits (``confinement``), which hands over poses
    and triangles.

    Args:
        path: The recording.
        progress: Called with the finished and all instants.
        in_process: True simulates in this process, for recordings of a known origin.

    Attributes:
        recording: The recording without its ticks.
        parameters: Parameters of the run.
        scenery: The scene as it is drawn.
        sights: Its instants.
        step: Time in s between two of them.
        trace: Its curves.
        hand_reference: Largest force on the hand in N, as in ``Stage``.
        tool_reference: Largest force on the tool in N, as in ``Stage``.

    Raises:
        RecordingError: The file is no recording, or cannot be simulated again here.
        ForeignSceneError: Its scene crashed MuJoCo, or takes too much memory or time.
    """

    scenery: Scenery

    def __init__(
        self, path: str | Path, progress: Progress | None = None, *, in_process: bool = False
    ) -> None:
        self.recording = recording = open_recording(path, 0)
        self.parameters = parameters_of(recording.meta)
        self.sights: list[Sight] = []
        self.trace = Trace(is_held=is_held(recording.meta))
        self.hand_reference = self.tool_reference = MIN_REFERENCE
        self.step = FRAME
        self._count, self._progress = 1, progress
        in_bounds(
            lambda worker: _played(recording, worker),
            f"the scene of '{path}'",
            trusted=in_process,
            hear=self._add,
            **bounds_for(recording, self.parameters),
        )

    def _add(self, message: Any) -> None:
        """Takes the scenery, which comes first, or an instant."""
        if not isinstance(message, list):
            self.scenery = Scenery.from_parts(message)
            steps = checked([message[name] for name in ("step", "count", "on_hand", "on_tool")], 4)
            self.step, self._count = max(float(steps[0]), FRAME), int(steps[1])
            self.hand_reference, self.tool_reference = map(float, np.maximum(steps[2:], 1e-9))
            return
        instant, point = message
        scenery = self.scenery
        counts = scenery.bodies, len(scenery.widths), len(scenery.tools)
        sight = Sight.from_parts(instant, *counts)
        self.sights.append(sight)
        self.trace.add_point(point)
        if self._progress is not None:
            self._progress(len(self.sights), self._count)

    def sight_at(self, moment: float) -> Sight:
        """Returns the instant nearest to a time in s; the first for a value that is no time."""
        if math.isnan(moment):
            return self.sights[0]
        return self.sights[round(min(max(moment / self.step, 0.0), len(self.sights) - 1.0))]


def _played(recording: RecordingFile, worker: Worker) -> None:
    """Tells the scenery of a run, and each of its instants with a point of the curves."""
    stage = Stage(recording, worker.allow_run)
    step = max(FRAME, stage.duration / MOST)
    count = max(1, int(stage.duration / step) + 1)
    scenery = Scenery.from_model(stage.model, *stage.grips).parts()
    references = {"on_hand": stage.hand_reference, "on_tool": stage.tool_reference}
    worker.tell(scenery | references | {"step": step, "count": count})
    tendons, trace = Tendons(stage.model), Trace(is_held=is_held(stage.recording.meta))
    for number in range(count):
        stage.show(stage.tick_at(min(number * step, stage.duration)))
        trace.add(stage.passed, stage.slack)
        hands = tuple(Held.from_record(*each) for each in stage.hands())
        sight = Sight.from_scene(
            stage.model, stage.data, tendons, stage.contacts(), stage.row, hands
        )
        sight = replace(sight, blow=stage.blow)
        worker.tell([sight.parts(), trace.newest])


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
        last = replay.sights[-1].time
        with self._server.gui.add_folder(None):
            self.slider = self._server.gui.add_slider(
                "time (s)", 0.0, max(last, replay.step), 1e-3, 0.0
            )
            self._playing = self._server.gui.add_checkbox("play", initial_value=False)
        facts = dict(replay.recording.meta)
        self._page = Page(self._server, replay.scenery, replay.parameters, facts)
        self._page.hand_reference = replay.hand_reference
        self._page.tool_reference = replay.tool_reference
        self._page.allow(replay.sights)
        self._page.add_curves()
        if len(replay.trace) > 1:
            self._page.plot(*replay.trace.curves())
        self.show(0.0)
        self.slider.on_update(lambda _: self._follow())

    def show(self, moment: float) -> None:
        """Shows the instant nearest to a time in s."""
        sight = self._replay.sight_at(moment)
        self._page.show(sight)
        self._page.status.content = f"**{sight.time:.3f} s**, {self._page.facts(sight)}"

    def page(self) -> str:
        """Returns a page that plays the run by itself: one document without a server.

        It has the scene, the coupling, the arrows and the blows; curves and other texts need the
        server.
        """
        self.show(0.0)
        film = self._server.get_scene_serializer()
        for sight in self._replay.sights[1:]:
            film.insert_sleep(self._replay.step)
            self.show(sight.time)
        film.insert_sleep(self._replay.step)
        return str(film.as_html())

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
