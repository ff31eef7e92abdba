"""The device's loop as another program reaches it: a port for datagrams, beside the loop's thread.

    program ──call──▶ Endpoint._hear ──post──▶ PostedScene, taken over by the loop
    program ◀─state── Endpoint._tell ◀─record─ the loop's ring

A thread of its own hears and tells, so the loop neither reads nor writes the network.
"""

from __future__ import annotations

import socket
import threading
import time
import warnings
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.clock import SimulatedClock
from hapticbridge.demand.guard import FADE
from hapticbridge.errors import HapticBridgeError, SafetyTrip
from hapticbridge.kernel.record import POST_DTYPE
from hapticbridge.kernel.tick_guard import DEVICE_BUTTONS
from hapticbridge.program.messages import (
    CALL_DTYPE,
    STATE_DTYPE,
    STRANGER,
    VERSION,
    WORDS,
    Call,
    packed,
    unpacked,
)
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.commands import Repeat
from hapticbridge.run.options import AUTO, DEFAULT_OPTIONS, BridgeOptions
from hapticbridge.run.posted_scene import is_post
from hapticbridge.scene import Scene, load_scene
from hapticbridge.scene.compile import PROGRAM_CREDIT
from hapticbridge.units import format_number, format_si

CREDIT = 0.05
"""Usual credit of another program in J: 5 N over 1 cm, a little more than the guard's usual energy
limit. A smaller one holds the tool back when a program moves it toward the hand."""

PROGRAM_RATE = 50.0
"""Usual poses per second in Hz of another program, as of a robot's controller or a learner."""

PROGRAM_METHOD = "implicit"
"""Method with which the law's damping is the requested one."""

REPORT_PERIOD = 2e-3
"""Time in s between two messages to the program. A program of 500 Hz misses none."""

SPEED_TIME = 0.01
"""Time in s over which the handle's velocity is taken."""

STOP_LOOK = 0.1
"""Time in s between two looks for a request to end the run, while simulated time stands still."""

RATE_TIME, RATE_RATIO = 2.0, 3.0
"""Time in s over which a program's rate is looked at, and largest ratio to the stated one."""

LAST_WORDS = 0.3
"""Time in s for which the end of the run is told again, because a datagram may be lost."""

LEFT, FAILED = "program", "program that failed"
"""Reasons of a stop, in the recording: the program has left the loop, or an exception has."""

ENDS = {"duration": "its hand's motion is over", "signal": "it was interrupted"}
"""Why a loop ended by itself, for the program; other reasons speak for themselves."""

TAKEN_OVER = "another program has taken over the device loop; one at a time has it"

_TOOL = """<mujoco model="tool of another program">
  <option gravity="0 0 0"/>
  <statistic extent="0.2"/>
  <custom><numeric name="{name}" data="{credit!r}"/></custom>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1=".9 .9 .9" width="8" height="8"/>
  </asset>
  <worldbody>
    <body name="tool">
      <freejoint/>
      <geom size="0.01" mass="1" contype="0" conaffinity="0" rgba=".2 .4 .8 1"/>
      <camera name="tool" mode="track" pos="0 -0.3 0.15" xyaxes="1 0 0 0 0.4 0.9"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>"""


def posted_scene(credit: float) -> Scene:
    """Returns the scene in front of another program: a tool that is where it is shown.

    ``credit`` is what the program may give to the hand in J, > 0.
    """
    text = _TOOL.format(name=PROGRAM_CREDIT, credit=credit)
    return load_scene(mujoco.MjSpec.from_string(text))


def program_options(options: BridgeOptions) -> BridgeOptions:
    """Returns options for another program's scene, of which the law is the coupling itself.

    Raises:
        HapticBridgeError: An option is for a scene that the bridge steps, or has no effect here.
    """
    for name in ("method", "contact", "substeps", "tool_weight"):
        if getattr(options, name) != getattr(DEFAULT_OPTIONS, name):
            words = f"{name.replace('_', '-')} is for a scene that hapticbridge steps"
            raise HapticBridgeError(f"{words}; leave it out")
    if options.limits.ramp is not None:
        raise HapticBridgeError(
            "ramp is for a scene that hapticbridge steps; leave it out: where a program shows its "
            f"tool, the force begins at zero and rises within {format_si(FADE, 's')}"
        )
    rate = PROGRAM_RATE if options.scene_rate == AUTO else options.scene_rate
    if options.scene_ticks == 0 and rate != PROGRAM_RATE:  # faster than every second tick
        rate = 0.5 * options.loop_rate
    return replace(options, method=PROGRAM_METHOD, scene_rate=rate)


def ignore(_news: object) -> None:
    """Does nothing with what happens at an endpoint."""


class GrantedClock(SimulatedClock):
    """Simulated time that stands still until ticks are granted.

    Attributes:
        done: Number of the newest grant of which all ticks have ended.
        stops: Requests to end the run, for which time goes on.
    """

    def __init__(self) -> None:
        super().__init__()
        self._granted, self._number, self.done = 0, 0, 0
        self._is_open, self._wake = False, threading.Condition()
        self.stops: Collection[object] = ()

    def begin(self) -> None:
        """Takes back what was granted to another program, and counts grants from 0."""
        with self._wake:
            self._granted = self._number = self.done = 0

    def grant(self, ticks: int, number: int) -> None:
        """Lets a number of ticks pass."""
        with self._wake:
            self._granted, self._number = self._granted + ticks, number
            self._wake.notify()

    def release(self) -> None:
        """Lets time go on, so that a run can end."""
        with self._wake:
            self._is_open = True
            self._wake.notify()

    def wait(self) -> tuple[int, int, int]:
        """Waits for a granted tick (see ``Clock.wait``)."""
        with self._wake:
            if not self._granted:
                self.done = self._number
            while not (self._granted or self._is_open or self.stops):
                self._wake.wait(timeout=STOP_LOOK)
            self._granted = max(self._granted - 1, 0)
        return super().wait()


class Endpoint:
    """Port at which a program shows its tool and learns what the hand does.

    Args:
        host: Address on which it listens.
        port: Port; 0 takes any free one.
        token: Token that the program must have.
        on_leave: Called with a reason when the program leaves.
        on_begin: Called when a program begins, with True if it has taken the loop over.

    Attributes:
        address: Host and port.

    Raises:
        HapticBridgeError: The address cannot be used.
    """

    def __init__(
        self,
        host: str,
        port: int,
        token: bytes,
        on_leave: Callable[[str], None] = ignore,
        on_begin: Callable[[bool], None] = ignore,
    ) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise HapticBridgeError(
                f"port {port} of '{host}' cannot be used: {error.strerror}"
            ) from None
        self.address: tuple[str, int] = self._socket.getsockname()[:2]
        self._token, self._on_leave, self._on_begin = token, on_leave, on_begin
        self._peer: Any = None
        # of each program, the number of its newest call, and of its newest ADVANCE
        self._calls: dict[tuple[int, bool], int] = {}
        self._shows, self._since, self._has_warned = 0, 0, False
        self._placed = 0, 0  # number of the call, and tick after which it is done
        self._thread = threading.Thread(target=self._work, name="endpoint", daemon=True)
        self._told = np.zeros(1, STATE_DTYPE)
        self._told["version"] = VERSION
        self._is_closed = False

    def open(self, bridge: Bridge) -> None:
        """Begins to hear and tell; the bridge is open."""
        self._bridge, session = bridge, bridge.session
        assert session.posted is not None  # the scene is that of ``posted_scene``
        self._scene, parameters = session.posted, session.parameters
        self._scene_period = parameters.scene_period
        self._ratio = parameters.energy_ratio
        self._is_absolute = bridge.setup.workspace.absolute
        self._told["period"], coupling = parameters.period, bridge.setup.coupling
        self._told["gains"] = (
            coupling.stiffness,
            coupling.damping,
            coupling.rotational_stiffness,
            coupling.rotational_damping,
        )
        self._told["levels"] = parameters.levels_on_tool
        self._grip = session.samples["position"][1:, 0]
        self._told["is_simulated"] = isinstance(bridge.clock, GrantedClock)
        if isinstance(bridge.clock, GrantedClock):
            bridge.clock.stops = session.stop.waiting
        self._ticks = max(round(SPEED_TIME / parameters.period), 1)
        self._thread.start()

    def close(self, error: BaseException | None = None) -> None:
        """Tells the program that the run is over, and why; then closes the port."""
        self._is_closed = True
        if self._thread.is_alive():
            self._thread.join()
            self._told["is_over"] = 2 if isinstance(error, SafetyTrip) else 1
            by = self._bridge.session.stopped_by
            ended = f"the device loop has ended: {ENDS.get(by, by)}"
            words = ended if error is None else str(error)
            self._told["words"] = words.encode()[:WORDS]
            end = time.monotonic() + LAST_WORDS
            while self._peer is not None and time.monotonic() < end:
                self._tell()
                time.sleep(LAST_WORDS / 10)
        self._socket.close()

    def _work(self) -> None:
        self._socket.settimeout(REPORT_PERIOD)
        clock, due = self._bridge.clock, 0.0
        answered = 0
        while not self._is_closed:
            # in time, or a message to a program that is gone comes back as an error
            with suppress(OSError):
                self._hear(*self._socket.recvfrom(4096))
            now = time.monotonic()
            is_answered = isinstance(clock, GrantedClock) and clock.done != answered
            if self._peer is not None and (now >= due or is_answered):
                due = now + REPORT_PERIOD
                if isinstance(clock, GrantedClock):
                    answered = clock.done
                    self._told["answered"] = answered
                self._note_state()
                self._tell()

    def _hear(self, data: bytes, peer: Any) -> None:
        """Takes a call; a program that greets takes the loop over."""
        call = unpacked(data, CALL_DTYPE, self._token)
        if call is None:
            if len(data) > len(STRANGER):  # so that two loops cannot answer each other
                self._socket.sendto(STRANGER, peer)
            return
        program, number, kind = int(call["program"]), int(call["sequence"]), int(call["call"])
        key = program, kind == Call.ADVANCE  # a later pose does not take back an earlier grant
        if number <= self._calls.get(key, 0):
            return
        self._calls[key] = number
        if program != self._told["program"]:
            if kind != Call.GREET:
                self._refuse(program, peer)
                return
            self._begin(program)
        self._peer = peer
        if kind == Call.ADVANCE and isinstance(self._bridge.clock, GrantedClock):
            self._bridge.clock.grant(max(int(call["ticks"]), 1), number)
        elif kind == Call.LEAVE:
            self._peer = None
            self._on_leave(FAILED if call["ticks"] else LEFT)
        elif kind == Call.SHOW and is_post(call["post"]) and self._place(call):
            post = np.zeros(1, POST_DTYPE)
            post[0] = call["post"]
            self._scene.post(post)
            self._check_rate()

    def _place(self, call: np.void) -> bool:
        """Puts handle and tool where a call says, once; returns False if that must wait."""
        if call["placed"] <= self._placed[0]:
            return True
        waiting, placed = self._bridge.session.commands.waiting, np.zeros(1, POST_DTYPE)
        placed["pose"] = call["place"]
        if len(waiting) == waiting.maxlen or not is_post(placed[0]):
            return False  # or a flood would push a user's command out; the next call says it again
        if not self._is_absolute:
            reset = {"event": "reset", "pose": call["place"].tolist(), "by": "program"}
            waiting.append((Repeat((reset,)), "program"))
        self._placed = int(call["placed"]), self._bridge.session.tick + 1
        return True

    def _check_rate(self) -> None:
        """Warns once of a program that shows its tool much more or less often than was said."""
        tick = self._bridge.session.tick
        if self._shows == 0:
            self._since = tick
        self._shows += 1
        seconds = (tick - self._since) * float(self._told["period"][0])
        if seconds < RATE_TIME or self._has_warned:
            return
        self._has_warned = True
        stated, found = 1.0 / self._scene_period, (self._shows - 1) / seconds
        if not 1.0 / RATE_RATIO < found / stated < RATE_RATIO:
            warnings.warn(
                f"the program shows its tool {format_number(found, 3)} times per second, and the "
                f"loop was set up for {format_number(stated, 3)} (scene_rate): the usual stiffness "
                "and the patience are for that",
                stacklevel=2,
            )

    def _begin(self, program: int) -> None:
        """Counts calls, placed tools and granted time from 0 for a new program."""
        self._on_begin(self._peer is not None)
        self._told["program"], self._told["placed"], self._placed = program, 0, (0, 0)
        self._shows, self._has_warned = 0, False
        if isinstance(self._bridge.clock, GrantedClock):
            self._bridge.clock.begin()

    def _refuse(self, program: int, peer: Any) -> None:
        """Tells a program that another one has the loop."""
        told = self._told.copy()
        told["program"], told["sequence"], told["is_over"] = program, told["sequence"] + 1, 1
        told["words"] = TAKEN_OVER.encode()
        with suppress(OSError):
            self._socket.sendto(packed(told, self._token), peer)

    def _note_state(self) -> None:
        """Notes what the newest tick's record says."""
        rows: NDArray[np.void] = self._bridge.latest_records(self._ticks + 1)
        told, state = self._told, self._bridge.session.kernel.state
        if self._bridge.session.tick > self._placed[1]:
            told["placed"] = self._placed[0]
        told["grip"] = self._grip[0] if self._grip.size else np.nan
        if not len(rows):
            told["credit"] = self._ratio * state["shown"]["tank"][0]
            pose = state["pose"][0]
            told["handle"][0] = [*pose["handle_position"], *pose["handle_quaternion"]]
            return
        first, last = rows[0], rows[-1]
        told["tick"], told["lever"] = last["tick"], last["lever"]
        told["buttons"] = last["buttons"] & DEVICE_BUTTONS
        told["handle"][0] = [*last["handle_position"], *last["handle_quaternion"]]
        told["wrench"][0] = last["wrench_on_device"]
        told["credit"] = self._ratio * last["scene_tank"]
        span = float(last["tick"] - first["tick"]) * float(told["period"][0])
        moved = last["handle_position"] - first["handle_position"]
        turned = np.zeros(3)
        mujoco.mju_subQuat(turned, last["handle_quaternion"], first["handle_quaternion"])
        mujoco.mju_rotVecQuat(turned, turned.copy(), first["handle_quaternion"])
        told["velocity"][0] = np.append(moved, turned) / span if span > 0 else 0.0

    def _tell(self) -> None:
        self._told["sequence"] += 1
        with suppress(OSError):  # the network is away; the next message may pass
            self._socket.sendto(packed(self._told, self._token), self._peer)
