"""Contact settings on two rigs: one mass on a wall, and a peg that jams in its hole."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.device.trajectory import read_motion
from hapticbridge.guard import UNLIMITED
from hapticbridge.lab.closed_loop import ClosedLoop
from hapticbridge.lab.maps import base
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import scene_path
from hapticbridge.scene.contacts import ContactNumbers, contact_numbers

RECORDED = (3.5, 6.0)
"""Part of the recorded hand in s: into the hole, to the bottom, and pressing to the sides."""


@cache
def tapping(frequency: float) -> Motion:
    """Returns the path of a hand that taps at a frequency in Hz.

    Its target lies up to 6 mm behind the wall's face.
    """
    return base.swinging(0.008, frequency, duration=1.0, count=301)


@cache
def random_taps(seed: int) -> tuple[Motion, Hand]:
    """Returns a random hand that taps: 1 to 6 Hz, 0 to 6 mm behind the wall's face, 1 s."""
    random = np.random.default_rng(seed)
    size, frequency = random.uniform(5e-3, 8e-3), random.uniform(1.0, 6.0)
    hand = Hand(stiffness=random.uniform(800, 3000), damping=random.uniform(5, 30))
    return base.swinging(size, frequency, duration=1.0, count=301), hand


@cache
def recorded() -> tuple[Motion, Hand]:
    """Returns the scene's recorded hand while it is in the hole, with the grip of a firm hand."""
    table = read_motion(scene_path("peg_in_hole").with_suffix(".csv")).table
    rows = (table[:, 0] >= RECORDED[0]) & (table[:, 0] <= RECORDED[1])
    path = Motion(table[rows, 0], table[rows, 1:4], table[rows, 4:]).relative()
    return path, Hand(
        stiffness=2000.0, damping=25.0, rotational_stiffness=5.0, rotational_damping=0.05
    )


@cache
def random_push(seed: int) -> tuple[Motion, Hand]:
    """Returns a random firm hand and its path.

    Its target moves by up to 8 mm and 0.15 rad, at 0.5 to 3 Hz.
    """
    random = np.random.default_rng(seed)
    time = np.linspace(0.0, 2.0, 81)

    def smooth(size: float) -> NDArray[np.float64]:
        frequency, phase = random.uniform(0.5, 3.0, 5), random.uniform(0, 2 * np.pi, 5)
        angle = 2 * np.pi * frequency[:, None] * time + phase[:, None]
        waves = random.normal(size=5) @ (np.sin(angle) - np.sin(phase)[:, None])
        return np.asarray(size * waves / np.abs(waves).max())

    position = np.column_stack([smooth(8e-3) for _ in range(3)])
    turn = Rotation.from_rotvec(np.column_stack([smooth(0.15), smooth(0.15), smooth(0.1)]))
    hand = Hand(
        mass=random.uniform(0.2, 0.8),
        stiffness=random.uniform(800, 3000),
        damping=random.uniform(5, 30),
        rotational_stiffness=random.uniform(1, 5),
        rotational_damping=random.uniform(0.01, 0.05),
    )
    return Motion(time, position, turn.as_quat(canonical=True)[:, [3, 0, 1, 2]]), hand


PERIOD = 1e-3
"""Period T in s of every run of the map."""

SHIPPED_SOLIMP = (0.9, 0.95, 0.001)
"""Impedance d₀, d_w and width in m of the shipped scenes."""


@dataclass(frozen=True, slots=True)
class Treatment:
    """A treatment of a contact by MuJoCo.

    Attributes:
        solref: (timeconst in s, dampratio) or (−k in 1/s², −b in 1/s).
        solimp: d₀, d_w and width in m.
        cone: ``elliptic`` or ``pyramidal``.
        diagexact: True for the exact diagonal of the constraint inertia.
        refsafe: True if MuJoCo may replace rows that the step cannot resolve.
        speculative: True if contacts are added before impact.
        condim: 1 removes friction; else 3.
        impratio: Ratio of friction to normal impedance.
        margin: Distance in m at which contacts begin.
        substeps: MuJoCo steps per tick.
        method: Rendering method.
    """

    solref: tuple[float, float] = (0.002, 1.0)
    solimp: tuple[float, float, float] = SHIPPED_SOLIMP
    cone: str = "elliptic"
    diagexact: bool = True
    refsafe: bool = True
    speculative: bool = False
    condim: int = 3
    impratio: float = 1.0
    margin: float = 0.0
    substeps: int = 1
    method: str = "implicit"

    @property
    def relaxation(self) -> float:
        """Time constant τ in s of the contact's return after a push, b/k."""
        return self.numbers.relaxation * self._step

    @property
    def static_depth(self) -> float:
        """Static penetration relative to the shipped settings: (1 − d) d_w²/(d² k)."""
        depth = self._depth(self.numbers, self.solimp[1], self._step)
        shipped = contact_numbers((0.002, 1.0), SHIPPED_SOLIMP, PERIOD)
        return depth / self._depth(shipped, SHIPPED_SOLIMP[1], PERIOD)

    @staticmethod
    def _depth(numbers: ContactNumbers, last: float, step: float) -> float:
        impedance = numbers.impedance
        return (1 - impedance) * (last * numbers.resolved * step / impedance) ** 2

    @property
    def numbers(self) -> ContactNumbers:
        """Input of the rule for this setting."""
        return contact_numbers(self.solref, self.solimp, self._step, refsafe=self.refsafe)

    @property
    def is_ruled(self) -> bool:
        """True if the rule covers it: implicit, elliptic, with the exact diagonal."""
        return self.method == "implicit" and self.cone == "elliptic" and self.diagexact

    @property
    def _step(self) -> float:
        return PERIOD / self.substeps

    def apply(self, model: mujoco.MjModel, friction: float) -> None:
        """Sets a model's contacts through MuJoCo's global override; needs no compilation."""
        option = model.opt
        option.o_solref[:] = self.solref
        option.o_solimp[:3] = self.solimp
        option.o_friction[:2] = friction
        option.o_margin = self.margin
        option.impratio = self.impratio
        model.geom_condim[:] = self.condim
        elliptic, pyramidal = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtCone.mjCONE_PYRAMIDAL
        option.cone = int(elliptic if self.cone == "elliptic" else pyramidal)
        enable, disable = mujoco.mjtEnableBit, mujoco.mjtDisableBit
        option.enableflags = _with_bits(
            option.enableflags,
            {
                enable.mjENBL_OVERRIDE: True,
                enable.mjENBL_DIAGEXACT: self.diagexact,
                enable.mjENBL_SPECULATIVE: self.speculative,
            },
        )
        option.disableflags = _with_bits(
            option.disableflags, {disable.mjDSBL_REFSAFE: not self.refsafe}
        )


def _with_bits(flags: int, bits: Mapping[object, bool]) -> int:
    for bit, is_set in bits.items():
        number = int(bit)  # type: ignore[call-overload]
        flags = flags | number if is_set else flags & ~number
    return flags


SHIPPED = "as shipped: 0.002 1"

TREATMENTS: Mapping[str, Treatment] = {
    SHIPPED: Treatment(),
    "pyramidal cone": Treatment(cone="pyramidal"),
    "diagexact off": Treatment(diagexact=False),
    "refsafe off, 0.0002 1": Treatment((0.0002, 1.0), refsafe=False),
    "speculative contacts": Treatment(speculative=True),
    "impratio 10": Treatment(impratio=10.0),
    "margin 0.1 mm": Treatment(margin=1e-4),
    "no friction (condim 1)": Treatment(condim=1),
    "impedance 0.5 throughout": Treatment(solimp=(0.5, 0.5, 0.001)),
    "impedance 0.99 throughout": Treatment(solimp=(0.99, 0.99, 0.001)),
    "impedance 0.999 throughout": Treatment(solimp=(0.999, 0.999, 0.001)),
    "0.002 2, impedance 0.95": Treatment((0.002, 2.0), (0.95, 0.95, 0.001)),
    "0.002 2, impedance 0.99": Treatment((0.002, 2.0), (0.99, 0.99, 0.001)),
    "0.004 2, impedance 0.99": Treatment((0.004, 2.0), (0.99, 0.99, 0.001)),
    "0.004 8, impedance 0.99": Treatment((0.004, 8.0), (0.99, 0.99, 0.001)),
    "0.000125 8, imp. 0.999": Treatment((0.000125, 8.0), (0.999, 0.999, 0.001)),
    "0.002 1, imp. 0.9 to 0.99": Treatment(solimp=(0.9, 0.99, 0.001)),
    "damped, imp. 0 to 0.99 at once": Treatment((0.0005, 8.0), (0.0001, 0.99, 0.00001)),
    "0.0005 4": Treatment((0.0005, 4.0)),
    "0.00025 8": Treatment((0.00025, 8.0)),
    "timeconst T: 0.001 1": Treatment((0.001, 1.0)),
    "0.003 1": Treatment((0.003, 1.0)),
    "0.002 1.5": Treatment((0.002, 1.5)),
    "MuJoCo's default 0.02 1": Treatment((0.02, 1.0)),
    "direct -20000 -50": Treatment((-20_000.0, -50.0)),
    "direct -1000000 -500": Treatment((-1e6, -500.0)),
    "4 substeps, 0.002 1": Treatment(substeps=4),
    "4 substeps, 0.0005 4": Treatment((0.0005, 4.0), substeps=4),
    "implicitfast": Treatment(method="implicitfast"),
    "damped: 0.0005 8": Treatment((0.0005, 8.0)),
    "default 0.02 1, pyramidal": Treatment((0.02, 1.0), cone="pyramidal"),
    "damped, pyramidal cone": Treatment((0.0005, 8.0), cone="pyramidal"),
    "damped hard: 0.00002 100": Treatment((0.00002, 100.0)),
}
"""Treatments of the peg's contact in the search at 1 kHz, all but one under ``implicit``."""


DEVICE_MARGIN = 1.25
"""Ratio of the device damping to KT/2 + B of (6), without unit. The device never limits these
runs."""

WALL_DAMPING = 2.0
"""Damping B on the wall, in N s/m."""

PEG_DAMPING = 0.5
"""Damping B on the peg, in N s/m; low, so that the coupling hides little of the created energy."""

PEG_ROTATION = (1e-3, 5e-4)
"""Ratio K_r/K in m²/rad, and B_r in N m s/rad: the README's 2 N m/rad at 2000 N/m."""

PEG_START = 0.005
"""Height of the peg's centre at the start in m: 25 mm of the 60 mm peg stand in the hole."""

DEPTH_EVERY = 20
"""Ticks in contact between two samples of the depth. The peak of a push lasts longer, and every
sample costs as much as five ticks."""

WALL_RUNS = tuple(itertools.product((0.01, 0.05, 0.2), (0, 1)))
"""Cases of the wall, tool mass in kg and hand, the most often active first."""

PEG_RUNS = tuple(itertools.product((0.03, 0.1), (0.0, 0.42), (1, 2)))
"""Cases of the peg, tool mass in kg, friction and hand (0 is the recorded one, others are seeds),
the most often active first."""


@dataclass(frozen=True, slots=True)
class ContactRun:
    """One closed loop with contact.

    Attributes:
        environment: The ledger's verdict.
        created: Largest Σ E_k in J.
        slack_share: Largest share of the slack that was used.
        first_active: Tick at which the environment exceeded the slack, −1 for none.
        peak_force: Largest force in N.
        depth: Largest penetration in m.
    """

    environment: str
    created: float
    slack_share: float
    first_active: int
    peak_force: float
    depth: float


def summary(runs: Sequence[ContactRun]) -> dict[str, float | int]:
    """Returns the number of runs per verdict, with their worst and median values."""
    verdicts = [run.environment for run in runs]
    failed = [run.first_active for run in runs if run.first_active >= 0]
    depths = [run.depth for run in runs]
    return {
        "runs": len(runs),
        "strict": verdicts.count("strict"),
        "within_slack": verdicts.count("within slack"),
        "active": verdicts.count("active"),
        "created": max(run.created for run in runs),
        "slack_share": max(run.slack_share for run in runs),
        "first_active": min(failed, default=-1),
        "peak_force": max(run.peak_force for run in runs),
        "median_depth": float(np.median(depths)),
        "largest_depth": max(depths),
    }


def until_active(runs: Iterable[ContactRun]) -> list[ContactRun]:
    """Returns runs up to the first active one; no later run can make their verdict worse.

    A lazy iterable makes no run after that one.
    """
    made = []
    for run in runs:
        made.append(run)
        if run.environment == "active":
            break
    return made


def wall_runs(
    treatment: Treatment, stiffness: float, cases: Iterable[tuple[float, int]] = WALL_RUNS
) -> Iterator[ContactRun]:
    """Runs masses (kg) against a wall with hands (0 slow and deep, 1 fast) at K in N/m.

    Each run is made on demand.
    """
    loop = base.loop_in("virtual_wall", "contact")
    coupling = Coupling(stiffness, WALL_DAMPING, 1.0, 1e-3)  # the rail prevents rotation
    for mass, hand in cases:
        treatment.apply(loop.scene.model, 0.0)
        set_mass(loop, "tool", mass)
        device = firm_device(
            coupling, tapping((3.0, 6.0)[hand]), Hand(stiffness=2000.0, damping=25.0)
        )
        records, run = run_once(loop, device, coupling, treatment, 1000)
        # the face is 10 mm from where the tool's surface starts
        depth = max(0.0, float(records["tool_position"][:, 0].max()) - 0.01)
        yield replace(run, depth=depth)


def peg_runs(
    treatment: Treatment,
    stiffness: float,
    cases: Iterable[tuple[float, float, int]] = PEG_RUNS,
) -> Iterator[ContactRun]:
    """Runs pegs by mass (kg), friction and hand in the hole at K in N/m, as ``wall_runs`` does."""
    loop = base.loop_in("peg_in_hole", "contact", start_in_hole)
    for mass, friction, hand in cases:
        treatment.apply(loop.scene.model, friction)
        set_mass(loop, "peg", mass)
        device, coupling = peg_device(stiffness, hand)
        records, run = run_once(loop, device, coupling, treatment, ticks_of(device))
        yield replace(run, depth=deepest(loop, records))


def peg_device(stiffness: float, hand: int) -> tuple[SimulatedDevice, Coupling]:
    """Returns a hand (0 is the recorded one, others are seeds) and the coupling by K in N/m."""
    per_k, rotational_damping = PEG_ROTATION
    coupling = Coupling(stiffness, PEG_DAMPING, per_k * stiffness, rotational_damping)
    path, holder = recorded() if hand == 0 else random_push(hand)
    return firm_device(coupling, path, holder), coupling


def ticks_of(device: SimulatedDevice) -> int:
    """Returns the number of ticks of a hand's path."""
    return int((device.info.duration or 0.0) / PERIOD)


def run_once(
    loop: ClosedLoop,
    device: SimulatedDevice,
    coupling: Coupling,
    treatment: Treatment,
    ticks: int,
) -> tuple[NDArray[np.void], ContactRun]:
    """Returns a run's records, and its outcome without the depth."""
    outcome = loop.run(
        device,
        coupling,
        METHODS[treatment.method],
        period=PERIOD,
        ticks=ticks,
        substeps=treatment.substeps,
        keep_records=True,
    )
    run = ContactRun(
        outcome.environment,
        outcome.created,
        outcome.slack_share,
        outcome.first_active,
        outcome.peak_force,
        0.0,
    )
    return outcome.records, run


def firm_device(coupling: Coupling, path: Motion, hand: Hand) -> SimulatedDevice:
    """Returns a hand with a device that bears the coupling with a margin."""
    half = PERIOD / 2
    return SimulatedDevice(
        damping=DEVICE_MARGIN * (coupling.stiffness * half + coupling.damping),
        rotational_damping=DEVICE_MARGIN
        * (coupling.rotational_stiffness * half + coupling.rotational_damping),
        hand=hand,
        path=path,
        force_limit=UNLIMITED.force,
        torque_limit=UNLIMITED.torque,
    )


def set_mass(loop: ClosedLoop, body: str, mass: float) -> None:
    """Sets the mass of a tool in kg."""
    base.set_tool_mass(loop.scene.model, body, mass)
    mujoco.mj_setConst(loop.scene.model, loop.scene.data)


def start_in_hole(model: mujoco.MjModel) -> None:
    """Lets runs of ``peg_in_hole`` start with the peg in the hole."""
    model.key_qpos[0, 2] = PEG_START


def deepest(loop: ClosedLoop, records: NDArray[np.void]) -> float:
    """Returns the largest penetration in m, from the poses that were recorded."""
    model, data = loop.scene.model, loop.scene.data
    depth = 0.0
    for row in records[records["contacts"] > 0][::DEPTH_EVERY]:
        data.qpos[:3], data.qpos[3:7] = row["tool_position"], row["tool_quaternion"]
        mujoco.mj_fwdPosition(model, data)
        if data.ncon:
            depth = max(depth, -float(data.contact.dist.min()))
    return depth
