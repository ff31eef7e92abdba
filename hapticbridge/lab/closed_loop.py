"""Device, hand and scene in one compiled loop, without waiting for a clock.

The loop inlines the functions of the live tick around MuJoCo's C symbol and the simulated device's
exact step. It releases the interpreter lock, so that threads run in parallel. Its records equal
those of ``Bridge.run`` with the same device.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import Method, prepare, resolve_contact_stiffness
from hapticbridge.device import SimulatedDevice
from hapticbridge.device.simulated.dynamics import STATE_DTYPE as DEVICE_DTYPE
from hapticbridge.device.simulated.dynamics import next_sample
from hapticbridge.kernel.codes import State
from hapticbridge.kernel.jit import compiled, compiled_for_threads, direct
from hapticbridge.kernel.mujoco_c import floats, ints, pointer_at, without_timers
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.kernel.state import STATE_DTYPE, BoundKernel
from hapticbridge.kernel.tick import shown_tick, whole_tick
from hapticbridge.run.options import RunSetup
from hapticbridge.run.summary import Ledger
from hapticbridge.scene import Scene
from hapticbridge.theory.sampled_loop import decays

PARTS = 16
"""Number of parts of a period in which jitter is counted. The device is exact between any two of
them. More parts resolve jitter finer and cost a device step each."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Timing errors of ticks, as shares of the period.

    Attributes:
        jitter: Largest lateness as a share of the period, 0 <= jitter < 1. Each tick is late by a
            random number of whole sixteenths, all equally likely up to ``jitter``. Below 1/16 no
            tick is late.
        drops: Share of ticks that are missed, 0 <= drops < 1. The last wrench is then held.
        seed: Seed of the random numbers.
    """

    jitter: float = 0.0
    drops: float = 0.0
    seed: int = 0

    @property
    def is_even(self) -> bool:
        """True if every tick comes on time."""
        return self.jitter < 1 / PARTS and self.drops == 0

    def intervals(self, ticks: int) -> NDArray[np.int64]:
        """Returns the time before each tick in sixteenths of the period, shape (ticks,)."""
        generator = np.random.default_rng(self.seed)
        late = generator.integers(0, int(self.jitter * PARTS) + 1, ticks)
        missed = generator.geometric(1 - self.drops, ticks) - 1 if self.drops else 0
        return np.asarray(PARTS * (1 + missed) + np.diff(late, prepend=0), dtype=np.int64)


LEVER = 0.05
"""Length in m that converts a torque into a force, so that one signal shows both diverge. It is
half the width of a hand. It weighs the two against each other and decides nothing."""

HUGE = 1e5
"""Signal in N at which a run counts as diverged and ends. It is reached before MuJoCo's own limit
on accelerations (1e10 in SI units) warns and resets."""

FLOOR = 1e-6
"""Signal in N that counts as zero. MuJoCo's solver leaves 3e-8 N on a free mass at its default
tolerance, whatever the motion."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopOutcome:
    """Outcome of a run in the closed loop.

    Attributes:
        ticks: Number of completed ticks; fewer than requested if the run diverged.
        is_stable: True if the response to a knock falls from the fourth to the last fifth of the
            run. A tool that was thrown out of contact decays too; ``fault`` names the energy it
            received.
        environment: ``strict``, ``within slack`` or ``active``.
        created: Largest Σ E_k so far at any tick, in J; > 0 where (14) is violated.
        slack_share: Largest share of the slack that was used, without unit.
        first_active: Tick of the first violation of the slack, −1 for none.
        fault: Tick and port of the first fault, ``environment`` or ``device``; None if passive.
            The device is metered only where no coupling law gives the wrench; else see
            ``is_stable``.
        peak_force: Largest force on the tool in N.
        last_force: Largest signal in the last fifth, force and torque over ``LEVER``, in N.
        device_energy: Energy given to the device in J.
        seconds: Processor time of the run in s; the device's part is small.
        depths: Largest penetration of any two bodies at each tick in m, 0 without contact.
        records: ``TICK_DTYPE`` if they were requested; else empty.
    """

    ticks: int
    is_stable: bool
    environment: str
    created: float
    slack_share: float
    first_active: int
    fault: tuple[int, str] | None
    peak_force: float
    last_force: float
    device_energy: float
    seconds: float
    depths: NDArray[np.float64]
    records: NDArray[np.void]


class ClosedLoop:
    """A scene for runs of the closed loop; use one per thread.

    Args:
        scene: A loaded scene; copied, so that runs do not disturb it or each other.
    """

    def __init__(self, scene: Scene) -> None:
        model = copy.copy(scene.model)
        self.scene = replace(scene, model=model, data=copy.copy(scene.data))

    def run(
        self,
        device: SimulatedDevice,
        coupling: Coupling,
        method: Method,
        *,
        period: float = 1e-3,
        ticks: int = 2000,
        substeps: int = 1,
        scene_ticks: int = 0,
        knock: NDArray[np.float64] | None = None,
        timing: Timing | None = None,
        keep_records: bool = False,
    ) -> LoopOutcome:
        """Runs the loop from rest.

        Args:
            device: Device and hand; restarted.
            coupling: K and B.
            method: Rendering method.
            period: T in s.
            ticks: Number of ticks, >= 50: a fifth of them is the window in which a decay is looked
                for, and ten samples are the fewest that show one.
            substeps: MuJoCo steps per tick.
            scene_ticks: Ticks between two results of a slower scene; 0 steps it in every tick.
            knock: Displacement of the device before the first tick, shape (6,), in m and rad.
            timing: Late and missed ticks; None: every one on time.
            keep_records: True returns the records.

        Raises:
            HapticBridgeError: A value is out of range, or the method cannot render the scene.
        """
        scene = self.scene
        scene_period = max(scene_ticks, 1) * period
        effective = prepare(scene, coupling, scene_period, substeps, method, warns=False)
        is_even = timing is None or timing.is_even
        sample = np.zeros(1, SAMPLE_DTYPE)
        sample[:] = device.start(period, 1 if is_even else PARTS)
        setup = RunSetup(
            scene=scene,
            coupling=coupling,
            method=method,
            period=period,
            info=device.info,
            substeps=substeps,
            scene_ticks=scene_ticks,
            contact_stiffness=resolve_contact_stiffness(method, coupling, None),
        )
        parameters = setup.parameters(sample, effective)
        binding = slow = BoundKernel(scene.model, scene.data, parameters)
        if scene_ticks:
            slow = BoundKernel(scene.model, scene.data, parameters.of_scene, binding)
        if knock is not None:
            device.displace(knock)
        intervals = (
            np.ones(ticks, np.int64) if timing is None or is_even else timing.intervals(ticks)
        )
        records = np.zeros(ticks if keep_records else 0, TICK_DTYPE)
        signal, depths, most = np.zeros(ticks), np.zeros(ticks), np.zeros(1)
        outputs, began = (signal, depths, most, records), time.thread_time()
        with without_timers():
            done = _machine_code()(
                (binding.state, slow.state),
                (binding.row, slow.row, np.zeros(1, SAMPLE_DTYPE)),
                scene_ticks,
                *device.stepper,
                sample,
                intervals,
                *outputs,
            )
        seconds = time.thread_time() - began
        state, ledger = binding.state, Ledger.from_state(binding.state)
        last = signal[-(ticks // 5) :] if done == ticks else signal[:done]
        return LoopOutcome(
            ticks=done,
            is_stable=decays(signal[:done], ticks, FLOOR),
            environment=ledger.environment,
            created=float(most[0]),
            slack_share=ledger.slack_share,
            first_active=int(state["energy"]["first_active"][0]),
            fault=ledger.fault,
            peak_force=float(state["loop"]["peak_tool_force"][0]),
            last_force=float(last.max(initial=0.0)),
            device_energy=ledger.device_energy,
            seconds=seconds,
            depths=depths[:done],
            records=records[: min(done, records.size)],
        )


@compiled_for_threads
def _run(
    states: tuple[NDArray[np.void], NDArray[np.void]],
    own: tuple[NDArray[np.void], NDArray[np.void], NDArray[np.void]],
    scene_ticks: int,
    devices: NDArray[np.void],
    motion: NDArray[np.float64],
    sample: NDArray[np.void],
    intervals: NDArray[np.int64],
    signal: NDArray[np.float64],
    depths: NDArray[np.float64],
    most: NDArray[np.float64],
    records: NDArray[np.void],
) -> int:
    """Runs one tick per interval; returns how many were completed."""
    state, row = states[0], own[0]
    s, written = state[0], devices[0].written
    for k in range(intervals.size):
        # the first sample is the start: no time passes before it
        for _ in range(intervals[k] if k > 0 else 1):
            next_sample(devices, motion, sample)
        elapsed = devices[0].period * intervals[k]
        if scene_ticks > 0:
            is_done = shown_tick(states, own, sample, elapsed, k % scene_ticks == 0)
        else:
            is_done = whole_tick(state, sample, row, elapsed)
        if not is_done:
            return k
        wrench = row[0].wrench_on_device
        for i in range(6):
            written[i] = wrench[i]
        w = row[0].wrench_on_tool
        force = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
        torque = w[3] * w[3] + w[4] * w[4] + w[5] * w[5]
        signal[k] = np.sqrt(force + torque / LEVER**2)
        depths[k] = _deepest(s)
        most[0] = max(most[0], s.energy.environment_energy)
        if records.size > 0:
            records[k] = row[0]
        if not signal[k] < HUGE:
            return k + 1 if k + 1 < intervals.size else k
    return int(intervals.size)


@compiled
def _deepest(s: State) -> float:
    mj, depth = s.mj, 0.0
    contacts = pointer_at(mj.contact)
    for c in range(ints(mj.ncon, 1)[0]):
        contact = contacts + c * mj.contact_size
        if ints(contact + mj.contact_row, 1)[0] >= 0:
            depth = max(depth, -floats(contact + mj.contact_distance, 1)[0])
    return depth


@cache
def _machine_code() -> Callable[..., int]:
    """Returns the compiled loop. It is cached, because looking up the types takes a millisecond."""
    none = np.zeros(0)
    return direct(
        _run,
        (np.zeros(1, STATE_DTYPE), np.zeros(1, STATE_DTYPE)),
        (np.zeros(1, TICK_DTYPE), np.zeros(1, TICK_DTYPE), np.zeros(1, SAMPLE_DTYPE)),
        0,
        np.zeros(1, DEVICE_DTYPE),
        np.empty((0, 8)),
        np.zeros(1, SAMPLE_DTYPE),
        np.zeros(0, np.int64),
        none,
        none,
        none,
        np.zeros(0, TICK_DTYPE),
    )
