"""Scenes for two hands, and hands that attack them from both sides at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from adversary import turn
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import Method, method_named, unguarded_parameters
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.force_level import keep_state, limited_wrench_after_step
from hapticbridge.kernel.jit import compiled, direct
from hapticbridge.kernel.ledger import meter_ports
from hapticbridge.kernel.parameters import GuardParameters
from hapticbridge.kernel.pose import dot
from hapticbridge.kernel.record import SAMPLE_DTYPE
from hapticbridge.kernel.state import BoundHands
from hapticbridge.kernel.tick import (
    active_contacts,
    advance,
    before_step,
    close_tick,
    keep_wrench,
    send_wrench,
    whole_tick,
)
from hapticbridge.scene import Scene, load_scene

BAR = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="bar">
      <freejoint/>
      <geom type="capsule" size="0.01" fromto="-0.1 0 0 0.1 0 0" mass="0.2"/>
      <site name="left" pos="-0.1 0 0"/>
      <site name="right" pos="0.1 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""
"""A bar in free space, held at both ends."""

PEG_AND_BLOCK = """
<mujoco>
  <option gravity="0 0 0"/>
  <default><geom condim="3" friction="0.4"/></default>
  <worldbody>
    <body name="peg" pos="0 0 0.052">
      <freejoint/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
      <geom type="capsule" size="0.01" fromto="0 0 -0.02 0 0 0.04" mass="0.1"/>
      <site name="left"/>
    </body>
    <body name="block">
      <freejoint/>
      <inertial pos="0 0 0" mass="0.3" diaginertia="3e-4 3e-4 3e-4"/>
      <geom type="box" size="0.03 0.03 0.02" mass="0.3"/>
      <site name="right"/>
    </body>
  </worldbody>
</mujoco>
"""
"""A peg in one hand above a block in the other; both float. They are held at their centres and have
equal moments of inertia: a thin peg that a single hand spins at 100 rad/s creates energy in
MuJoCo's explicit rotation, and that is not what is tested here."""

TONGS = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="half">
      <freejoint/>
      <inertial pos="0 0 0" mass="0.2" diaginertia="2e-4 2e-4 2e-4"/>
      <geom type="box" size="0.05 0.005 0.005"/>
      <site name="left"/>
      <body name="jaw" pos="0 0.012 0">
        <joint name="hinge" axis="0 0 -1" range="-0.2 0.3" limited="true" stiffness="0.05"
          springref="-0.1"/>
        <inertial pos="0 0 0" mass="0.03" diaginertia="2e-5 2e-5 2e-5"/>
        <geom type="box" size="0.05 0.004 0.004" pos="0.01 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
"""Tongs with a spring: a hand holds one half, and a grip axis moves the hinge. Both halves have
equal moments of inertia, as the peg."""

SCENES = {"bar": BAR, "peg_and_block": PEG_AND_BLOCK, "tongs": TONGS}
GRIPS = {"tongs": ("left", "joint:hinge")}
LEVER = 10.0
"""Motion of the hinge of the tongs per motion of the grip axis in rad/m."""

TICKS = 1500
"""Ticks of an attack."""

UNPAID = 1e-6
"""Largest energy in J that both hands may have beyond what they put in; rounding leaves less."""


def two_handed(xml: str, grips: tuple[str, str] = ("left", "right")) -> Scene:
    """Loads a scene whose sites ``left`` and ``right``, or others, are held."""
    return load_scene(mujoco.MjSpec.from_string(xml), grips)


def bound_hands(
    scene: Scene,
    couplings: tuple[Coupling, Coupling],
    period: float,
    method: Method,
    **changes: Any,
) -> BoundHands:
    """Prepares a scene for two hands without devices, and binds their states."""
    plain = unguarded_parameters(scene, couplings[0], period, 1, method)
    laws = tuple(method.law_coupling(coupling, period) for coupling in couplings)
    scene.of_hand(1).set_gains(*method.gains(laws[1], period))
    parameters = []
    for hand in range(2):
        held = scene.of_hand(hand)
        own: dict[str, Any] = {
            "grip": held.grip,
            "coupling": laws[hand],
            "handle_origin": held.grip_pose(),
        }
        levers = dict.fromkeys(("scale", "force_scale"), LEVER if held.joint >= 0 else 1.0)
        parameters.append(replace(plain, **(own | levers | changes)))
    return BoundHands(scene.model, scene.data, parameters)


def unmoved() -> NDArray[np.void]:
    """Returns one sample per hand, of devices at their start."""
    samples = np.zeros(2, SAMPLE_DTYPE)
    samples["quaternion"][:, 0] = 1.0
    return samples


@compiled
def one_after_the_other(
    states: NDArray[np.void], samples: NDArray[np.void], rows: NDArray[np.void], elapsed: float
) -> bool:
    """Runs a tick as a bridge must not: each hand's level is settled as if it were alone.

    The wrench of the first hand is evaluated before the second one repeats the step.
    """
    if before_step(states, samples, rows, 0, elapsed) != OK:
        return False
    keep_state(states[1])
    advance(states[0:1])
    meter_ports(states[0])
    for i in range(states.size):
        force, torque, moved, turned = limited_wrench_after_step(states[i : i + 1], True)
        work = dot(force, moved) + dot(torque, turned)
        keep_wrench(states[i], work, force, torque, moved, turned)
    for i in range(states.size):
        if send_wrench(states[i], rows[i], active_contacts(states[0])) != OK:
            return False
    return close_tick(states, rows, False) == OK


@compiled
def _move_devices(
    states: NDArray[np.void],
    samples: NDArray[np.void],
    moves: NDArray[np.float64],
    habits: NDArray[np.float64],
    tick: int,
    account: NDArray[np.float64],
) -> None:
    b, b_r, pace = habits[0], habits[1], habits[2]
    period = states[0].run.period
    for hand in range(2):
        s, length = states[hand], int(habits[3 + hand])
        w = s.loop.wrench_on_device
        d, t = moves[hand, :3] * period, moves[hand, 3:] * period
        if (tick // length) % 2 == 1:
            d, t = w[:3] * (pace / b * period), w[3:] * (pace / b_r * period)
        d *= min(1.0, 3.0 * period / (np.sqrt(np.sum(d * d)) + 1e-30))
        t *= min(1.0, 20.0 * period / (np.sqrt(np.sum(t * t)) + 1e-30))
        given = np.sum((w[:3] - b / period * d) * d) + np.sum((w[3:] - b_r / period * t) * t)
        account[0] += given
        for i in range(3):
            samples[hand].position[i] += d[i]
        turn(samples[hand].quaternion, t)


@compiled
def _close_account(states: NDArray[np.void], account: NDArray[np.float64]) -> None:
    energy = states[0].energy
    released = min(energy.kinetic + energy.potential - energy.start_energy, 0.0)
    owed = 0.0
    for hand in range(2):
        owed += states[hand].coupling.owed[0] + states[hand].coupling.owed[1]
    account[1] = max(account[1], account[0] + released - owed)
    created = max(energy.environment_energy, states[1].energy.environment_energy)
    account[2] = max(account[2], created)


def attack(
    states: NDArray[np.void],
    samples: NDArray[np.void],
    rows: NDArray[np.void],
    moves: NDArray[np.float64],
    habits: NDArray[np.float64],
) -> tuple[float, float, int]:
    """Moves both devices, and counts the energy that they get beyond what they burn and put in.

    A hand pushes for some ticks and follows the force for as many, at a share of the speed w/b.

    Args:
        states, samples, rows: As for ``whole_tick``.
        moves: Velocity of pushing in m/s and rad/s by tick, hand and axis, (n, 2, 6).
        habits: b in N s/m, b_r in N m s/rad, pace of following, by hand its ticks of a push, and 1
            for levels that are settled one after the other.

    Returns:
        Largest energy in J, largest Σ E_k of both accounts in J, and count of completed ticks.
    """
    account, period = np.zeros(3), float(states[0]["run"]["period"])
    move = direct(_move_devices, states, samples, moves[0], habits, 0, account)
    close = direct(_close_account, states, account)
    run_tick = one_after_the_other if habits[5] else whole_tick
    done = len(moves)
    for tick, velocities in enumerate(moves):
        move(states, samples, velocities, habits, tick, account)
        if not run_tick(states, samples, rows, period):
            done = tick
            break
        close(states, account)
    return float(account[1]), float(account[2]), done


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of an attack.

    Attributes:
        most: Largest energy in J of both hands beyond what they put in and their devices burned.
        created: Largest energy in J that the scene created, within the slack or not.
        is_active: True if it created more than the slack.
        ticks: Completed ticks.
        repetitions: Ticks at a force level.
    """

    most: float
    created: float
    is_active: bool
    ticks: int
    repetitions: int


def attacked(seed: int, scene: str, ticks: int = TICKS, *, is_joint: bool = True) -> Outcome:
    """Runs a random attack on a scene of ``SCENES``, with devices that just bear their couplings.

    ``is_joint`` is False to settle the hands' force levels one after the other.
    """
    rng = np.random.default_rng([seed, 26])
    rate = float(rng.choice([500, 1000, 2000]))
    period, method = 1.0 / rate, method_named(str(rng.choice(["implicit", "compensated"])))
    b = float(rng.choice([0.5, 2.0, 5.0]))
    b_r = 1e-3 * b
    couplings = []
    for _ in range(2):
        share = rng.uniform(0.2, 1.0)
        damping, damping_r = share * b * rng.uniform(0, 0.5), share * b_r * rng.uniform(0, 0.5)
        couplings.append(
            Coupling(
                2 * (share * b - damping) * rate * (1 - 1e-9),
                damping,
                2 * (share * b_r - damping_r) * rate * (1 - 1e-9),
                damping_r,
            )
        )
    grips = GRIPS.get(scene, ("left", "right"))
    if has_axis := scene in GRIPS:
        own = couplings[1]
        couplings[1] = Coupling(own.stiffness / LEVER**2, own.damping / LEVER**2, 0.0, 0.0)
    bound = bound_hands(
        two_handed(SCENES[scene], grips),
        (couplings[0], couplings[1]),
        period,
        method,
        force_limit=10 ** rng.uniform(-0.5, 1.2),
        torque_limit=10 ** rng.uniform(-2.0, -0.3),
        device_damping=b,
        device_rotational_damping=b_r,
        guarding=GuardParameters(has_hand=True),
    )
    speed = 10 ** rng.uniform(-1.0, 0.3)
    noise = rng.standard_normal((ticks // 20 + 1, 2, 6)).repeat(20, axis=0)[:ticks]
    moves = noise * np.array([speed] * 3 + [3.0 * speed] * 3)
    if has_axis:
        moves[:, 1, 1:] = 0.0
    pace, lengths = rng.uniform(0.05, 0.6), rng.integers(5, 150, 2)
    habits = np.array([b, b_r, pace, *lengths, not is_joint], dtype=float)
    most, created, done = attack(bound.state, unmoved(), bound.row, moves, habits)
    is_active = int(bound.state[0]["energy"]["first_active"]) >= 0
    count = int(bound.state["level"]["repetitions"].sum())
    return Outcome(most, created, is_active, done, count)
