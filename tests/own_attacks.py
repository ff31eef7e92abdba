"""Attacks on the bridge by hands and devices whose energy is counted by a ledger of their own.

A case is a loop whose coupling the device just bears, or the default one, in a hand that is passive
or driven. A hand is improved in steps toward one that gets back most of what it puts in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import mujoco
import numpy as np
from adversary import SCENES
from numpy.typing import NDArray
from own_device import Drive, OwnDevice
from two_hands import SCENES as TWO
from two_hands import two_handed

from hapticbridge.clock import SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import conditions_of
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.methods import Method, method_named
from hapticbridge.errors import SafetyTrip
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.hands import Grasp
from hapticbridge.run.options import Workspace
from hapticbridge.scene import load_scene
from hapticbridge.theory.bounds import minimum_damping

DURATION = 1.5
"""Length of a run in s."""

PINNED = """
<mujoco>
  <worldbody>
    <body name="tool">
      <joint type="ball"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <site name="grip"/>
    </body>
  </worldbody>
</mujoco>
"""
"""A tool that cannot move and hardly turns."""

FREE = ("virtual_wall", "point_mass", "pinned")
"""Scenes without stored energy at the start."""

Shares = NDArray[np.float64]


class Draws:
    """Numbers of a loop or of a hand, each from a share between 0 and 1."""

    def __init__(self, shares: Shares) -> None:
        self._left = iter(shares.tolist())

    def even(self, low: float, high: float) -> float:
        return low + (high - low) * float(next(self._left))

    def log(self, low: float, high: float) -> float:
        return low * float((high / low) ** next(self._left))

    def pick(self, *values: Any) -> Any:
        return values[int(next(self._left) * len(values))]


@dataclass(kw_only=True)
class Case:
    """One loop: b in N s/m, more of ``OwnDevice`` and of the bridge, and a law or the default one.

    ``is_old`` takes the midpoint torque at any twist.
    """

    rate: float
    scene: str
    method: Method
    b: float
    law: Coupling | None = None
    sheet: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    is_old: bool = False

    @classmethod
    def drawn(cls, s: Draws) -> Case:
        rate = s.pick(250.0, 500.0, 1000.0, 1000.0, 2000.0, 4000.0)
        method = method_named(s.pick("lossless", "implicit", "compensated"))
        return cls(rate=rate, scene=s.pick(*FREE), method=method, b=s.pick(0.5, 2.0, 5.0))

    def delay(self, ticks: float, **more: Any) -> None:
        """States the largest delay in ticks; all forces are as late unless ``late`` is given."""
        self.sheet |= {"delay": ticks / self.rate, "is_delay_measured": True}
        self.sheet |= {"late": lambda _: ticks} | more

    def at_bound(
        self, ratio: float, ticks: float = 0.0, count: int = 1, scale: float = 1.0
    ) -> None:
        """Takes the stiffest law with B'/K in periods that the device bears."""
        one, late = Coupling(1.0, ratio / self.rate, 0.0, 0.0), math.ceil(round(ticks, 9))
        most = (1 - 1e-9) * self.b / scale
        most /= minimum_damping(one, 1 / self.rate, delay=late, ticks_per_sample=count)
        turned = 1e-3 * most * scale
        self.law = Coupling(most, one.damping * most, turned, one.damping * turned)


def on_time(s: Draws) -> Case:
    """Any scene at any scale, at the force level, some scenes slower than the loop."""
    case, scales, ticks = Case.drawn(s), (s.log(0.3, 5.0), s.log(0.3, 5.0)), s.pick(1, 1, 2, 5, 10)
    case.scene, case.sheet["force_limit"] = s.pick(*SCENES), s.log(0.3, 20.0)
    case.options["workspace"] = Workspace(scale=scales[0], force_scale=scales[1])
    if ticks > 1:
        case.options["scene_rate"] = case.rate / ticks
    elif s.pick(True, False):
        case.at_bound(s.pick(0.0, 0.2, 2.0), scale=scales[0] * scales[1])
    if s.pick(True, False):
        case.sheet["rotational_damping"] = 1e-3 * case.b * max(1.0, (scales[1] / scales[0]) ** 2)
    return case


def late(s: Draws) -> Case:
    """Forces 0.25 to 8 ms late; a default coupling bears a tick more than an unmeasured delay."""
    case, most, is_measured = Case.drawn(s), s.log(2.5e-4, 8e-3), s.pick(True, False)
    most = s.pick(most * case.rate, math.ceil(most * case.rate))
    true = most * s.pick(1.0, 1.0, s.even(0.0, 1.0))
    if s.pick(True, True, False):
        case.at_bound(s.pick(0.0, s.log(0.1, 10.0)), most)
    elif not is_measured:
        true = most + s.pick(0.0, 0.5, 1.0) * min(1.0, 1e-3 * case.rate)
    case.delay(most, late=lambda _: true, is_delay_measured=is_measured)
    if s.pick(True, False):
        case.sheet["rotational_damping"] = 1e-3 * case.b
    return case


def varying(s: Draws) -> Case:
    """Forces 0 to 8 ms late, each otherwise, behind a spring alone."""
    case, share, rng = Case.drawn(s), s.even(0.0, 1.0), np.random.default_rng(int(s.even(0, 1e6)))
    most = s.log(2.5e-4, 8e-3) * case.rate
    case.delay(most, late=lambda _: most * max(float(rng.random() < share), rng.random()))
    case.at_bound(0.0, most)
    return case


def slow(s: Draws) -> Case:
    """A device that gives a sample every 2 to 8 ticks and holds its force, late or not."""
    case, count = Case.drawn(s), s.pick(2, 3, 4, 8)
    ticks = s.pick(0, 0, 1, 2) * count
    case.delay(ticks, every=count, rate=case.rate / count)
    if s.pick(True, False):
        case.at_bound(s.pick(0.0, s.log(0.1, 10.0)), ticks, count)
    return case


def stepped(s: Draws, *, is_half: bool = False) -> Case:
    """Encoder steps of 1 to 200 µm on a device with all or half of the friction that they need."""
    case, ticks, ratio = Case.drawn(s), s.pick(0, 0, 1, 2), s.pick(0.0, 0.2, 1.0)
    case.scene, step = s.pick("virtual_wall", "pinned"), s.log(1e-6, 2e-4)
    if is_half:  # where a swing about an edge gathers most
        ticks, ratio, step = s.pick(1, 2), 0.0, 2e-4
    case.at_bound(ratio, ticks)
    assert case.law is not None
    needed = step * (0.5 * case.law.stiffness + case.law.damping * case.rate)
    friction = needed * (0.5 if is_half else 1 + 1e-9)
    case.delay(ticks, step=step, resolution=step, friction=friction)
    return case


def turning(s: Draws, *, is_old: bool = False) -> Case:
    """A device that is turned by up to 2.8 rad, with the damping that its coupling needs."""
    case, k = Case.drawn(s), s.log(0.05, 5.0)
    case.law = Coupling(case.b * case.rate, 0.0, k, k * s.pick(0.0, 0.05, 0.4) / case.rate)
    b_r = s.pick(1.0, 1.2) * (1 + 1e-9) * (0.5 * k / case.rate + case.law.rotational_damping)
    case.sheet = {"rotational_damping": b_r, "torque_limit": 50.0}
    if is_old:
        case.method, case.is_old, case.scene = method_named("lossless"), True, "virtual_wall"
    return case


def two_hands(s: Draws) -> Case:
    """Two hands on one body or two, each with a device that is late or not."""
    case, ticks = Case.drawn(s), s.pick(0, 0, 1, 2)
    case.scene = s.pick("bar", "peg_and_block")
    case.method = method_named(s.pick("implicit", "compensated"))
    case.delay(ticks, rotational_damping=1e-3 * case.b)
    if s.pick(True, False):
        case.at_bound(s.pick(0.0, 0.2, 2.0), ticks)
    return case


def walls_rule(s: Draws) -> Case:
    """A spring that a wall bears behind a delay: K = b/(T/2 + t_d)."""
    case, ticks = Case.drawn(s), s.pick(1, 2, 3, 8)
    case.delay(ticks)
    case.law = Coupling(case.b * case.rate / (0.5 + ticks), 0.0, 0.1, 0.0)
    return case


KINDS: Mapping[str, Callable[[Draws], Case]] = {
    "devices on time": on_time,
    "late devices": late,
    "devices late by a varying time": varying,
    "slow devices": slow,
    "steps that friction holds": stepped,
    "large twists": turning,
    "two hands on devices": two_hands,
}
"""Cases that keep the conditions."""

REFERENCES: Mapping[str, Callable[[Draws], Case]] = {
    "a wall's rule behind a delay": walls_rule,
    "half the friction": partial(stepped, is_half=True),
    "midpoint torque at any twist": partial(turning, is_old=True),
}
"""Cases that do not."""


def held(case: Case, h: Draws) -> OwnDevice:
    """Returns the device of a case in a drawn hand."""
    mass = h.log(0.02, 2.0)
    stiffness, damping = mass * (h.log(3e-3, 3.0) * case.rate) ** 2, h.log(0.01, 3.0)
    start = h.log(1e-6, 5e-3), h.log(1e-4, 0.5)
    k_r = 1.0 if case.law is None else case.law.rotational_stiffness
    spring, twist, wobble = k_r * h.log(0.5, 10.0), h.even(0.1, 2.8), h.log(1e-4, 1e-1)
    inertia = float(np.clip((k_r + spring) / (h.log(0.1, 3.0) * case.rate) ** 2, 1e-8, 1e-3))
    if "torque_limit" not in case.sheet:
        twist, wobble = 0.0, 0.1 * wobble
    place, swing = h.pick(0.0, h.even(-2.0, 2.0) / stiffness), h.pick(0.0, h.log(1e-6, 1e-2))
    if "step" in case.sheet and case.law and h.pick(True, False):  # about an edge between two steps
        step, stiffness = case.sheet["step"], case.law.stiffness * h.log(10.0, 1000.0)
        place, swing = (
            step * (math.floor(place / step) + h.even(0.47, 0.53)),
            step * h.log(0.08, 0.4),
        )
        start, mass = (0.1 * step, 0.0), max(mass, stiffness / (3.0 * case.rate) ** 2)
    drive = Drive(
        end=DURATION - 0.2,
        place=place,
        swing=swing,
        omega=h.pick(h.log(1e-3, 1.0), h.even(0.3, math.pi)) * case.rate,
        twist=min(twist * (1 + k_r / spring), 3.0),
        wobble=wobble,
        inertia=inertia,
        spring=spring,
        damper=h.pick(0.0, h.log(1e-6, 1e-3)),
    )
    hand = stiffness, damping
    return OwnDevice(hand, mass=mass, start=start, drive=drive, damping=case.b, **case.sheet)


@dataclass(frozen=True, order=True, slots=True)
class Outcome:
    """Result of a run.

    Attributes:
        energy: The most in J that the hands had beyond what they put in, the devices burned and
            the scene gave up of its storage.
        back: What the hands got over what went to and fro, at the end.
        blur: The most in J that steps may have added, as the summary prints it.
        is_certified: True if the device conditions hold, whatever the run's own meters found.
    """

    energy: float
    back: float
    blur: float
    is_certified: bool


def outcome(case: Case, hands: Shares) -> Outcome:
    """Runs a case in hands, with a row of shares for each."""
    devices, coupling = [held(case, Draws(each)) for each in hands], None
    if case.law is not None:
        coupling = case.method.requested_coupling(case.law, 1 / case.rate)
    limits = Limits(energy=math.inf, angle=3.1, stretch=math.inf)
    options: dict[str, Any] = {"rate": case.rate, "method": case.method.name, "limits": limits}
    options |= {"controller": "off", "clock": SimulatedClock()} | case.options
    if case.scene in TWO:
        pairs = zip(("left", "right"), devices, strict=True)
        grasps = [Grasp(grip, each, coupling=coupling) for grip, each in pairs]
        bridge = Bridge(two_handed(TWO[case.scene]), grasps, **options)
    else:
        scene = mujoco.MjSpec.from_string(PINNED) if case.scene == "pinned" else case.scene
        bridge = Bridge(load_scene(scene), devices[0], coupling, **options)
    got, scales = [], case.options.get("workspace", Workspace()).scales
    with bridge:
        state = bridge.session.kernel.state
        state["guard"]["max_turn_speed"] = state["guard"]["max_speed"] = math.inf
        if case.is_old:
            state["coupling"]["twist_damping"] = math.inf
        try:
            summary = bridge.run(DURATION, lambda _: got.append(sum(each.got for each in devices)))
        except SafetyTrip:
            summary = bridge.session.summary()
        energy = devices[0].gained if len(devices) == 1 else max(got)
        if energy > 0.0 and case.scene not in (*FREE, *TWO):
            rows, (scale, force_scale) = bridge.latest_records(summary.ticks), scales
            stored = rows["kinetic"] + rows["potential"]
            energy -= force_scale / scale * float(stored[0] - stored.min())
    through = max(sum(each.through for each in devices), 1e-12)
    back, blur = sum(each.got for each in devices) / through, 2.0 * summary.hand_energy.hidden
    conditions = conditions_of(bridge.setup.loop)
    return Outcome(energy, back, blur, all(each.holds is not False for each in conditions))


def attacked_on_device(kind: str, seed: int, steps: int = 0) -> Outcome:
    """Runs a drawn hand on a drawn case of a kind, and improves the hand in some steps.

    Of a case that keeps the conditions, only what is certified counts as better.
    """
    rng, case_of = np.random.default_rng([seed, 49]), {**KINDS, **REFERENCES}[kind]
    shares, count = rng.random(20), 2 if case_of is two_hands else 1
    hands = rng.random((count, 24))
    best = outcome(case_of(Draws(shares)), hands)
    for _ in range(steps):
        moves = rng.normal(0.0, 0.1, hands.shape) * (rng.random(hands.shape) < 0.3)
        near = np.clip(hands + moves, 0.0, 1 - 1e-9)
        found = outcome(case_of(Draws(shares)), near)
        if (found.is_certified or kind in REFERENCES) and found > best:
            best, hands = found, near
    return best
