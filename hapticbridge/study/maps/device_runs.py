"""Runs of a device with encoder steps and dry friction on a wall, and what they did.

Against a wall a method is the law that it uses: K beside B' = B − a K T, at least 0, with a = 0 for
``implicit``, 1 for ``compensated`` and ½ for ``lossless``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, Motion, SimulatedDevice
from hapticbridge.rendering import METHODS
from hapticbridge.study.closed_loop import LoopOutcome
from hapticbridge.study.maps.bisection import largest_stable
from hapticbridge.study.maps.bound_of_method import used_damping
from hapticbridge.study.maps.rigs import wall_loop

RANGE = (0.1, 2.0)
"""Of β and of σ, even in their logarithms."""

METHODS_SHOWN = ("implicit", "compensated", "lossless")
"""Methods whose need for friction is measured, which the bounds allow on a real device."""

DAMPERS = (0.0, 3.0)
"""Range of B in N s/m asked for, for the friction that a coupling's damper needs: K T/2 and K T,
below which ``lossless`` and ``compensated`` use none, are 1 and 2."""

REGIONS = ("passive", "locally stable", "bounded limit cycle", "unstable")

PERIOD = 1e-3
"""T in s."""

STIFFNESS = 2000.0
"""K in N/m. Only β = b/(K T) and σ = f_c/(K Δ) count, and the mass a little."""

RESOLUTION = 1e-5
"""Δ in m: an encoder of 10 µm at the handle."""

QUANTUM = STIFFNESS * RESOLUTION
"""K Δ in N, the step of the force."""

DEVICE_MASS = 0.1
"""m_d in kg, that of the default simulated device."""

PULL = 1.0
"""Stiffness of the hand in N/m: a five hundredth of K's step in force is what it varies by, so that
it presses with a steady force."""

PRESSED = 5.5
"""Force of the hand in steps of K Δ. The half matters: the wall can answer with five or six steps,
each wrong by half of one, and half a step is the friction that then holds the device."""

LARGE = 3000.0
"""Knock of the second run in steps of the encoder: 3 cm. Friction alone can stop a smaller one even
where damping does not suffice: it takes 4 σ steps a swing from any motion."""

WALL_MASS = 1e9
"""In kg: a tool that the hand's press moves by 2e-9 m in a run, a five thousandth of a step."""

TICKS = 6000
"""Of a knocked run; one that is only pressed has settled in half of them."""

CHANGED = 0.02
"""Share by which the range of motion must rise or fall between the last two sixths of a run to
count as doing so, without unit; less would take the beat of a cycle with the samples for it."""

NOTHING = 2.0
"""Range in steps of the encoder up to which motion is the cycle across one border, and neither
rises nor falls."""

DIVERGED = 3.0
"""Multiple of the knock beyond which motion has diverged, without unit; a free device overshoots at
most to its start."""

FRICTION = (0.01, 10.0)
"""Range of σ in which that at which a pressed device rests is searched."""

DAMPED = 5.0
"""b in N s/m while B is varied, above K T/2 + B throughout."""

SHAKEN = 0.05
"""Stroke of the shaken hand, in steps of the encoder: small, so that the device's own damping takes
nothing, which would otherwise help friction."""


def region_of(small: str, large: str) -> str:
    """Returns the region that two runs show, from what they did alone.

    Args:
        small: What became of a device that was only pressed, as ``settle`` names it.
        large: The same of one that was knocked as well; where it ``falls`` until the end, the
            small one says what it falls to.
    """
    if "diverges" in {small, large}:
        return "locally stable" if small == "rest" else "unstable"
    is_passive = small == "rest" and large in {"rest", "falls"}
    return "passive" if is_passive else "bounded limit cycle"


def settle(
    beta: float, sigma: float, knock: float, damping: float = 0.0, name: str = "implicit"
) -> tuple[str, float, LoopOutcome]:
    """Runs a device that a hand presses on a wall, after a knock.

    Args:
        beta: b/(K T), without unit, >= 0.
        sigma: f_c/(K Δ), without unit, >= 0.
        knock: Displacement at the start in steps of the encoder.
        damping: B in N s/m asked for, >= 0. At 0 all of ``METHODS_SHOWN`` have one law.
        name: The method.

    Returns:
        ``rest``, ``cycle`` (motion that neither ends nor grows), ``falls`` (it is still on its way
        down) or ``diverges``; the range of the
        reported position in the last sixth in steps of the encoder; and the run.
    """
    device = pressed_device(beta, sigma)
    start = np.array([knock * RESOLUTION, 0.0, 0.0, 0.0, 0.0, 0.0])
    ticks = TICKS if knock else TICKS // 2
    run = _wall(name, device, damping, ticks, start)
    steps = run.records["device_position"][:, 0] / RESOLUTION
    width = ticks // 6
    if run.ticks < ticks or np.abs(steps).max() > DIVERGED * max(knock, 2 * PRESSED):
        return "diverges", float(np.ptp(steps[-width:])), run
    before, last = float(np.ptp(steps[-2 * width : -width])), float(np.ptp(steps[-width:]))
    if last == 0:
        return "rest", last, run
    if last > NOTHING and last > before * (1 + CHANGED):
        return "diverges", last, run
    if last > NOTHING and last < before * (1 - CHANGED):
        return "falls", last, run
    return "cycle", last, run


def pressed_device(beta: float, sigma: float, limit: float = 10.0) -> SimulatedDevice:
    """Returns a device with friction and encoder steps whose hand presses it on the wall.

    Args:
        beta: b/(K T), without unit, >= 0.
        sigma: f_c/(K Δ), without unit, >= 0.
        limit: Of its data sheet, in N and N m.
    """
    time = [0.0, 0.02, 100.0]
    target = np.zeros((3, 3))
    target[1:, 0] = PRESSED * QUANTUM / PULL
    hand = Hand(
        mass=0.0,
        damping=0.0,
        stiffness=PULL,
        rotational_inertia=0.0,
        rotational_damping=0.0,
        rotational_stiffness=0.0,
    )
    return SimulatedDevice(
        mass=DEVICE_MASS,
        damping=beta * STIFFNESS * PERIOD,
        friction=sigma * QUANTUM,
        resolution=RESOLUTION,
        hand=hand,
        path=Motion(time, target),
        force_limit=limit,
        torque_limit=limit,
    )


def _wall(
    name: str, device: SimulatedDevice, damping: float, ticks: int, knock: NDArray[np.float64]
) -> LoopOutcome:
    return wall_loop(WALL_MASS).run(
        device,
        Coupling(STIFFNESS, damping, 0.0, 0.0),
        METHODS[name],
        period=PERIOD,
        ticks=ticks,
        knock=knock,
        keep_records=True,
    )


def friction_needed(name: str, damping: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the σ that theory asks for, ½ + B'/(K T): f_c = K Δ/2 + B' Δ/T.

    Args:
        name: The method, whose law uses B'.
        damping: B in N s/m asked for, >= 0.

    References:
        Abbott & Okamura 2005.
    """
    return 0.5 + used_damping(name, STIFFNESS, damping, PERIOD) / (PERIOD * STIFFNESS)


def friction_to_rest(name: str, damping: float) -> float:
    """Returns a σ at which a pressed device begins to come to rest.

    0 where it rests at the least that is tried, inf where it never does. With a damper rest and
    cycle take turns between K Δ/2 and a little above; one of the changes is found.

    Args:
        name: The method.
        damping: B in N s/m asked for, >= 0.
    """
    beta = DAMPED / (STIFFNESS * PERIOD)
    return largest_stable(
        lambda sigma: settle(beta, sigma, 0.0, damping, name)[0] != "rest", *FRICTION
    ).middle


def shaken(name: str, damping: float) -> float:
    """Returns the σ that pays for what the motor gives a hand that shakes it across one step.

    The hand is stiff and moves the device to and fro across a border between two encoder steps,
    once a tick; the motor's work on it, over the way, is the friction that would take it.

    Args:
        name: The method.
        damping: B in N s/m asked for, >= 0.
    """
    ticks = 400
    side = np.where(np.arange(ticks + 2) % 2 == 0, -0.5, 0.5) * SHAKEN
    side[0] = 0.0
    # a border lies half a step from where the device starts, and it goes there first
    way = np.concatenate([[0.0, 0.0], np.full(50, 0.5), 0.5 + side]) * RESOLUTION
    path = np.zeros((way.size, 3))
    path[:, 0] = way
    device = SimulatedDevice(
        mass=1e-3,
        damping=DAMPED,
        resolution=RESOLUTION,
        hand=Hand(mass=0.0, damping=1e6, stiffness=1e9),
        path=Motion(PERIOD * np.arange(way.size), path),
    )
    run = _wall(name, device, damping, way.size - 1, np.zeros(6))
    first = way.size - 300
    force = run.records["wrench_on_device"][first:-1, 0]
    moved = np.diff(way)[first : first + force.size]
    return float((force * moved).sum() / np.abs(moved).sum() / QUANTUM)
