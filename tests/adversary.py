"""Hands that try to get energy out of a bridge, at random, in compiled code.

A hand here is a source of motion: it moves the device as it likes, up to 3 m/s, and feels every
force without noise or delay. It pumps, stretches the coupling far beyond the force limit and
yields, presses and releases buttons, and changes the coupling while it is stretched. The device
has just the damping b that the coupling needs. ``Attack.run`` returns the most energy that the hand
ever had in hand beyond what b had burned, the scene had given up of its own storage, and the
coupling had booked as owed by late samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from posting_program import PostingProgram

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import method_named, unguarded_parameters
from hapticbridge.kernel.codes import BAD_RESULT, CLUTCHED, FORCE_OFF, OK
from hapticbridge.kernel.jit import compiled, direct
from hapticbridge.kernel.parameters import GuardParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import posted_tick, shown_tick, whole_tick
from hapticbridge.run.endpoint import posted_scene
from hapticbridge.scene import load_scene

SCENES = (
    "point_mass",
    "virtual_wall",
    "peg_in_hole",
    "planar_peg",
    "round_peg",
    "hammer",
    "drawer",
    "bench_pliers",
    "open_wrench",
    "ratchet",
)
HEAVY = ("point_mass",)
"""Scenes whose tool gets a random mass."""

UNPAID = 1e-6
"""Largest energy in J that a hand may have beyond what it put in; rounding leaves less."""

HANDS = 5
"""Number of kinds of hands."""

WANDERS, SHAKES, TREMBLES = 0, 3, 4
"""Kinds of hands that do not stretch the coupling and then follow."""

REAPS = 5
"""Kind of a hand that flees along each pulse of a blow, and then strikes there again."""

CHUNK = 50
"""Ticks between two decisions of the hand about buttons and coupling."""

HAND_DTYPE = np.dtype(
    [
        ("position", "<f8", 3),
        ("quaternion", "<f8", 4),
        ("velocity", "<f8", 6),
        ("net", "<f8"),
        ("most", "<f8"),
        ("credit", "<f8"),
        ("pulse", "<f8", 3),
        ("wall", "<f8", 3),
        ("flees", "<i8"),
        ("saturated", "<i8"),
        ("tick", "<i8"),
        ("due", "<i8"),
    ]
)

FASTEST, FASTEST_TURN = 3.0, 20.0
"""Speeds of the hand in m/s and rad/s that it never exceeds."""


@compiled
def _shorten(v: NDArray[np.float64], most: float) -> None:
    size = np.sqrt(np.sum(v * v))
    if size > most:
        v *= most / size


@compiled
def turn(q: NDArray[np.float64], step: NDArray[np.float64]) -> None:
    """Turns a quaternion by a rotation vector in rad."""
    angle = np.sqrt(np.sum(step * step))
    if angle == 0.0:
        return
    c, s = np.cos(0.5 * angle), np.sin(0.5 * angle) / angle
    x, y, z = s * step[0], s * step[1], s * step[2]
    a, b, e, f = q[0], q[1], q[2], q[3]
    q[0] = c * a - x * b - y * e - z * f
    q[1] = c * b + x * a + y * f - z * e
    q[2] = c * e - x * f + y * a + z * b
    q[3] = c * f + x * e - y * b + z * a
    q /= np.sqrt(np.sum(q * q))


@compiled
def _move(
    h: Any,
    w: NDArray[np.float64],
    habits: NDArray[np.float64],
    period: float,
    normals: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the next step in m and rotation vector in rad; ``habits`` as in ``_attack``."""
    axes, kind, b, b_r = int(habits[0]), int(habits[1]), habits[2], habits[3]
    speed, pace = habits[7], habits[8]
    push, hold, follow = int(habits[9]), int(habits[10]), int(habits[11])
    d, t = np.zeros(3), np.zeros(3)
    step = h.tick % (push + hold + follow)
    if kind == WANDERS:
        for i in range(6):
            fresh = 0.05 * speed if i < 3 else 0.3
            h.velocity[i] = 0.98 * h.velocity[i] + fresh * normals[i]
        d[:], t[:] = h.velocity[:3] * period, h.velocity[3:] * period
    elif kind == SHAKES:  # at one frequency
        angle = 2.0 * np.pi * h.tick / (push + hold)
        d[:] = 1e-3 * speed * np.array([np.sin(angle), np.cos(1.3 * angle), np.sin(0.7 * angle)])
        t[:] = 2e-3 * np.array([np.cos(angle), np.sin(1.1 * angle), np.cos(0.9 * angle)])
    elif kind == TREMBLES:  # without memory
        for i in range(3):
            d[i], t[i] = 1e-3 * speed * normals[2 * i], 5e-3 * normals[2 * i + 1]
    elif kind == REAPS and h.flees:
        d[:] = h.pulse * (pace * FASTEST * period / np.sqrt(np.sum(h.pulse**2)))
    elif step < push:  # stretches, waits, then follows the force (1), or the tool alone (2)
        if step == 0:
            h.velocity[:] = normals
            h.velocity[min(axes, 3) : 3] = 0.0
            if kind == REAPS:
                h.velocity[:3] += 10.0 * h.wall
            h.velocity[:3] *= speed / np.sqrt(np.sum(h.velocity[:3] ** 2))
        d[:], t[:] = h.velocity[:3] * period, h.velocity[3:] * period
    elif step >= push + hold:
        d[:], t[:] = w[:3] * (pace / b * period), w[3:] * (pace / b_r * period)
        if kind == 2 and np.sum(d * h.velocity[:3]) < 0.0:
            d[:] = 0.0
    d[min(axes, 3) :] = 0.0
    if axes < 6:
        t[:] = 0.0
    return d, t


@compiled
def _move_device(
    state: NDArray[np.void],
    sample: NDArray[np.void],
    hand: NDArray[np.void],
    habits: NDArray[np.float64],
    normals: NDArray[np.float64],
    elapsed: float,
) -> None:
    """Moves the device for a time in s; ``normals`` are six numbers of a normal distribution."""
    s, h = state[0], hand[0]
    period, b, b_r = s.run.period, habits[2], habits[3]
    w = np.zeros(6)
    w[:] = s.loop.wrench_on_device
    h.pulse[:] = s.impact.newest
    if np.any(h.pulse != 0.0) and not h.flees:  # it first points away from what was struck
        h.wall[:] = -h.pulse / np.sqrt(np.sum(h.pulse**2))
    h.flees = np.any(h.pulse != 0.0)
    _shorten(w[:3], habits[4])
    _shorten(w[3:], habits[5])
    d, t = _move(h, w, habits, period, normals)
    d *= elapsed / period
    t *= elapsed / period
    _shorten(d, FASTEST * elapsed)
    _shorten(t, FASTEST_TURN * elapsed)
    h.net += np.sum((w[:3] - b / elapsed * d) * d) + np.sum((w[3:] - b_r / elapsed * t) * t)
    h.position[:] += d
    turn(h.quaternion, t)
    sample[0].buttons = int(habits[6])
    for i in range(3):
        sample[0].position[i] = h.position[i]
    for i in range(4):
        sample[0].quaternion[i] = h.quaternion[i]


@compiled
def _account(state: NDArray[np.void], hand: NDArray[np.void]) -> None:
    s, h = state[0], hand[0]
    # another program may give its credit, whatever the kernel says of its tank
    released = -h.credit
    if h.credit == 0.0:
        released = min(s.energy.kinetic + s.energy.potential - s.energy.start_energy, 0.0)
    # a force that was held too long may have given more than its spring held; that is owed
    owed = s.coupling.owed[0] + s.coupling.owed[1]
    h.most = max(h.most, h.net + s.run.force_scale / s.run.scale * (released - owed))
    h.saturated += s.level.flags != 0
    h.tick += 1


def _attack(
    states: tuple[NDArray[np.void], NDArray[np.void]],
    own: tuple[NDArray[np.void], NDArray[np.void], NDArray[np.void]],
    hand: NDArray[np.void],
    habits: NDArray[np.float64],
    rng: np.random.Generator,
    program: PostingProgram | None,
) -> int:
    """Runs a chunk; returns the code of the first tick that was refused, else ``OK``.

    ``states`` and ``own`` as for ``shown_tick``; three steps in ten of a slower scene come late.
    ``habits``: count of axes, kind of hand, b, b_r, limit of force and torque in N and N m that
    only the device applies, buttons, speed in m/s, share of the speed w/b at which it follows,
    ticks of pushing, waiting and following, periods by which three samples in ten are late, ticks
    per step of the scene.
    """
    state, sample, normals = states[0], np.zeros(1, SAMPLE_DTYPE), np.zeros(6)
    # a float of NumPy would make numba compile the tick anew: that takes a minute
    kind, late, scene_ticks = int(habits[1]), float(habits[12]), int(habits[13])
    period, cycle = float(state[0]["run"]["period"]), int(habits[9:12].sum())
    move = direct(_move_device, state, sample, hand, habits, normals, period)
    account = direct(_account, state, hand)
    first, due = int(hand[0]["tick"]), int(hand[0]["due"])
    for tick in range(first, first + CHUNK):
        if kind in (WANDERS, TREMBLES) or (kind != SHAKES and tick % cycle == 0):
            normals[:] = rng.standard_normal(6)
        elapsed = period
        if late > 0.0 and rng.random() < 0.3:
            elapsed *= 1.0 + late * rng.random()
        move(state, sample, hand, habits, normals, elapsed)
        if program is not None:
            is_done = posted_tick(state, sample, program.post(tick), own[0], elapsed)
        elif scene_ticks == 0:
            is_done = whole_tick(state, sample, own[0], elapsed)
        else:
            is_done = shown_tick(states, own, sample, elapsed, tick >= due)
            if tick >= due:
                due = tick + scene_ticks
                due += int(scene_ticks * rng.random()) if rng.random() < 0.3 else 0
        if not is_done:
            return BAD_RESULT
        account(state, hand)
    hand["due"] = due
    return OK


@dataclass(frozen=True, slots=True, kw_only=True)
class Attack:
    """One hand on one scene.

    Attributes:
        seed: Seed of all choices.
        scene: Name of a shipped scene.
        rate: Rate in Hz.
        axes: 1, 3 or 6 axes of the device.
        scale, force_scale: Scales of motion and force.
        kind: Kind of hand, 0 to 4.
        method: Rendering method.
        presses: True if the hand presses buttons and switches the force.
        tunes: True if it changes the coupling.
        late: Periods by which samples are late at most.
        scene_ticks: Ticks per step of a scene slower than the loop; 0 steps it in every tick.
        pays: False shows every result of that scene at once, as a bridge must not.
        is_limited_alone: True limits the force on the device alone, as a bridge must not.
        is_posted: True lets another program show its tool (``posting_program``), which may give
            the hand no more than its credit.
        impact_pulses: Share of a blow's energy for pulses; the device then has spare damping, and
            one hand in two flees along the pulses.
        pays_pulses: False sends pulses that no blow has paid for, as a bridge must not.
        allowed: Share of that credit that a hand may have; less shows how much of it hands get.
    """

    seed: int
    scene: str
    rate: float
    axes: int
    scale: float
    force_scale: float
    kind: int
    method: str = "lossless"
    presses: bool = True
    tunes: bool = True
    late: float = 0.0
    scene_ticks: int = 0
    pays: bool = True
    is_limited_alone: bool = False
    is_posted: bool = False
    impact_pulses: float = 0.0
    pays_pulses: bool = True
    allowed: float = 1.0

    @classmethod
    def at_random(cls, seed: int, **changes: object) -> Attack:
        """Draws everything from a seed."""
        rng = np.random.default_rng(seed)
        chosen: dict[str, object] = {
            "scene": SCENES[seed % len(SCENES)],
            "rate": float(rng.choice([250, 500, 1000, 2000, 4000])),
            "axes": int(rng.choice([1, 3, 6])),
            "scale": float(10 ** rng.uniform(-0.52, 0.7)),
            "force_scale": float(10 ** rng.uniform(-0.52, 0.7)),
            "kind": int(rng.integers(HANDS)),
            "method": str(rng.choice(["lossless", "implicit", "compensated"])),
        }
        return cls(seed=seed, **(chosen | changes))  # type: ignore[arg-type] # names are checked there

    def run(self, ticks: int = 2000) -> tuple[float, int, int]:
        """Returns the most energy in J, the count of saturated ticks, and the refusing code."""
        rng = np.random.default_rng([self.seed, 1])
        period, method = 1.0 / self.rate, method_named(self.method)
        b = float(rng.choice([0.5, 2.0, 5.0]))
        b_r = 1e-3 * b
        gain, gain_r = self.scale * self.force_scale, self.force_scale / self.scale
        pulses = self._pulses(b, period)
        strongest = self._coupling(rng, (b - pulses["pulse_damping"]) / gain, b_r / gain_r, 1.0)
        limits = 10 ** rng.uniform(-0.5, 1.2), 10 ** rng.uniform(-2.0, -0.3)
        mass = 10 ** rng.uniform(-1.5, 0.0)
        credit = 10 ** rng.uniform(-3.0, -0.5) if self.is_posted else 0.0
        values: dict[str, Any] = {"mass": mass} if self.scene in HEAVY else {}
        scene = posted_scene(credit) if self.is_posted else load_scene(self.scene, **values)
        step = period * max(self.scene_ticks, 1)
        parameters = replace(
            unguarded_parameters(scene, strongest, step, 1, method),
            period=period,
            scale=self.scale,
            force_scale=self.force_scale,
            force_limit=1e9 if self.is_limited_alone else limits[0],
            torque_limit=1e9 if self.is_limited_alone else limits[1],
            ramp_ticks=round(0.1 / period),
            device_damping=b,
            device_rotational_damping=b_r,
            **pulses,
            scene_ticks=self.scene_ticks,
            credit=credit,
            guarding=GuardParameters(
                clutch=1,
                fade_ticks=max(round(0.02 / period), 1),
                has_hand=True,
                twist_damping=b_r,
            ),
        )
        kernel = slow = BoundKernel(scene.model, scene.data, parameters)
        if self.scene_ticks and not self.is_posted:
            slow = BoundKernel(scene.model, scene.data, parameters.of_scene, kernel)
        if not self.pays:
            kernel.state["shown"]["tank"] = kernel.state["shown"]["passing"] = 1e9
        states, own = (kernel.state, slow.state), (kernel.row, slow.row, np.zeros(1, SAMPLE_DTYPE))
        hand = np.zeros(1, HAND_DTYPE)
        hand["quaternion"][0, 0] = 1.0
        hand["credit"] = self.allowed * parameters.tank_at_start
        times = 10 ** rng.uniform([-2.7, -2.7, -1.5], [-0.7, -0.7, 0.3]) / period
        habits = np.array(
            [
                self.axes,
                REAPS if self.impact_pulses and self.seed % 2 else self.kind,
                b,
                b_r,
                *limits,
                0.0,
                10 ** rng.uniform(-1.0, 0.4),
                rng.uniform(0.05, 0.6),
                *np.ceil(times),
                self.late,
                self.scene_ticks,
            ]
        )
        draw, chooses = (np.random.default_rng([self.seed, i]) for i in (2, 3))
        program = PostingProgram(chooses, period, kernel) if self.is_posted else None
        code = OK
        for _ in range(ticks // CHUNK):
            if self.presses and rng.random() < 0.1:
                habits[6] = 1.0 - habits[6]
            if self.presses and rng.random() < 0.05:
                kernel.command(int(rng.choice([0, FORCE_OFF, CLUTCHED])))
            if self.tunes and rng.random() < 0.2:
                wanted = self._coupling(rng, b / gain, b_r / gain_r, rng.uniform(0.1, 1.0))
                law = method.law_coupling(wanted, step)
                goal, ticks = replace(parameters, coupling=law), max(round(0.02 / period), 1)
                kernel.tune(goal, method.gains(law, step), ticks)
                if self.scene_ticks and not self.is_posted:
                    ticks = max(round(0.02 / step), 1)
                    slow.tune(goal.of_scene, method.gains(law, step), ticks)
            if not self.pays_pulses:
                kernel.state["impact"]["account"] = 1e9
            code = _attack(states, own, hand, habits, draw, program)
            if code != OK:
                break
        return float(hand["most"][0]), int(hand["saturated"][0]), code

    def _pulses(self, b: float, period: float) -> dict[str, Any]:
        """Returns the pulses of a run, and the damping of b that is spare for them."""
        rng = np.random.default_rng([self.seed, 4])
        return {
            "impact_pulses": self.impact_pulses,
            "pulse_frequency": float(rng.uniform(0.0, 0.5) / period),
            "pulse_decay": float(10 ** rng.uniform(-3.0, -1.0)),
            "pulse_damping": b * float(rng.choice([0.0, 0.3, 0.8])) if self.impact_pulses else 0.0,
        }

    def _coupling(self, rng: np.random.Generator, b: float, b_r: float, share: float) -> Coupling:
        """Returns a coupling that needs at most a share of the damping b."""
        damping, damping_r = share * b * rng.uniform(0.0, 0.5), share * b_r * rng.uniform(0.0, 0.5)
        return Coupling(
            2.0 * (share * b - damping) * self.rate * (1 - 1e-9),
            damping,
            2.0 * (share * b_r - damping_r) * self.rate * (1 - 1e-9),
            damping_r,
        )
