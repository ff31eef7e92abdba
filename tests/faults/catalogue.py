"""The faults: each a function that does one to a rig, with what must come of it."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from waiting import has_ended, until

from faults.rig import CAUSE, PERIOD, PRESS, STALE, FaultyDevice, Outcome, Rig
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.device.simulated.dynamics import DEFAULT_HAND, Hand
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.recording.recorder import recorder_process
from hapticbridge.recording.ring import HEAD, TAIL
from hapticbridge.run.bridge import Bridge
from hapticbridge.theory.sampled_loop import WorstHand
from hapticbridge.view.window import Address, Window

PUSHER = """<mujoco><compiler angle="radian"/>
<option timestep="0.001" integrator="discrete" gravity="0 0 0" cone="elliptic"/>
<default><geom solref="0.002 1" solimp="0.9 0.95 0.001"/></default>
<worldbody>
  <body name="tool"><joint name="rail" type="slide" axis="1 0 0"/>
    <geom type="sphere" size="0.01" mass="0.05"/><site name="grip"/></body>
  <body name="ram" pos="0.06 0 0"><joint name="ram" type="slide" axis="1 0 0" damping="20"/>
    <geom type="box" size="0.01 0.03 0.03" mass="0.5"/></body>
</worldbody>
<actuator><motor name="ram" joint="ram" ctrlrange="-40 40"/></actuator></mujoco>
"""
"""A ram on a motor in front of the tool: with 40 N it drives the tool through wherever it is."""


@dataclass(frozen=True)
class Fault:
    """A fault and its bars.

    Attributes:
        name: In a few words.
        do: Does it to a rig.
        ends: What must come of it: ``trip``, ``refuses`` (the run ends before its first tick),
            ``fades`` (the force is taken away and comes back), ``slips`` (the handle slips for
            what late samples gave), ``stops`` (the run ends with zero force), ``lowers`` (the
            watch lowers the force or takes it away), ``leaves`` (the bridge ends and leaves the
            recorder to finish) or ``goes on``.
        says: What the audit of its recording must name; empty where the run is an ordinary one.
        without: What of the guard is switched off on the other side.
        cause: The tick at which it can be seen.
        within: Ticks from there to zero force; from the first 10 mJ to the watch for ``lowers``.
        energy: Largest energy to the hand in J.
    """

    name: str
    do: Callable[[Rig], None]
    ends: str
    says: str = ""
    without: dict[str, Any] | None = None
    cause: int = CAUSE
    within: int = 2
    energy: float = 0.05

    def run(self, folder: Path) -> Outcome:
        rig = Rig(folder)
        self.do(rig)
        return rig.run(self.cause)

    def unguarded(self, folder: Path) -> FaultyDevice:
        """Returns the device after the same without its part of the guard, unrecorded."""
        rig = Rig(folder)
        self.do(rig)
        rig.options |= {"probe": False}
        rig.guard |= self.without or {}
        return rig.run_unrecorded()


def corrupting(change: Callable[[int, NDArray[np.void]], int | None]) -> Callable[[Rig], None]:
    """Returns a fault that changes the samples from the cause on."""

    def do(rig: Rig) -> None:
        def corrupt(tick: int, sample: NDArray[np.void]) -> int:
            return 0 if tick < CAUSE else change(tick - CAUSE, sample) or 0

        rig.device.corrupt = corrupt

    return do


def added(name: str, *change: float) -> Callable[[Rig], None]:
    """Returns a fault that adds something to one field of the samples from the cause on."""

    def change_it(_since: int, sample: NDArray[np.void]) -> None:
        sample[name] += change

    return corrupting(change_it)


def _other_sign(_since: int, sample: NDArray[np.void]) -> None:
    sample["quaternion"] *= -1.0


def at_the_cause(act: Callable[[Rig], None]) -> Callable[[Rig], None]:
    """Returns a fault that does something when the sample of the cause is read."""

    def do(rig: Rig) -> None:
        corrupting(lambda since, _sample: act(rig) if since == 0 else None)(rig)

    return do


def _read_fails(_rig: Rig) -> None:
    raise DeviceError("the device reports a fault of its own (code 8)")


def keep_up(bridge: Bridge) -> None:
    """Lets the recorder write what there is, as it does in real time; until it is dead."""
    recorder, cursors = bridge.session.stream.recorder, bridge.session.stream.cursors
    assert recorder is not None
    while cursors[TAIL] < cursors[HEAD] and recorder.is_alive():
        time.sleep(1e-3)


def _frozen(rig: Rig) -> None:
    """For 0.3 s nothing new comes, while the hand goes back by 20 mm."""
    rig.points = (*PRESS[:3], (1.5, 0.0804), (1.7, 0.0604), (9.0, 0.0604))
    corrupting(lambda since, _sample: STALE if since < 300 else 0)(rig)


def _every(share: float) -> Callable[[Rig], None]:
    chosen = np.random.default_rng(3).random(4000) < share
    return corrupting(lambda since, _sample: STALE if chosen[since] else 0)


def _stall(rig: Rig) -> None:
    """The loop stands still for 0.2 s, in which the hand goes 20 mm deeper."""
    rig.points = (*PRESS[:3], (1.5, 0.0804), (1.7, 0.1004), (1.9, 0.0804), (9.0, 0.0804))
    rig.device.corrupt = passing(rig, CAUSE, 0.2)


def passing(rig: Rig, at: int, seconds: float) -> Callable[[int, NDArray[np.void]], int]:
    """The loop learns at a tick that time has passed, and the device moved on."""

    def corrupt(tick: int, sample: NDArray[np.void]) -> int:
        if tick == at:
            rig.clock.block(seconds)
            for _ in range(round(seconds / PERIOD)):
                rig.device.move_on()
            sample[0] = rig.device.true[0]
        return 0

    return corrupt


def _read_blocks(rig: Rig) -> None:
    rig.device.corrupt = passing(rig, CAUSE, 1.0)


def _write_blocks(rig: Rig) -> None:
    def refuse(tick: int, _wrench: NDArray[np.float64]) -> None:
        if tick == CAUSE - 1:
            rig.clock.block(1.0)
            for _ in range(1000):
                rig.device.move_on()

    rig.device.refuse = refuse


def _write_fails(rig: Rig) -> None:
    def refuse(tick: int, wrench: NDArray[np.float64]) -> None:
        if tick >= CAUSE:
            rig.device.hold(np.zeros(6))  # unplugged: no current
            raise DeviceLost("the device is gone")
        del wrench

    rig.device.refuse = refuse


def _write_is_cut(rig: Rig) -> None:
    def refuse(tick: int, wrench: NDArray[np.float64]) -> None:
        if tick == CAUSE and wrench.any():
            rig.device.hold(np.concatenate([wrench[:2], np.zeros(4)]))
            raise DeviceLost("the device took 16 of 48 bytes")

    rig.device.refuse = refuse


def acting(act: Callable[[Bridge], None], at: int = CAUSE) -> Callable[[Rig], None]:
    """Returns a fault that does something to the bridge before a tick."""

    def do(rig: Rig) -> None:
        rig.on_tick = lambda bridge, tick: act(bridge) if tick == at else None

    return do


def filled(field: str, value: float) -> Callable[[Rig], None]:
    """Returns a fault that overwrites an array of the scene's state."""
    return acting(lambda bridge: getattr(bridge.scene.data, field).fill(value))


def _raise(_bridge: Bridge) -> None:
    raise ZeroDivisionError


def _signal(number: int) -> Callable[[Bridge], None]:
    return lambda _bridge: os.kill(os.getpid(), number)


def _kill_recorder(bridge: Bridge) -> None:
    recorder = bridge.session.stream.recorder
    assert recorder is not None
    os.kill(recorder.pid, signal.SIGKILL)
    while recorder.is_alive():
        time.sleep(1e-3)


def _motor(rig: Rig) -> None:
    rig.scene = rig.folder / "pusher.xml"
    rig.scene.write_text(PUSHER)
    rig.points = ((0.0, 0.0), (9.0, 0.0))
    rig.on_tick = lambda bridge, tick: (
        bridge.set_input(ctrl={"ram": -40.0}) if tick == CAUSE - 1000 else None
    )


def stiff(factor: float, hand: Hand | WorstHand | None, controller: str = "damper") -> Any:
    """Returns a fault: a wall too stiff for the device, which is knocked with 5 N for 5 ms.

    Args:
        factor: Stiffness over the largest that a device of 2 N s/m bears, 2b/T = 4000 N/m.
        hand: Who holds it.
        controller: Passivity controller.
    """

    def do(rig: Rig) -> None:
        rig.scene = rig.folder / "heavy.xml"
        rig.scene.write_text(HEAVY)
        rig.points = ((0.0, 0.0), (9.0, 0.0))
        rig.parameters = {"hand": hand}
        rig.options = {"method": "implicit", "controller": controller}
        rig.coupling = Coupling(factor * 4000.0, 0.0, 1.0, 5e-4)

        def refuse(tick: int, wrench: NDArray[np.float64]) -> None:
            if CAUSE <= tick < CAUSE + 5:
                wrench[0] += 5.0

        rig.device.refuse = refuse

    return do


HEAVY = """<mujoco><compiler angle="radian"/>
<option timestep="0.001" integrator="discrete" gravity="0 0 0"/>
<worldbody><body name="tool"><freejoint/>
  <geom type="sphere" size="0.01" mass="1000"/><site name="grip"/></body></worldbody></mujoco>
"""
"""A tool of a ton: behind a coupling it is a wall."""


def _quantised(rig: Rig) -> None:
    rig.parameters = {"resolution": 5e-5}


def _stopped_recorder(rig: Rig) -> None:
    """The recorder is stopped and told to go on only when the bridge has ended."""
    recorders: list[int] = []

    def stop(bridge: Bridge) -> None:
        recorder = bridge.session.stream.recorder
        assert recorder is not None
        recorders.append(recorder.pid)
        os.kill(recorder.pid, signal.SIGSTOP)

    def wake() -> None:
        os.kill(recorders[0], signal.SIGCONT)
        until(lambda: has_ended(recorders[0]))

    acting(stop)(rig)
    rig.after = wake


STALLING = """
import sys, types, time
from pathlib import Path
package = types.ModuleType("hapticbridge")
package.__path__ = [sys.argv[1]]
sys.modules["hapticbridge"] = package
from hapticbridge.recording.recorder_process import run
from hapticbridge.recording.writer import RecordingWriter
write = RecordingWriter.write_ticks

def stalled(writer, rows, hand):
    while rows["tick"][-1] > 1500 and not Path("GO").exists():
        time.sleep(1e-3)
    write(writer, rows, hand)

RecordingWriter.write_ticks = stalled
run()
"""
"""A recorder whose writes do not return until the file GO exists."""


RECORDER = recorder_process.__module__


def _stalled_disk(rig: Rig) -> None:
    """From the cause on the recorder's writes do not return until the bridge has ended."""
    go = rig.folder / "go"
    recorders: list[int] = []

    def around(stack: ExitStack) -> None:
        bootstrap = STALLING.replace("GO", str(go))
        stack.enter_context(patch(f"{RECORDER}._BOOTSTRAP", bootstrap))
        # a process of its own, although the recorders of tests are forks
        stack.enter_context(patch(f"{RECORDER}.recorder_process", recorder_process))

    def wake() -> None:
        go.touch()
        until(lambda: has_ended(recorders[0]))

    def note(bridge: Bridge) -> None:
        recorder = bridge.session.stream.recorder
        assert recorder is not None
        recorders.append(recorder.pid)

    acting(note)(rig)
    rig.around, rig.after = around, wake


def _wall_clock(rig: Rig) -> None:
    """The time of day is set; the loop must not look at it."""

    def around(stack: ExitStack) -> None:
        real = time.time
        stack.callback(setattr, time, "time", real)
        time.time = lambda: real() - 3600.0

    rig.around = around


def _fill_disk(rig: Rig) -> None:
    """From the cause on the recorder's file may not grow, as on a disk that is full."""

    def fill(bridge: Bridge, tick: int) -> None:
        recorder, path = bridge.session.stream.recorder, bridge.output.path
        assert recorder is not None and path is not None
        if tick == CAUSE:
            size = path.stat().st_size + 1000
            resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (size, size))
        if tick > CAUSE and tick % 50 == 0:
            keep_up(bridge)

    rig.on_tick = fill


def _full_tmpfs(rig: Rig) -> None:
    """The recording lies on a small disk, which fills up before the first chunk is written."""
    disk = rig.folder / "disk"

    def around(stack: ExitStack) -> None:
        disk.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=12m", "none", disk], check=True)
        stack.callback(lambda: subprocess.run(["umount", disk], check=True))

    def fill(bridge: Bridge, tick: int) -> None:
        recorder = bridge.session.stream.recorder
        assert recorder is not None
        if tick == 0:
            os.kill(recorder.pid, signal.SIGSTOP)
        if tick == CAUSE:
            with (disk / "rubbish").open("wb", buffering=0) as file, suppress(OSError):
                while True:
                    file.write(bytes(4096))
            os.kill(recorder.pid, signal.SIGCONT)
        if tick > CAUSE and tick % 50 == 0:
            keep_up(bridge)

    rig.around, rig.on_tick = around, fill
    rig.recording = disk / "run.mcap"


def _full_ring(rig: Rig) -> None:
    """The recorder stands still for 1 s behind a ring of 0.2 s."""

    def around(stack: ExitStack) -> None:
        stack.enter_context(patch("hapticbridge.recording.recorder.RING_SECONDS", 0.2))

    def act(bridge: Bridge, tick: int) -> None:
        recorder = bridge.session.stream.recorder
        assert recorder is not None
        if CAUSE <= tick < CAUSE + 1000:
            if tick == CAUSE:
                os.kill(recorder.pid, signal.SIGSTOP)
            return
        os.kill(recorder.pid, signal.SIGCONT)
        if tick % 50 == 0:
            keep_up(bridge)

    rig.around, rig.on_tick, rig.duration = around, act, 3.0
    rig.clock.may_wait = False


def can_mount() -> bool:
    """Tells whether this process may mount a file system, as root in its own namespace may."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", folder]
        if sys.platform != "linux" or shutil.which("mount") is None:
            return False
        done = subprocess.run(command, check=False, capture_output=True)
        if done.returncode == 0:
            subprocess.run(["umount", folder], check=True)
        return done.returncode == 0


def _suspended(rig: Rig) -> None:
    """The machine sleeps for 5 s, in which the hand goes 20 mm deeper."""
    rig.points = (*PRESS[:3], (1.5, 0.0804), (1.7, 0.1004), (9.0, 0.1004))
    asleep = 0

    def around(stack: ExitStack) -> None:
        stack.enter_context(patch("hapticbridge.run.session.slept_ns", lambda: asleep))

    def corrupt(tick: int, sample: NDArray[np.void]) -> int:
        nonlocal asleep
        if tick == CAUSE:
            asleep = 5_000_000_000
        return pass_time(tick, sample)

    pass_time = passing(rig, CAUSE, 5.0)
    rig.around, rig.device.corrupt = around, corrupt


SPECTATOR = """
import json, sys, time
sys.path.insert(0, sys.argv[1])
from hapticbridge.recording import Ring
job = json.loads(sys.stdin.buffer.readline())
for _, size in job["attachments"]:
    sys.stdin.buffer.read(size)
ring = Ring.attach(job["ring"])
print(json.dumps({"url": "nowhere"}), flush=True)
while True:
    ring.latest(1)
    time.sleep(0.01)
"""


def _watched(how: int) -> Callable[[Rig], None]:
    """The view is open, and its process gets a signal: killed, or stopped without an end."""

    def do(rig: Rig) -> None:
        def around(stack: ExitStack) -> None:
            stack.enter_context(patch("hapticbridge.view.window.check_view"))
            stack.enter_context(patch("hapticbridge.view.window._BOOTSTRAP", SPECTATOR))
            rig.options["observer"] = window = Window(Address(0))

            def act(bridge: Bridge, tick: int) -> None:
                if tick == CAUSE:
                    assert window.process_id is not None
                    os.kill(window.process_id, how)
                if tick >= CAUSE and tick % 100 == 0:
                    bridge.set_input(joint_force={})

            rig.on_tick = act

        rig.around = around

    return do


def _edge(rig: Rig) -> None:
    """The hand pushes the device over the edge of its workspace, and comes back."""
    rig.options = {"limits": Limits(force=10.0, torque=0.5, ramp=0.2, reach=0.0125)}
    rig.points = (*PRESS[:2], (0.9, 0.02), (1.5, 0.02), (1.6, 0.0804), (1.9, 0.0), (9.0, 0.0))


FINGERS = Hand(mass=0.06, damping=3.5, stiffness=39.0)
"""Two fingers: they take up more energy from a swing than an arm, and move faster."""

PRESSES = {DEFAULT_HAND: 0.0804, FINGERS: 0.181}
"""Goal of a hand in m: it presses on the wall with 9.5 N, fingers with 6.7 N."""

TWO_FINGERS_TURN = Hand(
    mass=0.05,
    damping=2.0,
    stiffness=30.0,
    rotational_inertia=2e-5,
    rotational_damping=2e-3,
    rotational_stiffness=0.3,
)
"""Two fingers that turn a ratchet."""

Change = Callable[[int, NDArray[np.float64]], NDArray[np.float64]]


def forced(change: Callable[[], Change], hand: Hand, limit: float = 10.0) -> Callable[[Rig], None]:
    """Returns a fault of a device whose motors do not do what they are told, from its start on.

    Args:
        change: Makes a function of tick and written wrench that returns the wrench of the motors.
        hand: Who holds it and presses on the wall; ``TWO_FINGERS_TURN`` turn a ratchet by 1 rad.
        limit: Force limit in N, and the press in proportion.
    """

    def do(rig: Rig) -> None:
        rig.parameters = {"hand": hand}
        rig.options = {"limits": Limits(force=limit, torque=0.5, ramp=0.2)}
        reach = PRESSES.get(hand, 1.0) * limit / 10.0
        rig.points = ((0.0, 0.0), (0.2, 0.0), (0.9, reach), (9.0, reach))
        if hand is TWO_FINGERS_TURN:
            rig.scene, rig.turns = "ratchet", True
        disobey(rig, change)

    return do


def disobey(rig: Rig, change: Callable[[], Change]) -> None:
    """Lets the motors do what a function makes of the written wrench, from the start on."""
    act = change()

    def refuse(tick: int, wrench: NDArray[np.float64]) -> None:
        wrench[:] = act(tick, wrench.copy())

    rig.device.refuse = refuse


def late(ticks_of: Callable[[int], int]) -> Callable[[], Change]:
    """Returns a delay of so many ticks."""

    def change() -> Change:
        past: list[NDArray[np.float64]] = []

        def act(tick: int, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
            past.append(wrench)
            ticks = ticks_of(tick)
            return past[-1 - ticks] if len(past) > ticks else np.zeros(6)

        return act

    return change


def lagging(seconds: float) -> Callable[[], Change]:
    """Returns motors that follow with a time constant."""

    def change() -> Change:
        held = np.zeros(6)

        def act(_tick: int, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
            held[:] += PERIOD / (seconds + PERIOD) * (wrench - held)
            return held.copy()

        return act

    return change


def holding(ticks: int) -> Callable[[], Change]:
    """Returns motors that take a new force only once in so many ticks."""

    def change() -> Change:
        held = np.zeros(6)

        def act(tick: int, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
            if tick % ticks == 0:
                held[:] = wrench
            return held.copy()

        return act

    return change


def turning(speed: float) -> Callable[[], Change]:
    """Returns motors whose frame turns about z, in rad/s; at π rad the axes are reversed."""

    def act(tick: int, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
        c, s = np.cos(speed * PERIOD * tick), np.sin(speed * PERIOD * tick)
        wrench[:2] = c * wrench[0] - s * wrench[1], s * wrench[0] + c * wrench[1]
        return wrench

    return lambda: act


def _reversed_x(_tick: int, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
    wrench[0] = -wrench[0]
    return wrench


def reversing() -> Change:
    """Returns motors that pull where they should push, and turn the other way."""
    return lambda _tick, wrench: -wrench


def _exchanged(_tick: int, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
    wrench[:2] = wrench[1], -wrench[0]
    return wrench


def exchanging() -> Change:
    """Returns motors whose axes x and y are exchanged, one of them reversed."""
    return _exchanged


def _reversed_torque(_tick: int, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
    wrench[3:] *= -1.0
    return wrench


def _coarse(_since: int, sample: NDArray[np.void]) -> None:
    sample["position"] = 4e-3 * np.round(sample["position"] / 4e-3)


NO_TRIPS = dict.fromkeys(("speed", "turn_speed", "stretch", "angle", "energy"), np.inf)

UNWATCHED = {"swing_energy": np.inf, "runaway_speed": np.inf}

UNGUARDED = {"controller": 0, **NO_TRIPS, **UNWATCHED}

RING_FULL = Fault("ring full for 1 s", _full_ring, "goes on")
"""The one that loses records, after its cause; they are counted."""


def unseen(
    name: str,
    change: Callable[[], Change],
    hand: Hand,
    says: str = "the force was",
    limit: float = 10.0,
) -> Fault:
    """Returns a fault that no energy account sees, because the samples show another one."""
    do = forced(change, hand, limit)
    return Fault(name, do, "lowers", says, UNWATCHED, within=500, energy=0.3)


UNSEEN = (
    unseen("force 3 ms late", late(lambda _: 3), FINGERS),
    unseen("force 5 ms late", late(lambda _: 5), FINGERS),
    unseen("force 10 ms late", late(lambda _: 10), FINGERS),
    unseen("force 20 ms late", late(lambda _: 20), DEFAULT_HAND),
    unseen("force 20 ms late, two fingers", late(lambda _: 20), FINGERS, "taken away"),
    unseen("force later and later", late(lambda k: k // 50), FINGERS),
    unseen("force lags by 5 ms", lagging(5e-3), FINGERS),
    unseen("motor holds for 10 ms", holding(10), FINGERS),
    unseen("motor holds for 50 ms", holding(50), FINGERS),
    unseen("motor holds for 50 ms, arm", holding(50), DEFAULT_HAND),
    unseen("reversed axis", lambda: _reversed_x, DEFAULT_HAND, "taken away"),
    unseen("reversed axis, two fingers", lambda: _reversed_x, FINGERS, "taken away"),
    unseen("frame that rotates by 1 rad/s", turning(1.0), DEFAULT_HAND),
    unseen("frame that rotates by 1 rad/s, fingers", turning(1.0), FINGERS),
    unseen("exchanged axes", lambda: _exchanged, DEFAULT_HAND, "taken away"),
    unseen("exchanged axes, two fingers", lambda: _exchanged, FINGERS, "taken away"),
    unseen("exchanged axes, 5 N", lambda: _exchanged, DEFAULT_HAND, "taken away", 5.0),
    unseen("reversed axis, 5 N", lambda: _reversed_x, FINGERS, "taken away", 5.0),
    unseen("force 20 ms late, 5 N", late(lambda _: 20), FINGERS, limit=5.0),
    unseen("torque 2 ms late", late(lambda _: 2), TWO_FINGERS_TURN),
    unseen("torque 3 ms late", late(lambda _: 3), TWO_FINGERS_TURN),
    unseen("torque 5 ms late", late(lambda _: 5), TWO_FINGERS_TURN),
    unseen("torque 14 ms late", late(lambda _: 14), TWO_FINGERS_TURN),
    unseen("reversed torque", lambda: _reversed_torque, TWO_FINGERS_TURN, "taken away"),
)
"""Faults that only the watch finds (``kernel.swing_watch``)."""


def probed(name: str, change: Callable[[], Change], hand: Hand) -> Fault:
    """Returns a fault of a device from its start on, which is probed before the run."""

    def do(rig: Rig) -> None:
        rig.is_probed = True
        forced(change, hand)(rig)

    return Fault(name, do, "refuses", "nothing to judge", UNWATCHED, cause=0, energy=0.01)


PROBED = (
    probed("reversed axis, probed", lambda: _reversed_x, DEFAULT_HAND),
    probed("reversed axis, two fingers, probed", lambda: _reversed_x, FINGERS),
    probed("exchanged axes, probed", lambda: _exchanged, DEFAULT_HAND),
    probed("exchanged axes, two fingers, probed", lambda: _exchanged, FINGERS),
    probed("reversed torque, probed", lambda: _reversed_torque, TWO_FINGERS_TURN),
)
"""Faults that the probe finds before the force (``demand.probe``)."""

DISK_FULL = Fault("disk full", _full_tmpfs, "stops", "the disk is full", within=600)

PUSHED = 566
"""The tick whose sample shows that the motor gave the hand more than the energy limit."""

FAULTS = (
    Fault("pose that is no number", added("position", np.nan, 0, 0), "trip", "pose is not finite"),
    Fault(
        "infinite quaternion", added("quaternion", 0, np.inf, 0, 0), "trip", "pose is not finite"
    ),
    Fault("60 mm jump", added("position", 0.06, 0, 0), "trip", "jumped", UNGUARDED),
    Fault("half a turn in a tick", added("quaternion", -1, 0, 1, 0), "trip", "jumped", NO_TRIPS),
    Fault("quaternion of the other sign", corrupting(_other_sign), "goes on"),
    Fault("no news for 0.3 s", _frozen, "fades", "", {"stale_ticks": 0}, within=32),
    Fault("half the sample rate", corrupting(lambda k, _s: STALE * (k % 2)), "slips"),
    Fault("20 % of samples lost", _every(0.2), "slips"),
    Fault("50 % of samples lost", _every(0.5), "slips"),
    Fault("stall of 0.2 s, 20 mm deeper", _stall, "slips"),
    Fault(
        "time runs backwards",
        at_the_cause(lambda rig: rig.clock.set_back(0.5)),
        "trip",
        "time ran backwards",
    ),
    Fault("read fails", at_the_cause(_read_fails), "trip", "fault of its own"),
    Fault("read blocks for 1 s", _read_blocks, "slips"),
    Fault("write fails", _write_fails, "trip", "is gone"),
    Fault("write blocks for 1 s", _write_blocks, "slips"),
    Fault("write is cut short", _write_is_cut, "trip", "16 of 48 bytes"),
    Fault("MuJoCo warns: bad velocity", filled("qvel", 2e10), "trip", "diverged"),
    Fault("MuJoCo warns: bad acceleration", filled("qfrc_applied", 1e15), "trip", "diverged"),
    Fault("scene diverges", filled("qvel", np.nan), "trip", "diverged"),
    Fault("motor drives the tool", _motor, "trip", "more than it put in", NO_TRIPS, cause=PUSHED),
    Fault("10 x too stiff, free", stiff(10, None), "slips", "", UNGUARDED),
    Fault("10 x too stiff, in a hand", stiff(10, DEFAULT_HAND), "slips"),
    Fault("edge of the workspace", _edge, "fades", within=150),
    Fault("encoder steps of 50 µm", _quantised, "goes on"),
    Fault("encoder steps of 4 mm", corrupting(_coarse), "lowers", "coarse steps", within=300),
    *UNSEEN,
    *PROBED,
    Fault("error in the user's code", acting(_raise), "stops", "ZeroDivisionError"),
    Fault("recorder killed", acting(_kill_recorder), "stops", "recorder died", within=101),
    Fault("recording may not grow", _fill_disk, "stops", "recorder died", within=600),
    *([DISK_FULL] if can_mount() else []),
    RING_FULL,
    Fault("recorder stopped", _stopped_recorder, "leaves"),
    Fault("disk stalled", _stalled_disk, "leaves"),
    Fault("viewer killed", _watched(signal.SIGKILL), "goes on"),
    Fault("viewer hangs", _watched(signal.SIGSTOP), "goes on"),
    Fault("machine suspended for 5 s", _suspended, "stops", "suspend of the machine"),
    Fault("Ctrl-C", acting(_signal(signal.SIGINT)), "stops", "SIGINT"),
    Fault("SIGTERM", acting(_signal(signal.SIGTERM)), "stops", "SIGTERM"),
    Fault("SIGHUP", acting(_signal(signal.SIGHUP)), "stops", "SIGHUP"),
    Fault("Ctrl-\\", acting(_signal(signal.SIGQUIT)), "stops", "SIGQUIT"),
    Fault("Ctrl-Z", acting(_signal(signal.SIGTSTP)), "stops", "SIGTSTP"),
    Fault("time of day set back", _wall_clock, "goes on"),
)
"""Faults in the order of the table."""
