"""Hands that try to get energy out of a bridge, at random, in compiled code.

A hand here is a source of motion: it moves the device as it likes, up to 3 m/s, and feels every
force without noise or delay. It pumps, stretches the coupling far beyond the force limit and
yields, presses and releases buttons, and changes the coupling while it is stretched. The device
has just the damping b that the coupling needs. ``Attack.run`` returns the most energy that the hand
ever had in hand beyond what b had burned and the scene had given up of its own storage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.jit import compiled
from hapticbridge.kernel.codes import CLUTCHED, FORCE_OFF, OK
from hapticbridge.kernel.parameters import GuardParameters, RunParameters
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import advance, after_step, before_step
from hapticbridge.record import SAMPLE_DTYPE
from hapticbridge.rendering import method_named, prepare
from hapticbridge.scene import load_scene

SCENES = (
    "point_mass",
    "virtual_wall",
    "peg_in_hole",
    "planar_peg",
    "round_peg",
    "hammer",
    "drawer",
    "pliers",
    "open_wrench",
    "ratchet",
)
HEAVY = ("point_mass",)
"""Scenes whose tool gets a random mass."""

HANDS = 5
CHUNK = 50
"""Ticks between two decisions of the hand about buttons and coupling."""

HAND_DTYPE = np.dtype(
    [
        ("position", "<f8", 3),
        ("quaternion", "<f8", 4),
        ("velocity", "<f8", 6),
        ("net", "<f8"),
        ("most", "<f8"),
        ("saturated", "<i8"),
        ("tick", "<i8"),
    ]
)

FASTEST, FASTEST_TURN = 3.0, 20.0
"""Speeds of the hand in m/s and rad/s that it never exceeds."""


@compiled
def _shortened(v: NDArray[np.float64], most: float) -> None:
    size = np.sqrt(np.sum(v * v))
    if size > most:
        v *= most / size


@compiled
def _turned(q: NDArray[np.float64], turn: NDArray[np.float64]) -> None:
    angle = np.sqrt(np.sum(turn * turn))
    if angle == 0.0:
        return
    c, s = np.cos(0.5 * angle), np.sin(0.5 * angle) / angle
    x, y, z = s * turn[0], s * turn[1], s * turn[2]
    a, b, e, f = q[0], q[1], q[2], q[3]
    q[0] = c * a - x * b - y * e - z * f
    q[1] = c * b + x * a + y * f - z * e
    q[2] = c * e - x * f + y * a + z * b
    q[3] = c * f + x * e - y * b + z * a
    q /= np.sqrt(np.sum(q * q))


@compiled
def seed_hand(seed: int) -> None:
    """Seeds the hand's own random numbers, which live in compiled code."""
    np.random.seed(seed)


@compiled
def _attack(
    state: NDArray[np.void],
    sample: NDArray[np.void],
    row: NDArray[np.void],
    hand: NDArray[np.void],
    options: NDArray[np.float64],
) -> int:
    """Runs a chunk; returns the code of the first tick that was refused, else ``OK``.

    ``options``: count of axes, kind of hand, b, b_r, limit of force and torque in N and N m that
    only the device applies, buttons, speed in m/s, share of the speed w/b at which it follows, and
    ticks of pushing, waiting and following.
    """
    s, h = state[0], hand[0]
    period = s.run.period
    ratio = s.run.force_scale / s.run.scale
    axes, kind = int(options[0]), int(options[1])
    b, b_r = options[2], options[3]
    speed, pace = options[7], options[8]
    push, hold, follow = int(options[9]), int(options[10]), int(options[11])
    d, t, w = np.zeros(3), np.zeros(3), np.zeros(6)
    for _ in range(CHUNK):
        for i in range(6):
            w[i] = s.loop.wrench_on_device[i]
        _shortened(w[:3], options[4])
        _shortened(w[3:], options[5])
        step = h.tick % (push + hold + follow)
        if kind == 0:  # wanders
            for i in range(6):
                fresh = 0.05 * speed if i < 3 else 0.3
                h.velocity[i] = 0.98 * h.velocity[i] + fresh * np.random.randn()
            d[:], t[:] = h.velocity[:3] * period, h.velocity[3:] * period
        elif kind in (1, 2):  # stretches, waits, then follows the force or the tool alone
            if step == 0:
                for i in range(6):
                    h.velocity[i] = np.random.randn()
                h.velocity[min(axes, 3) : 3] = 0.0
                h.velocity[:3] *= speed / np.sqrt(np.sum(h.velocity[:3] ** 2))
            if step < push:
                d[:], t[:] = h.velocity[:3] * period, h.velocity[3:] * period
            elif step >= push + hold:
                d[:], t[:] = w[:3] * (pace / b * period), w[3:] * (pace / b_r * period)
                if kind == 2 and np.sum(d * h.velocity[:3]) < 0.0:
                    d[:] = 0.0
            else:
                d[:], t[:] = 0.0, 0.0
        elif kind == 3:  # shakes at one frequency
            angle = 2.0 * np.pi * h.tick / (push + hold)
            d[:] = (
                1e-3 * speed * np.array([np.sin(angle), np.cos(1.3 * angle), np.sin(0.7 * angle)])
            )
            t[:] = 2e-3 * np.array([np.cos(angle), np.sin(1.1 * angle), np.cos(0.9 * angle)])
        else:  # trembles without memory
            for i in range(3):
                d[i], t[i] = 1e-3 * speed * np.random.randn(), 5e-3 * np.random.randn()
        d[min(axes, 3) :] = 0.0
        if axes < 6:
            t[:] = 0.0
        _shortened(d, FASTEST * period)
        _shortened(t, FASTEST_TURN * period)
        for i in range(3):
            h.net += (w[i] - b / period * d[i]) * d[i] + (w[3 + i] - b_r / period * t[i]) * t[i]
        released = min(s.energy.kinetic + s.energy.potential - s.energy.start_energy, 0.0)
        h.most = max(h.most, h.net + ratio * released)
        for i in range(3):
            h.position[i] += d[i]
        _turned(h.quaternion, t)
        sample[0].buttons = int(options[6])
        for i in range(3):
            sample[0].position[i] = h.position[i]
        for i in range(4):
            sample[0].quaternion[i] = h.quaternion[i]
        for substep in range(s.run.substeps):
            code = before_step(state, sample, row, substep, period)
            if code != OK:
                return code
            advance(state)
            code = after_step(state, row, substep)
            if code != OK:
                return code
        h.saturated += s.level.flags != 0
        h.tick += 1
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
        is_limited_alone: True limits the force on the device alone, as a bridge must not.
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
    is_limited_alone: bool = False

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
        strongest = self._coupling(rng, b / gain, b_r / gain_r, 1.0)
        limits = 10 ** rng.uniform(-0.5, 1.2), 10 ** rng.uniform(-2.0, -0.3)
        mass = 10 ** rng.uniform(-1.5, 0.0)
        scene = load_scene(self.scene, **({"mass": mass} if self.scene in HEAVY else {}))
        prepare(scene, strongest, period, 1, method, warns=False)
        start = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        parameters = RunParameters(
            grip=scene.grip,
            period=period,
            substeps=1,
            coupling=method.law_coupling(strongest, period),
            scale=self.scale,
            force_scale=self.force_scale,
            force_limit=1e9 if self.is_limited_alone else limits[0],
            torque_limit=1e9 if self.is_limited_alone else limits[1],
            ramp_ticks=round(0.1 / period),
            device_origin=start,
            handle_origin=scene.grip_pose(),
            device_start=start,
            scheme=method.scheme,
            guarding=GuardParameters(clutch=1, fade_ticks=max(round(0.02 / period), 1)),
        )
        kernel = BoundKernel(scene.model, scene.data, parameters)
        hand, sample = np.zeros(1, HAND_DTYPE), np.zeros(1, SAMPLE_DTYPE)
        hand["quaternion"][0, 0] = 1.0
        times = 10 ** rng.uniform([-2.7, -2.7, -1.5], [-0.7, -0.7, 0.3]) / period
        habits = 10 ** rng.uniform(-1.0, 0.4), rng.uniform(0.05, 0.6)
        options = np.array([self.axes, self.kind, b, b_r, *limits, 0.0, *habits, *np.ceil(times)])
        seed_hand(self.seed)
        code = OK
        for _ in range(ticks // CHUNK):
            if self.presses and rng.random() < 0.1:
                options[6] = 1.0 - options[6]
            if self.presses and rng.random() < 0.05:
                kernel.command(int(rng.choice([0, FORCE_OFF, CLUTCHED])))
            if self.tunes and rng.random() < 0.2:
                wanted = self._coupling(rng, b / gain, b_r / gain_r, rng.uniform(0.1, 1.0))
                law = method.law_coupling(wanted, period)
                goal = RunParameters(**{**_fields(parameters), "coupling": law})
                kernel.tune(goal, method.gains(law, period), max(round(0.02 / period), 1))
            code = _attack(kernel.state, sample, kernel.row, hand, options)
            if code != OK:
                break
        return float(hand["most"][0]), int(hand["saturated"][0]), code

    def _coupling(self, rng: np.random.Generator, b: float, b_r: float, share: float) -> Coupling:
        """Returns a coupling that needs at most a share of the damping b."""
        damping, damping_r = share * b * rng.uniform(0.0, 0.5), share * b_r * rng.uniform(0.0, 0.5)
        return Coupling(
            2.0 * (share * b - damping) * self.rate * (1 - 1e-9),
            damping,
            2.0 * (share * b_r - damping_r) * self.rate * (1 - 1e-9),
            damping_r,
        )


def _fields(parameters: RunParameters) -> dict[str, object]:
    return {name: getattr(parameters, name) for name in parameters.__dataclass_fields__}
