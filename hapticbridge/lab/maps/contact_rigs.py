"""Rigs with contact: tools that jam, tap, slide and stick, and shipped scenes, in random hands."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial

import mujoco
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import UNLIMITED
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.device.motion_file import read_motion
from hapticbridge.device.simulated.device import scene_hand
from hapticbridge.lab.closed_loop import LoopOutcome
from hapticbridge.lab.maps import base
from hapticbridge.lab.methods import METHODS
from hapticbridge.scene import Scene, load_scene, scene_path

SHIPPED_SOLIMP = (0.9, 0.95, 0.001)
"""Impedance d₀, d_w and width in m of the shipped scenes."""

# The scenes

_FREE = "<freejoint/>"
_PLANAR = (
    '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    '<joint type="hinge" axis="0 1 0"/>'
)


def _scene(
    tool: str, rest: str, start: str = "0 0 0", joints: str = _FREE, gravity: float = 0.0
) -> str:
    return f"""
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 {-gravity}" cone="elliptic"><flag diagexact="enable"/></option>
  <worldbody>
    <body name="tool" pos="{start}">{joints}<geom type="box" size="{tool}" mass="0.1"/>
      <site name="grip"/>
    </body>{rest}
  </worldbody>
</mujoco>"""


def _box(size: str, place: str, rest: str = "") -> str:
    return f'<geom type="box" size="{size}" pos="{place}" {rest}/>'


def _hole(clearance: float, *, is_planar: bool = False) -> str:
    """Returns a square peg of 20 mm in a hole 60 mm deep with a clearance in m a side."""
    half = 0.01 + clearance
    out = half + 0.02
    walls = [_box(f"0.02 {out + 0.02} 0.03", f"{side * out} 0 -0.03") for side in (1, -1)]
    if not is_planar:
        walls += [_box(f"{half} 0.02 0.03", f"0 {side * out} -0.03") for side in (1, -1)]
    rest = "".join([*walls, _box("0.03 0.03 0.005", "0 0 -0.065")])
    return _scene("0.01 0.01 0.03", rest, "0 0 -0.01", _PLANAR if is_planar else _FREE)


def _groove() -> str:
    """Returns a block above a groove of two inclined plates."""
    plates = [
        _box("0.005 0.04 0.03", f"{side * 0.0195} 0 -0.012", f'euler="0 {side * 0.3927} 0"')
        for side in (1, -1)
    ]
    return _scene("0.01 0.02 0.01", "".join(plates), "0 0 0.006")


def _pile() -> str:
    """Returns a block beside two others on each other, which it pushes over a floor."""
    blocks = [
        f'<body pos="0 0 {0.01 + 0.02 * i}"><freejoint/>'
        f'<geom type="box" size="0.02 0.02 0.01" mass="{0.1 - 0.05 * i}"/></body>'
        for i in range(2)
    ]
    rest = _box("0.15 0.15 0.01", "0 0 -0.01") + "".join(blocks)
    return _scene("0.01 0.01 0.01", rest, "-0.0305 0 0.015", gravity=9.81)


# The hands

DURATION = 2.5
"""Duration of a random hand in s."""


def wandering(
    random: Generator,
    size: tuple[float, float, float] = (4e-3, 4e-3, 4e-3),
    angle: float = 0.08,
    *,
    fastest: float = 6.0,
    approach: float = 0.0,
    tap: float = 0.0,
) -> Motion:
    """Returns a random path of sums of sines.

    Args:
        random: Source of the random numbers.
        size: Amplitude per axis in m.
        angle: Amplitude of each component of the rotation vector in rad.
        fastest: Largest frequency in Hz; the smallest is 0.3 Hz.
        approach: Descent in m within the first 0.3 s.
        tap: Amplitude in m of 3 Hz along the vertical.
    """
    time = np.arange(0.0, DURATION + 0.001, 0.002)

    def smooth(amplitude: float) -> NDArray[np.float64]:
        frequency, phase = random.uniform(0.3, fastest, 5), random.uniform(0, 2 * np.pi, 5)
        weight = random.uniform(0.2, 1.0, 5) / np.sqrt(frequency)
        angles = 2 * np.pi * frequency[:, None] * time + phase[:, None]
        wave = (weight / weight.sum()) @ np.sin(angles)
        return np.asarray(2 * amplitude * (wave - wave[0]) * np.minimum(time / 0.1, 1.0))

    place = np.column_stack([smooth(amplitude) for amplitude in size])
    place[:, 2] -= approach * np.minimum(time / 0.3, 1.0)
    place[:, 2] += tap * (np.cos(6 * np.pi * time) - 1.0)
    turn = Rotation.from_rotvec(np.column_stack([smooth(angle) for _ in range(3)]))
    return Motion(time, place, turn.as_quat(canonical=True, scalar_first=True))


def _firm(random: Generator) -> Hand:
    """Returns a random firm hand."""
    return Hand(
        mass=random.uniform(0.2, 0.8),
        stiffness=random.uniform(800, 3000),
        damping=random.uniform(5, 30),
        rotational_stiffness=random.uniform(1, 5),
        rotational_damping=random.uniform(0.01, 0.05),
    )


def _tapping(random: Generator) -> Motion:
    """Returns a random hand along x that taps: 1 to 6 Hz, up to 6 mm behind the wall's face."""
    size, frequency = random.uniform(5e-3, 8e-3), random.uniform(1.0, 6.0)
    return base.swinging(size, frequency, duration=1.0, count=301)


def _astray(name: str, random: Generator) -> Motion:
    """Returns a shipped scene's own path, with random deviations of 2 mm and 0.1 rad."""
    own = read_motion(scene_path(name).with_suffix(".csv")).relative().table
    stray = wandering(random, (2e-3, 2e-3, 2e-3), 0.1, fastest=2.0).table
    # back and forth through the deviations, so that they last as long as the path
    index = (500 * own[:, 0]).astype(int) % (2 * len(stray) - 2)
    stray = stray[np.where(index < len(stray), index, 2 * len(stray) - 2 - index)]
    turn = Rotation.from_quat(stray[:, 4:], scalar_first=True) * Rotation.from_quat(
        own[:, 4:], scalar_first=True
    )
    quaternions = turn.as_quat(canonical=True, scalar_first=True)
    return Motion(own[:, 0], own[:, 1:4] + stray[:, 1:4], quaternions)


# The rigs


@dataclass(frozen=True, slots=True)
class Rig:
    """A scene with a random hand.

    Attributes:
        load: Returns the scene.
        path: Returns a hand's path from random numbers.
        is_shipped: True for a shipped scene with its own mass, friction and hand.
        damping: Damping B of the coupling in N s/m; low, so that it hides little created energy.
    """

    load: Callable[[], Scene]
    path: Callable[[Generator], Motion]
    is_shipped: bool = False
    damping: float = 0.5


def _made(text: str, path: Callable[[Generator], Motion]) -> Rig:
    return Rig(partial(base.scene_of, text), path)


def _shipped(name: str) -> Rig:
    return Rig(partial(load_scene, name), partial(_astray, name), is_shipped=True)


_dragged = partial(wandering, size=(0.02, 0.02, 1.5e-3), angle=0.03, fastest=2.5, approach=1.5e-3)
_pushed = partial(wandering, size=(3e-3, 4e-3, 4e-3), angle=0.1, approach=8e-3)
_shoved = partial(wandering, size=(0.012, 6e-3, 8e-3), angle=0.1, fastest=3.0)
_tapped = partial(wandering, size=(4e-3, 4e-3, 6e-3), angle=0.15, approach=6e-3, tap=4e-3)
_FLOOR = _box("0.1 0.1 0.01", "0 0 -0.02")

PEG_CLEARANCE = 2e-4
"""Clearance in m a side of the rig ``peg``."""

RIGS: Mapping[str, Rig] = {
    "peg": _made(_hole(PEG_CLEARANCE), wandering),
    "tight peg": _made(_hole(5e-5), wandering),
    "planar peg": _made(_hole(2e-4, is_planar=True), wandering),
    "tight planar peg": _made(_hole(5e-5, is_planar=True), wandering),
    "taps": _made(_scene("0.01 0.01 0.02", _box("0.05 0.05 0.01", "0 0 -0.04")), _tapped),
    "slide": _made(_scene("0.015 0.015 0.01", _FLOOR, "0 0 0.0001", gravity=9.81), _dragged),
    "wedge": _made(_groove(), _pushed),
    "stack": _made(_pile(), _shoved),
    **{name: _shipped(name) for name in ("lock", "hex_key", "ratchet", "bench_pliers", "drawer")},
    "wall": Rig(partial(load_scene, "virtual_wall"), _tapping, damping=2.0),
}
"""Rigs by name. The peg has a clearance of 0.2 mm a side, the tight one 0.05 mm. ``slide`` is
dragged over a floor and sticks and slips, ``wedge`` pushed into a groove; ``stack`` pushes two
blocks."""

COMPARED_RIGS = tuple(name for name in RIGS if name != "wall")
"""Rigs on which treatments are compared; the wall is for the settings of the grid."""

MASSES = (0.03, 0.3)
"""Tool masses in kg. They, the stiffnesses and the frictions are the ends of a range."""

STIFFNESSES = (1000.0, 6000.0)
"""Stiffnesses K in N/m."""

FRICTIONS = (0.0, 0.4)
"""Coefficients of friction."""

ROTATION = (1e-3, 5e-4)
"""Ratio K_r/K in m²/rad, and B_r in N m s/rad: the README's 2 N m/rad at 2000 N/m."""

DEVICE_MARGIN = 1.25
"""Ratio of the device damping to KT/2 + B of (6), without unit. The device never limits these
runs."""


@dataclass(frozen=True, slots=True)
class Case:
    """A run on a rig.

    Attributes:
        rig: Name of the rig.
        stiffness: K in N/m.
        mass: Mass of the tool in kg; a shipped scene has its own.
        friction: Coefficient of friction, 0 for none; a shipped scene has its own.
        hand: Seed of the random hand; 0 on a shipped scene is its own path.
    """

    rig: str
    stiffness: float = 2400.0
    mass: float = 0.1
    friction: float = 0.4
    hand: int = 1


@dataclass(frozen=True, slots=True)
class Treatment:
    """A treatment of the contacts.

    Attributes:
        contact: ``rigid``, or ``scene`` for MuJoCo's with the settings below.
        method: Rendering method.
        solref: (timeconst in s, dampratio) or (−k in 1/s², −b in 1/s).
        cone: ``elliptic`` or ``pyramidal``.
        period: T in s.
        substeps: MuJoCo steps per tick.
    """

    contact: str = "scene"
    method: str = "implicit"
    solref: tuple[float, float] = (0.002, 1.0)
    cone: str = "elliptic"
    period: float = base.PERIOD
    substeps: int = 1

    def apply(self, scene: Scene, case: Case) -> None:
        """Sets contacts, mass and friction of a rig that is no shipped scene."""
        model = scene.model
        scene.set_contact(is_rigid=False)
        if RIGS[case.rig].is_shipped:
            return
        model.geom_solref[:] = self.solref
        model.geom_solimp[:, :3] = SHIPPED_SOLIMP
        model.geom_friction[:, :] = case.friction, 0.0, 0.0
        model.geom_condim[:] = 3 if case.friction > 0 else 1
        elliptic, pyramidal = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtCone.mjCONE_PYRAMIDAL
        model.opt.cone = int(elliptic if self.cone == "elliptic" else pyramidal)
        base.set_tool_mass(model, "tool", case.mass)
        mujoco.mj_setConst(model, scene.data)


WORST = Case("peg", 6000.0, 0.03, 0.0, 5)
"""Hardest case: a light peg without friction, whose contacts as shipped create more than the
slack."""

SCENE, RIGID = Treatment(), Treatment("rigid")

TREATMENTS: Mapping[str, Treatment] = {
    "as shipped, 0.002 1": SCENE,
    "damped, 0.0005 8": Treatment(solref=(0.0005, 8.0)),
    "MuJoCo's default, 0.02 1": Treatment(solref=(0.02, 1.0)),
    "rigid": RIGID,
    "rigid, lossless": Treatment("rigid", "lossless"),
}
"""Treatments that the map compares on every rig; the numbers are ``solref``. Shipped scenes have
their own ``solref``, which is the first."""


@dataclass(frozen=True, slots=True)
class ContactRun:
    """One closed loop with contact.

    Attributes:
        environment: The ledger's verdict.
        created: Largest Σ E_k in J.
        slack_share: Largest share of the slack that was used.
        first_active: Tick at which the environment exceeded the slack, −1 for none.
        peak_force: Largest force in N.
        median_depth: Median penetration of the ticks with contact in m.
        depth: Largest penetration in m.
        cost: Processor time of a tick in s.
    """

    environment: str
    created: float
    slack_share: float
    first_active: int
    peak_force: float
    median_depth: float
    depth: float
    cost: float = field(compare=False)


def summary(runs: Sequence[ContactRun]) -> dict[str, float | int]:
    """Returns the number of runs per verdict, with their worst and median values."""
    verdicts = [run.environment for run in runs]
    failed = [run.first_active for run in runs if run.first_active >= 0]
    return {
        "runs": len(runs),
        "strict": verdicts.count("strict"),
        "within_slack": verdicts.count("within slack"),
        "active": verdicts.count("active"),
        "created": max(run.created for run in runs),
        "slack_share": max(run.slack_share for run in runs),
        "first_active": min(failed, default=-1),
        "peak_force": max(run.peak_force for run in runs),
        "median_depth": float(np.median([run.median_depth for run in runs])),
        "largest_depth": max(run.depth for run in runs),
        "cost": float(np.median([run.cost for run in runs])),
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


def run_cases(treatment: Treatment, cases: Iterable[Case]) -> Iterator[ContactRun]:
    """Runs a treatment through cases, each on demand."""
    for case in cases:
        yield contact_run(run_case(treatment, case))


def contact_run(outcome: LoopOutcome) -> ContactRun:
    """Returns the summary of one outcome."""
    deep = outcome.depths[outcome.depths > 0]
    return ContactRun(
        outcome.environment,
        outcome.created,
        outcome.slack_share,
        outcome.first_active,
        outcome.peak_force,
        float(np.median(deep)) if deep.size else 0.0,
        float(deep.max(initial=0.0)),
        outcome.seconds / max(outcome.ticks, 1),
    )


def worst_peg() -> Scene:
    """Loads the rig ``peg`` for ``WORST``, with mass and contact settings written in its file.

    A recording holds the file, and its audit compiles it again.
    """
    solref, solimp = (" ".join(map(repr, numbers)) for numbers in (SCENE.solref, SHIPPED_SOLIMP))
    setting = f'<default><geom solref="{solref}" solimp="{solimp}" condim="1"/></default>'
    text = _hole(PEG_CLEARANCE).replace("<worldbody>", f"{setting}<worldbody>")
    return base.scene_of(text.replace('mass="0.1"', f'mass="{WORST.mass!r}"'))


def run_case(
    treatment: Treatment, case: Case, *, keep_records: bool = False, same_law: bool = False
) -> LoopOutcome:
    """Runs a treatment on a rig in a hand.

    Args:
        treatment: Contact and method.
        case: Rig, coupling, tool and hand.
        keep_records: True returns the records.
        same_law: True requests the coupling for which the method's law has the K and B' of
            ``lossless``, and thus needs the same device. By default the requested K and B are equal
            for all methods.
    """
    rig, period = RIGS[case.rig], treatment.period
    loop = base.loop_in(rig.load, "contact")
    treatment.apply(loop.scene, case)
    requested = coupling_of(case)
    coupling, method = requested, METHODS[treatment.method].with_contact(treatment.contact)
    if same_law:
        law = METHODS["lossless"].law_coupling(requested, period)
        coupling = method.requested_coupling(law, period)
    return loop.run(
        device_of(case, loop.scene, period),
        coupling,
        method,
        period=period,
        ticks=math.floor(_path_and_hand(case)[0].duration / period),
        substeps=treatment.substeps,
        keep_records=keep_records,
    )


def coupling_of(case: Case) -> Coupling:
    """Returns the coupling that a case requests."""
    per_k, rotational_damping = ROTATION
    damping = RIGS[case.rig].damping
    return Coupling(case.stiffness, damping, per_k * case.stiffness, rotational_damping)


def device_of(case: Case, scene: Scene, period: float) -> SimulatedDevice:
    """Returns a device in the hand of a case that bears the requested coupling.

    Args:
        case: Rig, coupling, tool and hand.
        scene: The rig's scene; it may name a hand.
        period: T in s.
    """
    requested, (path, hand) = coupling_of(case), _path_and_hand(case)
    return SimulatedDevice(
        damping=DEVICE_MARGIN * (requested.stiffness * period / 2 + requested.damping),
        rotational_damping=DEVICE_MARGIN
        * (requested.rotational_stiffness * period / 2 + requested.rotational_damping),
        hand=hand if hand is not None else scene_hand(scene.model, scene.path),
        path=path,
        force_limit=UNLIMITED.force,
        torque_limit=UNLIMITED.torque,
    )


@cache
def _path_and_hand(case: Case) -> tuple[Motion, Hand | None]:
    """Returns path and hand; None is the hand that a shipped scene asks for."""
    rig = RIGS[case.rig]
    if rig.is_shipped and case.hand == 0:
        return read_motion(scene_path(case.rig).with_suffix(".csv")).relative(), None
    if case.rig == "wall" and case.hand in TAPPING:
        path = base.swinging(0.008, TAPPING[case.hand], duration=1.0, count=301)
        return path, Hand(stiffness=2000.0, damping=25.0)
    random = np.random.default_rng(case.hand)
    return rig.path(random), None if rig.is_shipped else _firm(random)


TAPPING = {-1: 3.0, -2: 6.0}
"""Frequencies in Hz of the hands −1 and −2 on the wall, slow and deep, and fast."""
