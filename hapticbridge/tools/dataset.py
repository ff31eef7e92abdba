"""Recordings as a data set for learning from demonstrations: LeRobot's and robomimic's formats.

Every recording is an episode. It is simulated again, which gives the scene's positions and, if a
camera is named, its pictures. A frame holds

| name                   | content                                                              |
|------------------------|----------------------------------------------------------------------|
| ``observation.state``  | pose of the tool's grip: position in m, quaternion (w, x, y, z)      |
| ``observation.wrench`` | force and torque on the hand, in N and N m, along the scene's axes   |
| ``observation.qpos``   | positions of all joints, as MuJoCo has them                          |
| ``observation.ctrl``   | controls of the scene's own actuators, if there are any              |
| ``observation.sensors``| readings of the scene's own sensors, if there are any                |
| ``action``             | pose of the handle one frame later, and the wrench on the tool then  |

References:
    LeRobotDataset v3.0; robomimic's documentation of its data sets.
"""

from __future__ import annotations

import io
import json
import math
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit.verdict import unusual_end
from hapticbridge.demand.trip import Trip
from hapticbridge.errors import RecordingError, choices
from hapticbridge.files import (
    Hdf5File,
    draft_of,
    import_extra,
    is_unicode,
    printable,
    reason_of,
)
from hapticbridge.kernel.record import force_on_hand
from hapticbridge.recording import RecordingFile, open_recording
from hapticbridge.recording.ros_messages import axes_of
from hapticbridge.replay.film import Shot, states
from hapticbridge.run.description import meta_float, parameters_of
from hapticbridge.tools.export import time_of
from hapticbridge.units import format_number

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")

STATE, ON_HAND, QPOS, CTRL, SENSORS, ACTION = (
    *("observation.state", "observation.wrench", "observation.qpos", "observation.ctrl"),
    *("observation.sensors", "action"),
)

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class Episode:
    """A recording as frames.

    Attributes:
        name: File name of the recording.
        scene: Name of its scene.
        values: Numbers by name, (n, k) float32 each.
        after: Observations one frame after the last, by name, (1, k) float32 each.
        names: Names of the k numbers, by name.
        states: ``qpos`` and ``qvel`` in a row, (n, nq + nv).
        pictures: PNG of each frame, and of the one after the last; none without a camera.
        kinds: Types of the scene's joints, actuators and sensors; numbers of the same name may mean
            something else in a scene of others.
        odd: Names of those readings of sensors that the file alone would not give, by the reason.
        repeats: Number of frames that repeat the one before, because deadlines were skipped.
    """

    name: str
    scene: str
    values: Mapping[str, NDArray[np.float32]]
    after: Mapping[str, NDArray[np.float32]]
    names: Mapping[str, tuple[str, ...]]
    states: NDArray[np.float64]
    pictures: tuple[bytes, ...] = field(repr=False)
    kinds: Sequence[Sequence[int]] = ()
    odd: Mapping[str, list[str]] = field(default_factory=dict)
    repeats: int = 0

    def __len__(self) -> int:
        return len(self.states)


def episode_of(recording: RecordingFile, shot: Shot, progress: Progress | None = None) -> Episode:
    """Simulates a recording again, and returns its frames.

    Args:
        recording: The recording, opened.
        shot: Frames per second, and the camera and size of pictures; none without a camera.
        progress: Called with the finished and all frames, and the recording's name.

    Raises:
        RecordingError: It cannot be simulated again, has fewer than two frames, or fewer states
            than frames.
        HapticBridgeError: Nothing can be drawn here, or the scene has no such camera.
    """
    name = recording.path.name
    tell = None if progress is None else lambda done, total: progress(done, total, name)
    run = parameters_of(recording.meta)
    is_posted = run.credit > 0.0  # the scene is the shown tool alone
    rate = round(1.0 / (run.timestep * run.substeps), 3)  # the period is in whole ns
    if shot.fps > rate:
        raise RecordingError(
            f"'{recording.path}' has {format_number(rate)} states of its scene per second, so that "
            f"some of {shot.fps} frames would repeat; choose --fps {math.floor(rate)} or fewer"
        )
    found = states(recording.path, shot, tell)
    if is_posted:  # the loop ran before its program showed a tool
        begin = int(np.searchsorted(found["rows"]["tick"], _placed_at(recording), side="right"))
        for key in ("rows", "qpos", "qvel", "ctrl", "sensors", "pictures"):
            found[key] = found[key][begin:]
    rows, count = found["rows"], len(found["rows"]) - 1
    if count < 1:
        raise RecordingError(f"'{recording.path}' is shorter than two frames at {shot.fps} Hz")
    axes = axes_of(recording.meta)
    torque = found["rows"]["wrench_on_device"][:, 3:] @ axes.T
    observed = {
        STATE: np.concatenate([rows["tool_position"], continued(rows["tool_quaternion"])], axis=1),
        ON_HAND: np.concatenate([force_on_hand(rows, axes), torque], axis=1),
        QPOS: found["qpos"],
        CTRL: found["ctrl"],
        SENSORS: found["sensors"],
    }
    turned = continued(rows["handle_quaternion"])
    action = np.concatenate([rows["handle_position"], turned, rows["wrench_on_tool"]], axis=1)[1:]
    names = {
        STATE: POSE,
        ON_HAND: WRENCH,
        QPOS: tuple(found["names"]),
        CTRL: tuple(found["controls"]),
        SENSORS: tuple(found["sensor_names"]),
        ACTION: (*POSE, *WRENCH),
    }
    left_out = [column for column in (CTRL, SENSORS) if not names[column]]
    if is_posted:
        left_out.append(QPOS)
    for column in left_out:
        del observed[column], names[column]
    observed = {key: value.astype(np.float32) for key, value in observed.items()}
    return Episode(
        name=name,
        scene=recording.meta.get("scene", ""),
        values={key: value[:-1] for key, value in observed.items()}
        | {ACTION: action.astype(np.float32)},
        after={key: value[-1:] for key, value in observed.items()},
        names=names,
        states=np.concatenate([found["qpos"], found["qvel"]], axis=1)[:-1],
        pictures=tuple(found["pictures"]),
        kinds=found["kinds"],
        odd=found["odd_readings"],
        repeats=int(np.sum(np.diff(rows["tick"][:-1]) == 0)),
    )


def continued(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the same rotations, each with the sign of q or −q that is nearer to the last one.

    The sign of a recording's jumps at half a turn, which a learner would take for a motion.

    Args:
        quaternions: Unit quaternions (w, x, y, z), (n, 4).
    """
    is_turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    signs = np.cumprod(np.where(is_turned, -1.0, 1.0))
    return np.concatenate([quaternions[:1], signs[:, None] * quaternions[1:]])


class Writer(Protocol):
    """A data set being written into a folder."""

    def __init__(self, folder: Path, shot: Shot, task: str) -> None: ...

    def add(self, episode: Episode) -> None:
        """Appends an episode."""

    def finish(self) -> None:
        """Writes what is of the whole set, after its last episode."""

    def close(self) -> None:
        """Closes open files, also of a set that is not finished."""


# LeRobot

_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_COUNTERS = ("frame_index", "episode_index", "index", "task_index")
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_FILES_PER_CHUNK = 1000

Stats = dict[str, dict[str, Any]]


class LeRobotWriter:
    """Writer of a LeRobotDataset v3.0: a Parquet file per episode, pictures as PNG in it.

    Raises:
        RecordingError: pyarrow or pandas is not installed.
    """

    def __init__(self, folder: Path, shot: Shot, task: str) -> None:
        self._arrow = import_extra("pyarrow", "a LeRobot data set", "tables", RecordingError)
        self._parquet = import_extra(
            "pyarrow.parquet", "a LeRobot data set", "tables", RecordingError
        )
        self._pandas = import_extra("pandas", "a LeRobot data set", "tables", RecordingError)
        self._folder, self._shot, self._task = folder, shot, task
        self._episodes: list[dict[str, Any]] = []
        self._features: dict[str, Any] = {}
        self._frames = 0
        self._numbers: dict[str, list[NDArray[Any]]] = {}
        self._colours: dict[str, NDArray[np.int64]] = {}

    def add(self, episode: Episode) -> None:
        """Implements ``Writer.add``."""
        arrow, count, number = self._arrow, len(episode), len(self._episodes)
        index = np.arange(count)
        numbers: dict[str, NDArray[Any]] = dict(episode.values)
        numbers["timestamp"] = (index / self._shot.fps).astype(np.float32)
        counters = index, index * 0 + number, self._frames + index, index * 0
        numbers |= dict(zip(_COUNTERS, counters, strict=True))
        columns: dict[str, Any] = {}
        for name, values in numbers.items():
            columns[name] = arrow.array(values.ravel())
            if values.ndim > 1:
                size = values.shape[1]
                columns[name] = arrow.FixedSizeListArray.from_arrays(columns[name], size)
            self._numbers.setdefault(name, []).append(values)
        if own := episode.pictures[:count]:
            key = f"observation.images.{_label(self._shot)}"
            pictures = [
                {"bytes": data, "path": f"frame-{frame:06d}.png"} for frame, data in enumerate(own)
            ]
            kind = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
            columns[key] = arrow.array(pictures, kind)
        self._features = self._features or self._describe(episode)
        chunk, file = divmod(number, _FILES_PER_CHUNK)
        self._write(_DATA.format(chunk_index=chunk, file_index=file), columns)
        stats = {name: _statistics(values, count) for name, values in numbers.items()}
        if own:
            colours = _colours(own)
            stats[key] = _statistics_of_pictures(colours, count)
            self._colours[key] = self._colours.get(key, 0) + colours
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [self._task],
                "length": count,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + count,
                **{
                    f"stats/{name}/{kind}": value
                    for name, found in stats.items()
                    for kind, value in found.items()
                },
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self._frames += count

    def close(self) -> None:
        """Implements ``Writer.close``: none is open."""

    def finish(self) -> None:
        """Implements ``Writer.finish``."""
        episodes = {name: [each[name] for each in self._episodes] for name in self._episodes[0]}
        self._write(
            _EPISODES.format(chunk_index=0, file_index=0),
            {name: self._arrow.array(values) for name, values in episodes.items()},
        )
        # opened here and below: pyarrow takes names in UTF-8 alone
        with (self._folder / "meta" / "tasks.parquet").open("wb") as file:
            self._pandas.DataFrame({"task_index": [0]}, index=[self._task]).to_parquet(file)
        stats: Stats = {}
        for name, parts in self._numbers.items():
            stats[name] = _statistics(np.concatenate(parts), self._frames)
        for name, counts in self._colours.items():
            stats[name] = _statistics_of_pictures(counts, self._frames)
        info = {
            "codebase_version": "v3.0",
            "robot_type": "hapticbridge",
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": 1,
            "chunks_size": _FILES_PER_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._shot.fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": _DATA,
            "video_path": None,
            "features": self._features,
        }
        for name, facts in (("info", info), ("stats", stats)):
            text = json.dumps(facts, indent=4)
            (self._folder / "meta" / f"{name}.json").write_text(text, encoding="utf-8")

    def _describe(self, episode: Episode) -> dict[str, Any]:
        features: dict[str, Any] = {
            name: {"dtype": "float32", "shape": [len(names)], "names": list(names)}
            for name, names in episode.names.items()
        }
        if episode.pictures:
            shape = [self._shot.height, self._shot.width, 3]
            features[f"observation.images.{_label(self._shot)}"] = {
                "dtype": "image",
                "shape": shape,
                "names": ["height", "width", "channels"],
            }
        features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        for name in _COUNTERS:
            features[name] = {"dtype": "int64", "shape": [1], "names": None}
        return features

    def _write(self, name: str, columns: Mapping[str, Any]) -> None:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            self._parquet.write_table(self._arrow.table(dict(columns)), file)


def _label(shot: Shot) -> str:
    """Returns the camera's name without '/'.

    LeRobot refuses a feature with it, and robomimic would meet a group of HDF5 in place of numbers.
    """
    return str(shot.camera).replace("/", "_")


def _statistics(values: NDArray[Any], count: int) -> dict[str, Any]:
    """Returns LeRobot's statistics of numbers, (n,) or (n, k), over the first axis."""
    values = values.astype(np.float64).reshape(len(values), -1)
    statistics = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0)}
    statistics["std"] = values.std(0)
    statistics |= {name: np.quantile(values, share, axis=0) for name, share in _QUANTILES.items()}
    return {name: value.tolist() for name, value in statistics.items()} | {"count": [count]}


def _colours(pictures: Sequence[bytes]) -> NDArray[np.int64]:
    """Returns how many pixels of pictures have each value of each colour, (256, 3)."""
    from PIL import Image  # noqa: PLC0415 - for pictures alone

    counts = np.zeros((256, 3), np.int64)
    for data in pictures:
        pixels = np.asarray(Image.open(io.BytesIO(data)))
        for colour in range(3):
            counts[:, colour] += np.bincount(pixels[..., colour].ravel(), minlength=256)
    return counts


def _statistics_of_pictures(counts: NDArray[np.int64], frames: int) -> dict[str, Any]:
    """Returns LeRobot's statistics of pixels from 0 to 1, (3, 1, 1), from their ``_colours``."""
    values, until, total = np.arange(256) / 255.0, counts.cumsum(0), int(counts[:, 0].sum())

    def ranked(rank: int) -> NDArray[np.float64]:
        return np.asarray(values[(until <= rank).sum(0)])

    mean = values @ counts / total
    found = {"min": ranked(0), "max": ranked(total - 1), "mean": mean}
    found["std"] = np.sqrt(np.sum((values[:, None] - mean) ** 2 * counts, axis=0) / total)
    for name, share in _QUANTILES.items():
        part, whole = math.modf(share * (total - 1))
        low, high = ranked(int(whole)), ranked(math.ceil(share * (total - 1)))
        found[name] = low + part * (high - low)
    return {name: value[:, None, None].tolist() for name, value in found.items()} | {
        "count": [frames]
    }


# robomimic

ROBOMIMIC_FILE = "demos.hdf5"
_OBSERVATIONS = {
    STATE: "tool_pose",
    ON_HAND: "hand_wrench",
    QPOS: "qpos",
    CTRL: "ctrl",
    SENSORS: "sensors",
}
_ACTIONS = {
    "handle_position": slice(0, 3),
    "handle_quaternion": slice(3, 7),
    "wrench": slice(7, 13),
}
"""Parts of an action, which ``action_dict`` holds in SI units."""


STILL = 1e-6
"""Half a range of an action in m, N or N m below which it is rounding, and no motion to learn."""


class RobomimicWriter:
    """Writer of a robomimic data set: ``demos.hdf5`` with a group ``data/demo_K`` per episode.

    ``actions`` are from −1 to 1, as robomimic's policies give them: each number a of the whole set
    is (a − offset)/scale with offset = (max + min)/2 and scale = (max − min)/2, or 1 where that is
    below ``STILL``. ``data`` has the attributes ``action_scale``, ``action_offset`` and
    ``action_names``; ``action_dict`` of each episode holds the numbers themselves.

    Raises:
        RecordingError: h5py is not installed.
    """

    def __init__(self, folder: Path, shot: Shot, task: str) -> None:
        self._file = Hdf5File(folder / ROBOMIMIC_FILE, "a robomimic data set", RecordingError)
        self._data, self._shot = self._file.root.create_group("data"), shot
        self._data.attrs["task"] = task
        self._actions: list[NDArray[np.float32]] = []
        self._total, self._scenes = 0, dict[str, None]()

    def add(self, episode: Episode) -> None:
        """Implements ``Writer.add``."""
        count = len(episode)
        demo = self._data.create_group(f"demo_{len(self._actions)}")
        demo.attrs["num_samples"], demo.attrs["recording"] = count, printable(episode.name)
        demo["states"] = episode.states
        for name, part in _ACTIONS.items():
            demo[f"action_dict/{name}"] = episode.values[ACTION][:, part]
        done = np.zeros(count)
        done[-1] = 1.0
        demo["rewards"], demo["dones"] = np.zeros(count), done.astype(np.int64)
        observed: dict[str, NDArray[Any]] = {
            short: np.concatenate([episode.values[name], episode.after[name]])
            for name, short in _OBSERVATIONS.items()
            if name in episode.values
        }
        if episode.pictures:
            observed[f"{_label(self._shot)}_image"] = _frames(episode.pictures)
        for name, values in observed.items():
            demo[f"obs/{name}"], demo[f"next_obs/{name}"] = values[:-1], values[1:]
        demo.attrs["scene"] = printable(episode.scene)
        self._scenes[episode.scene] = None
        self._actions.append(episode.values[ACTION])
        self._total += count
        self._file.check()

    def close(self) -> None:
        """Implements ``Writer.close``."""
        self._file.close()

    def finish(self) -> None:
        """Implements ``Writer.finish``."""
        low = np.min([actions.min(axis=0) for actions in self._actions], axis=0)
        high = np.max([actions.max(axis=0) for actions in self._actions], axis=0)
        offset = (0.5 * (low + high)).astype(np.float32)
        half = 0.5 * (high - low)
        scale = np.where(half >= STILL, half, 1.0).astype(np.float32)
        for number, actions in enumerate(self._actions):
            # rounding may lead a number out by 1e-7
            normalised = np.clip((actions - offset) / scale, -1.0, 1.0)
            self._data[f"demo_{number}/actions"] = normalised
        # robomimic reads one environment for all episodes
        name, rate = ", ".join(self._scenes), {"fps": self._shot.fps}
        about = {"env_name": name, "type": 2, "env_kwargs": rate}
        self._data.attrs["env_args"] = json.dumps(about)
        self._data.attrs["action_offset"], self._data.attrs["action_scale"] = offset, scale
        self._data.attrs["action_names"] = [*POSE, *WRENCH]
        self._data.attrs["total"] = self._total
        demos = [f"demo_{number}".encode() for number in range(len(self._actions))]
        self._file.root["mask/train"] = demos


def _frames(pictures: Sequence[bytes]) -> NDArray[np.uint8]:
    """Returns pictures as numbers, (n, height, width, 3)."""
    from PIL import Image  # noqa: PLC0415 - for pictures alone

    return np.stack([np.asarray(Image.open(io.BytesIO(data))) for data in pictures])


DATASETS: dict[str, type[Writer]] = {"lerobot": LeRobotWriter, "robomimic": RobomimicWriter}
"""Writer of each format."""


@dataclass(frozen=True, slots=True)
class WrittenDataset:
    """Result of ``write_dataset``.

    Attributes:
        folder: The data set.
        episodes: Number of frames of each episode.
        resets: Times in s within each episode at which the scene was reset, so that it jumps.
        ends: What ended each episode's run, as a clause; empty for an ordinary end.
        repeats: Number of frames of each episode that repeat the one before.
        odd: Names of those readings of sensors that the file alone would not give, by the reason.
    """

    folder: Path
    episodes: tuple[int, ...]
    resets: tuple[tuple[float, ...], ...]
    ends: tuple[str, ...]
    repeats: tuple[int, ...]
    odd: dict[str, list[str]]


def write_dataset(
    paths: Sequence[str | Path],
    form: str,
    folder: str | Path,
    shot: Shot | None = None,
    *,
    task: str | None = None,
    progress: Progress | None = None,
) -> WrittenDataset:
    """Writes recordings of one scene as a data set, an episode each.

    If writing fails, no partial data set remains.

    Args:
        paths: The recordings.
        form: One of ``DATASETS``.
        folder: Folder to write; it must not exist.
        shot: Frames per second, and the camera and size of pictures; 30 and none by default.
        task: What was done, in words; None takes the scene's name, if there is one scene.
        progress: Called with the finished and all frames, and the recording's name.

    Raises:
        RecordingError: The task is no Unicode text, there is no recording, one is named twice,
            damaged, cut, of another scene or grip than the first or cannot be simulated again, or
            has fewer states of its scene than frames; scenes of several names have no task; the
            format is unknown, or the folder exists or cannot be written.
        HapticBridgeError: Nothing can be drawn here, or the scene has no such camera.
    """
    if form not in DATASETS:
        raise RecordingError(f"format {form!r:.60} is unknown; the formats are {choices(DATASETS)}")
    if not paths:
        raise RecordingError("a data set needs a recording at least")
    if len(files := Counter(Path(path).resolve() for path in paths)) < len(paths):
        twice, _ = files.most_common(1)[0]
        raise RecordingError(f"'{twice.name}' is named more than once; each is one episode")
    if task is not None and not is_unicode(task):
        raise RecordingError(f"the task {task!r:.60} is not in UTF-8")
    shot, folder = shot or Shot(), Path(folder)
    if folder.exists():
        raise RecordingError(f"'{folder}' exists; choose another folder")
    recordings = [_sound(open_recording(path)) for path in paths]
    scenes = dict.fromkeys(each.meta.get("scene", "") for each in recordings)
    if task is None and len(scenes) > 1:
        raise RecordingError(
            f"the recordings are of the scenes {choices(scenes)}, and one's name is no task for "
            "all; say with --task what was done"
        )
    grips = dict.fromkeys(each.meta.get("grip", "") for each in recordings)
    if len(grips) > 1:
        raise RecordingError(
            f"the recordings are of the grips {choices(grips)}; the poses of a data set are of one "
            "grip, so write a set for each"
        )
    draft, counts, repeats, odd = draft_of(folder), [], [], dict[str, list[str]]()
    try:
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir()
        writer = DATASETS[form](draft, shot, next(iter(scenes)) if task is None else task)
        with closing(writer):
            for episode in _episodes(recordings, shot, progress):
                writer.add(episode)
                counts.append(len(episode))
                repeats.append(episode.repeats)
                for why, names in episode.odd.items():
                    odd[why] = list(dict.fromkeys([*odd.get(why, []), *names]))
            writer.finish()
        draft.rename(folder)
    except OSError as error:
        raise RecordingError(f"cannot write '{folder}': {reason_of(error, folder)}") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    ends = (unusual_end(Trip.among(each.events), each.events) for each in recordings)
    resets = tuple(map(_resets, recordings))
    return WrittenDataset(folder, tuple(counts), resets, tuple(ends), tuple(repeats), odd)


def _placings(recording: RecordingFile) -> list[Mapping[str, Any]]:
    """Returns the resets of a run, and of another program's tool where it was placed anew."""
    return [event for event in recording.events if event.get("event") == "reset"]


def _placed_at(recording: RecordingFile) -> int:
    """Returns the tick at which another program first showed its tool; 0 if it never did."""
    return int(next(iter(_placings(recording)), {}).get("tick", 0))


def _resets(recording: RecordingFile) -> tuple[float, ...]:
    """Returns the times in s at which an episode jumps; the first placing only begins it."""
    is_posted = meta_float(recording.meta, "credit") > 0.0
    return tuple(map(time_of, _placings(recording)[is_posted:]))


def _sound(recording: RecordingFile) -> RecordingFile:
    """Returns a recording if it is whole and undamaged; what is learned from must be true."""
    if recording.faults:
        raise RecordingError(f"'{recording.path}' cannot be learned from: {recording.faults}")
    return recording


def _episodes(
    recordings: Sequence[RecordingFile], shot: Shot, progress: Progress | None
) -> Iterator[Episode]:
    first: Episode | None = None
    for recording in recordings:
        episode = episode_of(recording, shot, progress)
        first = first or episode
        if (episode.names, episode.kinds) != (first.names, first.kinds):
            raise RecordingError(
                f"'{recording.path}' has other joints, actuators or sensors than '{first.name}'; "
                "the episodes of a data set are of one scene"
            )
        yield episode
