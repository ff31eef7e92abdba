"""A haptic device for any program: it reads the handle's pose, and shows where its tool is."""

from __future__ import annotations

import os
import secrets
import socket
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.errors import DeviceLost, HapticBridgeError, SafetyTrip
from hapticbridge.kernel.record import PLANES, POST_DTYPE, TICK_DTYPE
from hapticbridge.program.loop_process import TOKEN_VARIABLE, LoopProcess
from hapticbridge.program.messages import (
    CALL_DTYPE,
    STATE_DTYPE,
    STRANGER,
    VERSION,
    Call,
    packed,
    unpacked,
)
from hapticbridge.program.poses import matrix_of, numbers_of, offset_between, pose_of

Array = NDArray[np.float64]

PYTHON_VARIABLE = "HAPTICBRIDGE_PYTHON"
"""Environment variable with the Python in whose environment hapticbridge is installed with all that
its loop needs."""

ANSWER_TIME = 30.0
"""Longest wait in s for an answer of the loop."""

REPEAT = 0.05
"""Time in s after which a call without an answer is sent again."""

FAR = 0.2
"""Distance in m between two poses from which on a tool was probably put there."""

DOUBTFUL = 0.5
"""Energy in J, beyond what the hand gave, from which on a program's wrench is doubtful."""

UNPAID = (
    f"the wrench has moved the tool by {DOUBTFUL:g} J that the hand did not give: the tool's pose "
    "may be a step old (in MuJoCo, call mj_kinematics before wrench()), its steps not in time with "
    "the clock, or too long for so light a tool; the wrench may act along other axes, with another "
    "sign, or at another point than the shown one; or the tool was put elsewhere without "
    "show(pose, is_placed=True)"
)

LONGEST_ADVANCE = 1e4
"""Longest simulated time in s of one call."""

SILENCE = 2.0
"""Time in s without a word from the loop after which it counts as lost."""


class Handle(NamedTuple):
    """State of the hand, in the program's frame.

    Attributes:
        position: Position in m, (3,).
        quaternion: Orientation (w, x, y, z), (4,), w >= 0.
        velocity: Velocity in m/s and rad/s, (6,), over the last 10 ms, in the world frame.
        buttons: Bits of the buttons that are held, the first one 1.
        grip: How far the device's grip axis is closed in m, as a gripper between the fingers; it
            is read, and gets no force. NaN without one.
        wrench: Force in N and torque in N m on the device, (6,), in its own frame.
        is_held: True if the handle follows the device; False while a clutch is held, or no pose was
            shown for a while.
    """

    position: Array
    quaternion: Array
    velocity: Array
    buttons: int
    grip: float
    wrench: Array
    is_held: bool

    @property
    def matrix(self) -> Array:
        """Pose as a matrix, (4, 4)."""
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = matrix_of(self.quaternion), self.position
        return result


class Surface(NamedTuple):
    """A surface near the tool, which stops it between two poses.

    Attributes:
        point: The point of the tool that is nearest to the surface, in m, (3,).
        normal: Direction away from the surface, (3,); its length does not count.
        gap: Distance from that point to the surface in m, >= 0.
    """

    point: ArrayLike
    normal: ArrayLike
    gap: float = 0.0


class DeviceLoop:
    """Loop of a haptic device at 1 kHz, for a program that steps its own scene at its own rate.

    The hand pulls at the tool's pose that the program shows, through a virtual coupling. Whatever
    the program shows, and when, the hand gets at most what it put in, plus a credit of 0.05 J. The
    loop runs in a process of its own; entering the context waits until it runs, leaving it ends
    the force and closes the recording. Poses are (x, y, z, qw, qx, qy, qz), a position alone, or a
    4 × 4 matrix, in m. All calls may come from any thread, and none but ``advance`` waits.

        with DeviceLoop("falcon", scale=2.0, recording="demo.mcap") as device:
            device.show(tool_pose())
            while True:
                step(target=device.pose().position)
                device.show(tool_pose())

    Args:
        device: A device as for ``hapticbridge run --device``, or ``remote:HOST:PORT`` for a loop
            that ``hapticbridge serve`` runs on another machine.
        recording: File to write (``.mcap``); a recording of that name is replaced.
        is_simulated: True for simulated time, which ``advance`` moves: equal in every run.
        python: Interpreter of the environment that has the loop; by default that of the variable
            HAPTICBRIDGE_PYTHON, else this one.
        token: Token of a remote loop, as it prints it; by default that of the variable
            HAPTICBRIDGE_TOKEN.
        **options: Options of ``hapticbridge serve``: ``scale``, ``axes``, ``absolute``, ``clutch``,
            ``stiffness``, ``damping``, ``credit``, ``scene_rate``, ``force_limit`` and so on.

    Attributes:
        summary: The loop's summary, once it was left; empty for a remote loop.

    Raises:
        HapticBridgeError: The loop cannot start; the message is its own.
    """

    def __init__(
        self,
        device: str = "simulated",
        *,
        recording: str | Path | None = None,
        is_simulated: bool = False,
        python: str | Path | None = None,
        token: str | None = None,
        **options: Any,
    ) -> None:
        self._token = (
            token or os.environ.get(TOKEN_VARIABLE) or secrets.token_urlsafe(18)
        ).encode()
        if not isinstance(device, str):
            raise HapticBridgeError(
                f"device is {device!r}; it must be a name as 'hapticbridge devices' prints it"
            )
        self._remote = _address(device) if device.startswith("remote:") else None
        if self._remote and (options or recording or is_simulated or python):
            raise HapticBridgeError(
                "options, recording, time and python of a remote loop are those of 'hapticbridge "
                "serve' there"
            )
        if self._remote and not (token or os.environ.get(TOKEN_VARIABLE)):
            raise HapticBridgeError(
                "a remote loop needs its token, which 'hapticbridge serve' has printed: token= or "
                f"the variable {TOKEN_VARIABLE}"
            )
        if recording is not None and not str(recording):
            raise HapticBridgeError("recording is ''; it must be the name of a file, or None")
        chosen = str(python or os.environ.get(PYTHON_VARIABLE) or sys.executable)
        command = [chosen, "-m", "hapticbridge", "serve", device, "--port", "0", "--json"]
        command += _flags(options)
        command += ["--record", str(recording), "--overwrite"] if recording else []
        command += ["--fast"] * is_simulated
        self._process = None if self._remote else LoopProcess(command, self._token.decode())
        self._lock = threading.Lock()
        self._rest = 0.0  # s of simulated time beyond the last whole tick
        self._call = np.zeros(1, CALL_DTYPE)
        self._call["version"], self._call["program"] = VERSION, secrets.randbits(63)
        self._state: np.void = np.zeros(1, STATE_DTYPE)[0]
        self._has_state, self._has_shown = threading.Event(), False
        self._socket: socket.socket | None = None
        self._heard = 0.0
        self._applied, self._shown = np.zeros(6), np.zeros(7)
        self._is_closed = False
        self._is_stranger = self._is_absent = self._has_warned = False
        self.summary: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self.open()

    def open(self) -> Self:
        """Waits until the loop runs; ``with`` does it, and closes it, too.

        Raises:
            HapticBridgeError: The loop cannot start, no loop answers, or it was opened before.
        """
        if self._socket is not None or self._is_closed:
            raise HapticBridgeError("a DeviceLoop is opened once; make another one")
        address = self._remote or (self._process.start() if self._process else ("", 0))
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        channel = socket.socket(family, socket.SOCK_DGRAM)
        try:
            channel.connect(address)
        except OSError as error:
            channel.close()
            raise HapticBridgeError(f"there is no host '{address[0]}': {error.strerror}") from None
        self._socket = channel
        self._listener = threading.Thread(
            target=self._listen, args=(channel,), name="device loop", daemon=True
        )
        self._listener.start()
        end = time.monotonic() + ANSWER_TIME
        while not self._has_state.wait(REPEAT):
            self._send(Call.GREET)
            if time.monotonic() > end or self._is_stranger or self._is_absent:
                self.close()
                where = f"{address[0]}:{address[1]}"
                if self._is_stranger:
                    raise HapticBridgeError(
                        f"the device loop at {where} has another token or another version"
                    )
                raise HapticBridgeError(
                    f"no device loop answers at {where}: is 'hapticbridge serve' running there?"
                )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._call["ticks"] = error is not None
        self._close()

    # What a program calls

    def pose(self) -> Handle:
        """Returns what the hand does now; never waits.

        Raises:
            SafetyTrip: The guard stopped the loop.
            DeviceLost: The loop ended, or has not been heard for ``SILENCE``.
            HapticBridgeError: No pose was shown yet, and the handle begins where the tool is.
        """
        state = self._newest()
        if not self._has_shown:
            raise HapticBridgeError(
                "show the tool's pose once before the first pose(): the handle begins there"
            )
        handle, velocity = self._handle_in(state)
        return Handle(
            position=handle[:3].copy(),
            quaternion=handle[3:].copy(),
            velocity=velocity.copy(),
            buttons=int(state["buttons"]),
            grip=float(state["grip"]),
            wrench=state["wrench"].copy(),
            is_held=bool(state["lever"] > 0.0),
        )

    def show(
        self,
        pose: ArrayLike,
        velocity: ArrayLike | None = None,
        surfaces: Sequence[Surface] = (),
        *,
        is_placed: bool = False,
    ) -> None:
        """Shows where the program's tool is; never waits.

        Without a velocity the tool is led to the pose within the time between two calls, so it
        lags by that time. With one it moves on, and a surface stops it.

        Args:
            pose: Pose of the tool at its grip.
            velocity: Velocity of the grip in m/s and angular velocity in rad/s, (3,) or (6,), in
                the world frame; a free joint's ``qvel`` has the angular part in the body's.
            surfaces: At most ``PLANES`` surfaces near the tool, at this pose.
            is_placed: True if the tool was put there, as by a reset of the scene: the handle is put
                there, too, and the force begins anew.

        Raises:
            HapticBridgeError: A number is missing or not finite.
        """
        self._newest()
        post = self._post(pose, velocity, surfaces)
        with self._lock:
            post["work"] = self._call["post"]["work"]
            if not is_placed:
                self._doubt(post["pose"][0, :3])
            self._shown = post["pose"][0].copy()
            if is_placed:  # no wrench has brought it there
                self._applied = np.zeros(6)
            self._call["post"] = post
            is_first, self._has_shown = not self._has_shown, True
            self._send_pose(is_placed=is_placed or is_first)

    def wrench(self, pose: ArrayLike, velocity: ArrayLike | None = None) -> Array:
        """Shows the tool, and returns the coupling's wrench on it, (6,) in N and N m.

        Apply it at the grip, in the world frame, until the next call. Its work on the tool is then
        known, so that the hand feels what the tool feels. The pose must be of this moment: after
        ``mj_step`` a site's is one step old, and ``mj_kinematics`` renews it.

            f = K (h − x) + B (v_h − v), at most the force level;    W += f·δx + τ·δφ

        Args:
            pose: Pose of the tool at its grip.
            velocity: Its velocity, as for ``show``; None takes a tool at rest.

        Raises:
            HapticBridgeError: As for ``show``.
        """
        state = self._newest()
        post = self._post(pose, velocity, ())
        (handle, velocity_of_handle), own = self._handle_in(state), post["pose"][0]
        with self._lock:
            work = 0.0
            if self._has_shown:
                work = float(self._applied @ offset_between(self._shown, own))
            stiffness, damping, turning, turn_damping = state["gains"]
            speed = velocity_of_handle - post["velocity"][0]
            offset = offset_between(own, handle)
            force = stiffness * offset[:3] + damping * speed[:3]
            torque = turning * offset[3:] + turn_damping * speed[3:]
            is_first = not self._has_shown
            share = 0.0 if is_first else float(state["lever"])
            level, torque_level = state["levels"]
            self._applied = share * np.append(_within(force, level), _within(torque, torque_level))
            post["work"] = total = self._call["post"]["work"] + work
            if not self._has_warned and min(total[0], state["credit"]) < -DOUBTFUL:
                self._has_warned = True
                warnings.warn(UNPAID, stacklevel=2)
            self._shown, self._has_shown = own.copy(), True
            self._call["post"] = post
            self._send_pose(is_placed=is_first)
            return self._applied.copy()

    def advance(self, seconds: float) -> None:
        """Lets simulated time go on, and waits until it has.

        Args:
            seconds: Time in s; whole ticks of it go by, and the rest counts in the next call.

        Raises:
            HapticBridgeError: The loop runs in real time, or the time is no number >= 0.
            DeviceLost: It does not answer.
        """
        state = self._newest()
        if not state["is_simulated"]:
            raise HapticBridgeError(
                "real time goes on by itself; advance() is for is_simulated=True"
            )
        if not 0.0 <= float(numbers_of("seconds", seconds)) <= LONGEST_ADVANCE:
            raise HapticBridgeError(f"seconds is {seconds!r}; it must be 0 to {LONGEST_ADVANCE:g}")
        with self._lock:
            period = float(state["period"])
            ticks = round((self._rest + seconds) / period)
            self._rest += seconds - ticks * period
            if ticks == 0:
                return
            self._call["ticks"] = ticks
            self._send(Call.ADVANCE)
            call = packed(self._call, self._token)
            wanted = int(self._call["sequence"][0])
        end = time.monotonic() + ANSWER_TIME
        repeat = time.monotonic() + REPEAT
        while int(self._state["answered"]) < wanted:
            self._newest()
            if time.monotonic() > repeat:  # the same call, so that it counts once
                repeat = time.monotonic() + REPEAT
                self._transmit(call)
            if time.monotonic() > end:
                raise DeviceLost(f"the device loop does not answer for {ANSWER_TIME:g} s")
            self._has_state.wait(REPEAT)
            self._has_state.clear()

    @property
    def credit(self) -> float:
        """Energy in J that the program may still give to the hand: what the tank has."""
        return float(self._state["credit"])

    @property
    def work(self) -> float:
        """Work of ``wrench`` on the program's tool so far, in J, as the loop is told."""
        return float(self._call["post"]["work"][0])

    @property
    def pid(self) -> int | None:
        """Number of the loop's process; None for a remote loop, or before it was started."""
        return None if self._process is None else self._process.pid

    def close(self) -> None:
        """Ends the force and the loop, and waits until its recording is closed."""
        self._call["ticks"] = 0
        self._close()

    def _close(self) -> None:
        if self._is_closed:
            return
        self._is_closed = True
        if self._socket is not None:
            with self._lock:
                self._send(Call.LEAVE)
            with suppress(OSError):  # it wakes the listener, which close() alone does not
                self._socket.shutdown(socket.SHUT_RD)
            self._listener.join(1.0)
            self._socket.close()
        if self._process is not None:
            self.summary = self._process.end(ANSWER_TIME if self._heard else 0.0)

    # Datagrams

    def _post(
        self, pose: ArrayLike, velocity: ArrayLike | None, surfaces: Sequence[Surface]
    ) -> NDArray[np.void]:
        post = np.zeros(1, POST_DTYPE)
        post["pose"] = own = pose_of(pose, self._state["handle"][3:])
        if velocity is not None:
            numbers = numbers_of("velocity", velocity)
            if numbers.shape not in ((3,), (6,)):
                raise HapticBridgeError(
                    f"velocity has shape {numbers.shape}; it must be 3 or 6 numbers"
                )
            post["has_velocity"], post["velocity"][0, : numbers.size] = 1, numbers
        if not isinstance(surfaces, list | tuple) or any(type(s) is not Surface for s in surfaces):
            raise HapticBridgeError(
                f"surfaces are {surfaces!r}; they must be a list of Surface(point, normal, gap)"
            )
        if len(surfaces) > PLANES:
            raise HapticBridgeError(f"{len(surfaces)} surfaces are shown; {PLANES} are the most")
        post["planes"] = len(surfaces)
        for k, surface in enumerate(surfaces):
            normal, part = numbers_of("normal", surface.normal), slice(3 * k, 3 * k + 3)
            if normal.shape != (3,) or not np.any(normal):
                raise HapticBridgeError("the normal of a surface must be 3 numbers, not all 0")
            post["normals"][0, part] = normal / np.linalg.norm(normal)
            point, gap = numbers_of("point", surface.point), numbers_of("gap", surface.gap)
            if point.shape != (3,) or gap.shape != () or gap < 0.0:
                raise HapticBridgeError(
                    "a surface has a point of 3 numbers, and a gap that is one number, >= 0"
                )
            post["arms"][0, part], post["gaps"][0, k] = point - own[:3], gap
        return post

    def _doubt(self, position: Array) -> None:
        """Warns once of a tool that is shown where none is likely to be."""
        step = float(np.linalg.norm(position - self._shown[:3])) if self._has_shown else 0.0
        if self._has_warned or (step < FAR and np.abs(position).max() < 100.0 * FAR):
            return
        self._has_warned = True
        words = f"the tool is shown at {position.round(3).tolist()} m"
        if step >= FAR:
            words += f", {step:.3g} m from the pose before"
        words += ": positions are in m"
        if step >= FAR:
            words += ", and is_placed=True says that a tool was put elsewhere, as after a reset"
        warnings.warn(words, stacklevel=3)

    def _handle_in(self, state: np.void) -> tuple[Array, Array]:
        """Returns pose and velocity of the handle; until it is placed, those that it will have."""
        if state["placed"] < self._call["placed"][0]:
            return self._call["place"][0], np.zeros(6)
        return state["handle"], state["velocity"]

    def _send_pose(self, *, is_placed: bool) -> None:
        """Sends the pose, and with it where the tool was put last: that message may be lost."""
        if is_placed:
            self._call["placed"] = self._call["sequence"] + 1
            self._call["place"] = self._call["post"]["pose"]
        self._send(Call.SHOW)

    def _send(self, call: Call) -> None:
        self._call["sequence"] += 1
        self._call["call"] = call
        self._transmit(packed(self._call, self._token))

    def _transmit(self, data: bytes) -> None:
        if self._socket is not None:
            with suppress(OSError):  # a network that is away may come back
                self._socket.send(data)

    def _listen(self, channel: socket.socket) -> None:
        while not self._is_closed:
            try:
                data = channel.recv(4096)
            except ConnectionError:  # no loop is at that port, or no longer
                self._is_absent = True
                time.sleep(REPEAT)
                continue
            except OSError:
                return
            self._is_stranger |= data == STRANGER
            state = unpacked(data, STATE_DTYPE, self._token)
            if state is None or state["program"] != self._call["program"]:
                continue
            if state["sequence"] > self._state["sequence"]:
                self._state, self._heard = state, time.monotonic()
                self._has_state.set()

    def _newest(self) -> np.void:
        """Returns the loop's newest state.

        Raises:
            SafetyTrip: The guard stopped the loop.
            DeviceLost: It ended otherwise, or is silent.
        """
        if self._is_closed or not self._heard:
            raise HapticBridgeError(
                "the device loop is not open; open it with 'with DeviceLoop(…)'"
            )
        state = self._state
        if state["is_over"]:
            words = bytes(state["words"]).decode(errors="replace")
            if state["is_over"] > 1:
                raise SafetyTrip(words, np.empty(0, TICK_DTYPE))
            raise DeviceLost(words)
        silence = time.monotonic() - self._heard
        if silence > SILENCE and not state["is_simulated"]:
            raise DeviceLost(f"the device loop was not heard for {silence:.1f} s")
        if self._process is not None and not self._process.is_running:
            raise DeviceLost(f"the device loop ended: {self._process.last_error}")
        return state


def _address(device: str) -> tuple[str, int]:
    host, _, port = device.removeprefix("remote:").rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise HapticBridgeError(f"device is '{device}'; a remote loop is remote:HOST:PORT")
    return host.strip("[]"), int(port)


def _flags(options: Mapping[str, Any]) -> Iterator[str]:
    """Yields the flags of ``hapticbridge serve`` for some options."""
    for name, value in options.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            yield f"--{flag}" if value else f"--no-{flag}"
        elif value is not None:
            yield f"--{flag}"
            is_many = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)
            yield from (map(str, np.ravel(value)) if is_many else (str(value),))


def _within(vector: Array, limit: float) -> Array:
    size = float(np.linalg.norm(vector))
    return vector if size <= limit else vector * (limit / size)
