"""ROS 2 messages of a recording: poses, wrenches and events for other programs.

| topic              | type                            | content                                   |
|--------------------|---------------------------------|-------------------------------------------|
| ``/tf``            | ``tf2_msgs/msg/TFMessage``      | ``handle`` and ``tool`` in ``world``      |
| ``/handle_pose``   | ``geometry_msgs/msg/PoseStamped`` | the device's handle in ``world``        |
| ``/tool_pose``     | ``geometry_msgs/msg/PoseStamped`` | the grip on the tool in ``world``       |
| ``/wrench_on_hand``| ``geometry_msgs/msg/WrenchStamped`` | what the hand feels, in ``handle``    |
| ``/wrench_on_tool``| ``geometry_msgs/msg/WrenchStamped`` | the coupling's wrench, in ``tool``    |
| ``/rosout``        | ``rcl_interfaces/msg/Log``      | each event as a line of text              |

They follow from ticks, events and metadata, which alone count: ``Checksums`` compares. Poses and
wrenches are those of the first tick of each 60th of a second. They are written as CDR (OMG DDS
X-Types, little-endian XCDR1): a number stands at a multiple of its size, a text is its length with
the final zero, then its bytes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hapticbridge.files import read_json
from hapticbridge.recording.format import CDR_HEADER

RATE = 60
"""Messages per second on each topic, for 1 kHz: one in 16 or 17 ticks. What is looked at needs no
more, and the file grows by a tenth."""

LAST_STAMP = 2**31 * 10**9 - 1
"""Last Unix time in ns that fits the 32 bits of a stamp's seconds, in January 2038. Later messages
keep it, so that none seems to be of 1901 or 1970; their log time in MCAP goes on."""

WORLD, HANDLE, TOOL = "world", "handle", "tool"
"""Names of the frames."""

_TIME = "int32 sec      # s, Unix time\nuint32 nanosec # ns\n"
_HEADER = "builtin_interfaces/Time stamp # when the tick was due\nstring frame_id\n"
_VECTOR = "float64 x\nfloat64 y\nfloat64 z\n"
_QUATERNION = "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"


def _definition(own: str, **parts: str) -> bytes:
    texts = [own]
    for name, text in parts.items():
        texts.append(f"{'=' * 80}\nMSG: {name.replace('__', '/')}\n{text}")
    return "".join(texts).encode()


_STAMPED = {"std_msgs__Header": _HEADER, "builtin_interfaces__Time": _TIME}
_TF = _definition(
    "geometry_msgs/TransformStamped[] transforms\n",
    geometry_msgs__TransformStamped=(
        "std_msgs/Header header # frame_id: the parent\n"
        "string child_frame_id\n"
        "geometry_msgs/Transform transform\n"
    ),
    geometry_msgs__Transform=(
        "geometry_msgs/Vector3 translation # m\ngeometry_msgs/Quaternion rotation # unit\n"
    ),
    geometry_msgs__Vector3=_VECTOR,
    geometry_msgs__Quaternion=_QUATERNION,
    **_STAMPED,
)
_POSE = _definition(
    "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    geometry_msgs__Pose=(
        "geometry_msgs/Point position # m\ngeometry_msgs/Quaternion orientation # unit\n"
    ),
    geometry_msgs__Point=_VECTOR,
    geometry_msgs__Quaternion=_QUATERNION,
    **_STAMPED,
)
_WRENCH = _definition(
    "std_msgs/Header header # the wrench acts at this frame's origin, along its axes\n"
    "geometry_msgs/Wrench wrench\n",
    geometry_msgs__Wrench=("geometry_msgs/Vector3 force # N\ngeometry_msgs/Vector3 torque # N m\n"),
    geometry_msgs__Vector3=_VECTOR,
    **_STAMPED,
)
_LOG = _definition(
    "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
    "builtin_interfaces/Time stamp\n"
    "uint8 level\n"
    "string name # of the program\n"
    "string msg # the event and what belongs to it, as JSON\n"
    "string file\nstring function\nuint32 line\n",
    builtin_interfaces__Time=_TIME,
)

TF, LOG = "/tf", "/rosout"
TOPICS: dict[str, tuple[str, bytes]] = {
    TF: ("tf2_msgs/msg/TFMessage", _TF),
    "/handle_pose": ("geometry_msgs/msg/PoseStamped", _POSE),
    "/tool_pose": ("geometry_msgs/msg/PoseStamped", _POSE),
    "/wrench_on_hand": ("geometry_msgs/msg/WrenchStamped", _WRENCH),
    "/wrench_on_tool": ("geometry_msgs/msg/WrenchStamped", _WRENCH),
    LOG: ("rcl_interfaces/msg/Log", _LOG),
}
"""Type and message definition by topic."""


class _Cdr:
    """Builder of a message of constant length: texts as they are, numbers to be filled in."""

    def __init__(self) -> None:
        self._data = bytearray(CDR_HEADER)
        self._fields: dict[str, tuple[object, int]] = {}

    def text(self, value: str) -> _Cdr:
        data = value.encode() + b"\0"
        self._align(4)
        self._data += len(data).to_bytes(4, "little") + data
        return self

    def count(self, value: int) -> _Cdr:
        self._align(4)
        self._data += value.to_bytes(4, "little")
        return self

    def numbers(self, name: str, kind: str, count: int) -> _Cdr:
        field = np.dtype((kind, (count,)))
        self._align(field.base.itemsize)
        self._fields[name] = field, len(self._data)
        self._data += bytes(field.itemsize)
        return self

    def header(self, frame: str, name: str = "stamp") -> _Cdr:
        return self.numbers(name, "<u4", 2).text(frame)

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - len(CDR_HEADER)) % size)

    def template(self) -> NDArray[np.void]:
        """Returns one message, shape (1,), with the numbers still zero."""
        names, places = list(self._fields), list(self._fields.values())
        layout = np.dtype(
            {
                "names": names,
                "formats": [kind for kind, _ in places],
                "offsets": [offset for _, offset in places],
                "itemsize": len(self._data),
            }
        )
        return np.frombuffer(self._data, layout)


def _pose() -> NDArray[np.void]:
    return _Cdr().header(WORLD).numbers("pose", "<f8", 7).template()


def _wrench(frame: str) -> NDArray[np.void]:
    return _Cdr().header(frame).numbers("wrench", "<f8", 6).template()


def _frames() -> NDArray[np.void]:
    message = _Cdr().count(2)
    for frame in (HANDLE, TOOL):
        message.header(WORLD, f"{frame}_stamp").text(frame).numbers(frame, "<f8", 7)
    return message.template()


_TEMPLATES = {
    TF: _frames(),
    "/handle_pose": _pose(),
    "/tool_pose": _pose(),
    "/wrench_on_hand": _wrench(HANDLE),
    "/wrench_on_tool": _wrench(TOOL),
}


def axes_of(meta: Mapping[str, str]) -> NDArray[np.float64]:
    """Returns the rotation from the device's frame to the scene's, (3, 3), as the metadata say.

    Without readable metadata it is the identity.
    """
    try:
        axes = np.array(read_json(meta.get("axes", "")), dtype=np.float64).reshape(3, 3)
    except (ValueError, TypeError, OverflowError):
        return np.eye(3)
    return axes if np.isfinite(axes).all() else np.eye(3)


class Messages:
    """Derives the messages of a run from its ticks and events, in order.

    The same ticks give the same bytes on every machine and in batches of any size: all arithmetic
    is by element.

    Args:
        epoch: Unix time of the run's start in ns.
        axes: Rotation from the device's frame to the scene's, (3, 3).
    """

    def __init__(self, epoch: int, axes: NDArray[np.float64]) -> None:
        self._epoch, self._axes = epoch % 2**64, axes
        self._frame = -1

    def of_ticks(self, rows: NDArray[np.void]) -> dict[str, NDArray[np.void]]:
        """Returns the messages that belong to the next ticks, by topic.

        Args:
            rows: The ticks, (n,), ``TICK_DTYPE``.

        Returns:
            By topic, (m,): ``time`` (log time in ns, as MCAP holds it) and ``payload`` (CDR). It is
            empty for m = 0.
        """
        frames = rows["deadline_ns"] * RATE // 1_000_000_000
        is_first = frames != np.concatenate([[self._frame], frames[:-1]])
        if not is_first.any():
            return {}
        self._frame = int(frames[-1])
        rows = rows[is_first]
        times = rows["deadline_ns"].astype(np.uint64) + np.uint64(self._epoch)
        filled = {topic: np.repeat(template, rows.size) for topic, template in _TEMPLATES.items()}
        stamps = np.stack(np.divmod(np.minimum(times, LAST_STAMP), 10**9), axis=1)
        for frame in (HANDLE, TOOL):
            pose = _ros_pose(rows, frame)
            filled[TF][f"{frame}_stamp"] = stamps
            filled[TF][frame] = filled[f"/{frame}_pose"]["pose"] = pose
        with np.errstate(all="ignore"):  # a damaged file may hold any number
            on_hand = _by_axes(self._axes, rows["wrench_on_device"])
            filled["/wrench_on_hand"]["wrench"] = _turned(on_hand, rows["handle_quaternion"])
            filled["/wrench_on_tool"]["wrench"] = _turned(
                rows["wrench_on_tool"], rows["tool_quaternion"]
            )
        wholes = {}
        for topic, messages in filled.items():
            if topic != TF:
                messages["stamp"] = stamps
            whole = np.empty(rows.size, [("time", "<u8"), ("payload", f"V{messages.itemsize}")])
            whole["time"], whole["payload"] = times, messages.view(whole["payload"].dtype)
            wholes[topic] = whole
        return wholes

    def of_event(self, payload: bytes, time_ns: int, name: object) -> tuple[int, bytes]:
        """Returns log time in ns and line of the log, as CDR, for an event.

        Args:
            payload: The event's JSON.
            time_ns: Its time since the start of the run.
            name: Its name, which decides the level.
        """
        time = (self._epoch + time_ns) % 2**64
        line = _Cdr().numbers("stamp", "<u4", 2).numbers("level", "u1", 1)
        line.text(PROGRAM).text(payload.decode(errors="replace")).text("").text("").count(0)
        message = line.template()
        message["stamp"] = divmod(min(time, LAST_STAMP), 10**9)
        message["level"] = ERROR if name in FAULTS else INFO
        return time, message.tobytes()


PROGRAM = "hapticbridge"
INFO, ERROR = 20, 40
FAULTS = ("trip", "bridge_died", "recorder_died")
"""Events with the level ``ERROR`` in the log."""


def _ros_pose(rows: NDArray[np.void], frame: str) -> NDArray[np.float64]:
    """Returns position in m and quaternion (x, y, z, w) of a frame, (n, 7)."""
    vector_first = rows[f"{frame}_quaternion"][:, [1, 2, 3, 0]]
    return np.concatenate([rows[f"{frame}_position"], vector_first], axis=1)


def _by_axes(axes: NDArray[np.float64], wrench: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns wrenches, (n, 6), whose force and torque are turned by a matrix."""
    turned = np.empty_like(wrench)
    for start in (0, 3):
        x, y, z = (wrench[:, start + k] for k in range(3))
        for k, (a, b, c) in enumerate(axes.tolist()):
            turned[:, start + k] = a * x + b * y + c * z
    return turned


def _turned(wrench: NDArray[np.float64], quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns wrenches of the world's axes along a frame's own, (n, 6).

    With q = (w, u): v + 2 u × (u × v) − 2 w u × v.
    """
    w, x, y, z = (quaternion[:, k] for k in range(4))
    turned = np.empty_like(wrench)
    for start in (0, 3):
        a, b, c = (wrench[:, start + k] for k in range(3))
        # u × v, twice
        p, q, r = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
        turned[:, start] = a + (y * r - z * q) - w * p
        turned[:, start + 1] = b + (z * p - x * r) - w * q
        turned[:, start + 2] = c + (x * q - y * p) - w * r
    # which of two NaN a sum keeps is the processor's choice
    return np.where(np.isfinite(turned), turned, np.nan)


class Checksums:
    """Sums of messages by topic, to compare what a file holds with what its ticks say."""

    def __init__(self) -> None:
        self._sums = {topic: hashlib.blake2b(digest_size=16) for topic in TOPICS}

    def add(self, topic: str, time: int, payload: bytes) -> None:
        """Adds the next message of a topic: log time in ns, and CDR."""
        self._sums[topic].update(time.to_bytes(8, "little") + payload)

    def add_all(self, messages: Mapping[str, NDArray[np.void]]) -> None:
        """Adds the next messages of each topic, as ``Messages.of_ticks`` returns them."""
        for topic, array in messages.items():
            self._sums[topic].update(array.tobytes())

    def differing(self, other: Checksums) -> list[str]:
        """Returns the topics whose messages differ from another's."""
        pairs = {topic: (own, other._sums[topic]) for topic, own in self._sums.items()}
        return [topic for topic, (a, b) in pairs.items() if a.digest() != b.digest()]
