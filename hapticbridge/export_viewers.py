"""Recordings for the viewers rerun and Foxglove, each with an arrangement of its panels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.files import import_extra
from hapticbridge.record import due_times, force_on_hand
from hapticbridge.recording import RecordingFile
from hapticbridge.recording.ros_messages import HANDLE, TOOL, axes_of

ENERGIES = ("kinetic", "potential", "coupling_work", "environment_energy", "device_energy")
"""Energies that are shown over time, in J."""

ARROW = 0.02
"""Length of a force's arrow in m per N."""

AXIS = 0.01
"""Length of the axes of a pose in m."""

PATH_EVERY = 16
"""Ticks between two points of the tool's path."""

_PATH = (128, 128, 128)
_FORCES = {"on_hand": (230, 97, 0), "on_tool": (26, 95, 180)}
_CLOCK = "time"


class RerunSink:
    """Writer of a recording for rerun (``.rrd``), with its blueprint.

    Poses and forces are under ``scene``, numbers over time under ``force`` and ``energy``, events
    under ``events``. The timeline ``time`` is that of the run, in s.

    Raises:
        RecordingError: rerun is not installed.
    """

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        self._rerun = import_extra("rerun", "a file for rerun", "rerun", RecordingError)
        self._path: list[NDArray[np.float64]] = []
        self._period, self._axes = recording.period, axes_of(recording.meta)
        name = f"hapticbridge: {recording.meta.get('scene', '')}"
        self._stream = self._rerun.RecordingStream(name)
        self._stream.save(path, default_blueprint=self._blueprint())
        log = self._stream.log
        for frame in (HANDLE, TOOL):
            log(f"scene/{frame}", self._rerun.TransformAxes3D(AXIS), static=True)
        log("scene", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, names in (("force/on_hand", "xyz"), ("force/on_tool", "xyz")):
            log(name, self._rerun.SeriesLines(names=list(names)), static=True)
        for energy in ENERGIES:
            log(f"energy/{energy}", self._rerun.SeriesLines(names=energy), static=True)
        for event in recording.events:
            time = event.get("time_ns")
            self._stream.set_time(_CLOCK, duration=1e-9 * time if isinstance(time, int) else 0.0)
            log("events", self._rerun.TextLog(json.dumps(event)))

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``."""
        rr, send = self._rerun, self._stream.send_columns
        self._path.append(ticks["tool_position"][::PATH_EVERY])
        clock = [rr.TimeColumn(_CLOCK, duration=due_times(ticks, self._period))]
        forces = {
            "on_hand": (HANDLE, force_on_hand(ticks, self._axes)),
            "on_tool": (TOOL, ticks["wrench_on_tool"][:, :3]),
        }
        for frame in (HANDLE, TOOL):
            quaternion = np.roll(ticks[f"{frame}_quaternion"], -1, axis=1)
            poses = rr.Transform3D.columns(
                translation=ticks[f"{frame}_position"], quaternion=quaternion
            )
            send(f"scene/{frame}", clock, poses)
        for name, (frame, force) in forces.items():
            arrows = rr.Arrows3D.columns(
                vectors=ARROW * force,
                origins=ticks[f"{frame}_position"],
                colors=np.tile(np.array(_FORCES[name], np.uint8), (len(ticks), 1)),
            )
            send(f"scene/force_{name}", clock, arrows)
            send(f"force/{name}", clock, rr.Scalars.columns(scalars=np.ascontiguousarray(force)))
        for energy in ENERGIES:
            column = rr.Scalars.columns(scalars=np.ascontiguousarray(ticks[energy]))
            send(f"energy/{energy}", clock, column)

    def close(self) -> None:
        """Implements ``Sink.close``."""
        if self._path:
            path = self._rerun.LineStrips3D([np.concatenate(self._path)], colors=[_PATH])
            self._stream.log("scene/path", path, static=True)
        self._stream.flush()
        self._stream.disconnect()

    def _blueprint(self) -> Any:
        views = import_extra("rerun.blueprint", "a file for rerun", "rerun", RecordingError)
        return views.Blueprint(
            views.Horizontal(
                views.Spatial3DView(origin="scene", name="handle, tool and forces"),
                views.Vertical(
                    views.TimeSeriesView(origin="force", name="force (N)"),
                    views.TimeSeriesView(origin="energy", name="energy (J)"),
                    views.TextLogView(origin="events", name="events"),
                ),
            ),
            views.TimePanel(timeline=_CLOCK, expanded=False),
            collapse_panels=True,
        )


class FoxgloveSink:
    """Writer of a layout for Foxglove (``.json``), to be imported beside the recording itself."""

    def __init__(self, path: Path, recording: RecordingFile) -> None:
        forces = [f"/wrench_on_hand.wrench.force.{axis}" for axis in "xyz"]
        energies = [f"/tick.{energy}" for energy in ENERGIES]
        panels = {
            "3D!scene": {
                "followTf": "world",
                "topics": {
                    topic: {"visible": True}
                    for topic in ("/handle_pose", "/tool_pose", "/wrench_on_hand")
                },
            },
            "Plot!force": _plot("force on the hand (N)", forces),
            "Plot!energy": _plot("energy (J)", energies),
            "RosOut!events": {"topicToRender": "/rosout", "minLogLevel": 1, "searchTerms": []},
        }
        right = {"first": "Plot!energy", "second": "RosOut!events", "direction": "column"}
        layout = {
            "configById": panels,
            "globalVariables": {},
            "userNodes": {},
            "playbackConfig": {"speed": 1.0},
            "layout": {
                "first": "3D!scene",
                "second": {"first": "Plot!force", "second": right, "direction": "column"},
                "direction": "row",
            },
        }
        path.write_text(json.dumps(layout, indent=1) + "\n", encoding="utf-8")

    def add(self, ticks: NDArray[np.void]) -> None:
        """Implements ``Sink.add``: the ticks stay in the recording."""

    def close(self) -> None:
        """Implements ``Sink.close``."""


def _plot(title: str, paths: list[str]) -> dict[str, object]:
    series = [
        {
            "value": path,
            "label": path.rpartition(".")[2],
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for path in paths
    ]
    return {"title": title, "paths": series, "showLegend": True, "xAxisVal": "timestamp"}
