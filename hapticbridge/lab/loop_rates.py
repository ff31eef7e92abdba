"""Hardest certified wall, and the felt error of a tap on it, against the loop's rate and delay.

One device, with its spring in a loop on the computer, behind USB, or in a loop on its own board.
The stiffness is that of the default coupling, which leaves 15 % of damping and friction. A tap is
the device alone, thrown at the wall:

    m dv/dt = f − b v − f_c sign(v),    f from the position in steps Δ, read every T, t later

Behind the coupling the wall is rigid and the tool has no mass, so the tool y is at the wall while
f = −(K e + B'/T δe) pushes, e = h − y, and else where f = 0. The error is that of
``check.perception``, against a spring of 40 kN/m without delay. A line shows that of no force.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hapticbridge.check.perception import felt_error
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.methods import default_method
from hapticbridge.device.base import DeviceInfo
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.plotting import new_figure

DEVICE = DeviceInfo(
    name="device",
    axes=("x",),
    force_limit=20.0,
    mass=0.1,
    damping=2.0,
    friction=0.1,
    resolution=10e-6,
    delay=0.0,
    is_delay_measured=True,
)
"""The device: 0.1 kg, 2 N s/m, 0.1 N of friction, steps of 10 µm."""

USB_DELAY = 2e-3
"""Delay in s through full-speed USB: a message of 1 ms each way."""

BOARD_DELAY = 10e-6
"""Time in s on a board from reading a position to its force, with a driver that controls the
current. A motor that follows a voltage adds its L/R."""

SPEED = 0.2
"""Speed of the tap in m/s, that of a finger."""

IDEAL = 40e3
"""Stiffness in N/m of the ideal wall. A steel table is stiffer, and the fingertip softer."""

DURATION = 0.06
"""Time in s from touching the wall; the softest contact lasts 37 ms."""

STEP = 5e-6
"""Time step of the device's motion in s; all periods and delays are multiples of it. At a fifth of
it the felt errors change by 0.3 % at most."""


@dataclass(frozen=True, slots=True)
class Loop:
    """A loop that renders the wall.

    Attributes:
        place: ``computer`` or ``board``.
        rate: Periods per second in Hz.
    """

    place: str
    rate: float

    @property
    def label(self) -> str:
        """Name in the picture."""
        link = "\nthrough 2 ms of USB" if self.place == "computer" else ""
        return f"{self.place}, {self.rate / 1e3:g} kHz{link}"

    @property
    def delay(self) -> float:
        """Time in s from reading a position to its force."""
        return BOARD_DELAY if self.place == "board" else USB_DELAY

    def coupling(self, device: DeviceInfo) -> Coupling:
        """Returns the law of the stiffest certified coupling."""
        if self.place == "board":
            info = replace(device, loop_period=1.0 / self.rate, loop_delay=BOARD_DELAY)
            return replace(default_coupling(info, 1e-3), damping=0.0)
        period = 1.0 / self.rate
        requested = default_coupling(replace(device, delay=USB_DELAY), period)
        return default_method(1).law_coupling(requested, period)


LOOPS = (
    Loop("computer", 1e3),
    Loop("computer", 4e3),
    Loop("board", 4e3),
    Loop("board", 10e3),
    Loop("board", 20e3),
)
"""Loops of the picture."""


def wall(law: Coupling, period: float) -> Callable[[float], float]:
    """Returns the law of a wall at 0: a position in m, read every T in s, to the force in N.

    It keeps e of the last period.
    """
    damper, stretch = law.damping / period, 0.0

    def force(position: float) -> float:
        nonlocal stretch
        free = damper * stretch / (law.stiffness + damper)
        last, stretch = stretch, min(position, free)
        return max(-law.stiffness * stretch - damper * (stretch - last), 0.0)

    return force


def tap(
    device: DeviceInfo, force: Callable[[float], float], period: float, delay: float
) -> NDArray[np.float64]:
    """Returns the force on the device in N at each step of a tap, from the touch on.

    Args:
        device: Mass, damping, friction and resolution; its steps begin at the wall.
        force: Law of the loop, called once per period.
        period: T in s, a multiple of ``STEP``.
        delay: Time in s from reading a position to its force, too.
    """
    mass, damping = device.mass or 0.0, device.damping or 0.0
    friction, step = device.friction or 0.0, device.resolution or 0.0
    every, late, count = round(period / STEP), round(delay / STEP), round(DURATION / STEP)
    forces = np.zeros(count + late + every)
    position, velocity = 0.0, -SPEED
    for k in range(count):
        if k % every == 0:
            read = step * math.floor(position / step + 0.5) if step else position
            forces[k + late : k + late + every] = force(read)
        speed = (mass * velocity + STEP * forces[k]) / (mass + STEP * damping)
        velocity = math.copysign(max(abs(speed) - STEP * friction / mass, 0.0), speed)
        position += STEP * velocity
    return forces[:count]


def felt(device: DeviceInfo, loop: Loop | None) -> float:
    """Returns the error of a tap in just noticeable differences of the ideal wall's force.

    Args:
        device: The device.
        loop: The loop that renders the wall; without one the device gets no force.
    """
    ideal = wall(Coupling(IDEAL, 0.0, 0.0, 0.0), STEP)
    exact = tap(replace(device, resolution=0.0), ideal, STEP, 0.0)
    found = np.zeros_like(exact)
    if loop is not None:
        period = 1.0 / loop.rate
        found = tap(device, wall(loop.coupling(device), period), period, loop.delay)
    return felt_error(_records(exact), _records(found)).jnd


def _records(forces: NDArray[np.float64]) -> NDArray[np.void]:
    records = np.zeros(forces.size, TICK_DTYPE)
    records["wrench_on_tool"][:, 0] = forces
    return records


def draw() -> Figure:
    """Draws stiffness and felt error of all loops, with the encoder's steps and without."""
    figure = new_figure(8.0, 3.7)
    hardness, error = figure.subplots(1, 2, sharey=True)
    exact = replace(DEVICE, resolution=0.0)
    kinds = (("steps of 10 µm, friction 0.1 N", DEVICE, "C0"), ("without steps", exact, "C7"))
    for place, (label, device, colour) in enumerate(kinds):
        rows = [row + 0.4 * place - 0.2 for row in range(len(LOOPS))]
        stiffness = [1e-3 * loop.coupling(device).stiffness for loop in LOOPS]
        errors = [felt(device, loop) for loop in LOOPS]
        for axes, values, form in ((hardness, stiffness, "%.3g"), (error, errors, "%.2g")):
            bars = axes.barh(rows, values, 0.38, color=colour, label=label)
            axes.bar_label(bars, fmt=form, padding=3, fontsize=8)
    hardness.set(xscale="log", xlim=(0.3, 150.0), xlabel="hardest certified wall (N/mm)")
    hardness.set_yticks(range(len(LOOPS)), [loop.label for loop in LOOPS])
    hardness.invert_yaxis()
    hardness.legend(loc="upper right", fontsize=8)
    error.set(
        xlabel=f"error of a tap on {1e-3 * IDEAL:g} N/mm\n(just noticeable differences of force)",
        xlim=(0.0, 18.0),
    )
    for value, label in ((1.0, "just noticeable"), (felt(exact, None), "no force at all")):
        error.axvline(value, color="black", ls="--", lw=0.9)
        error.annotate(
            label, (value, 1.0), (0, 2), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=8, ha="center",
        )  # fmt: skip
    figure.suptitle(f"a device of {DEVICE.mass:g} kg with b = {DEVICE.damping:g} N s/m", fontsize=9)
    for axes in (hardness, error):
        axes.spines[["top", "right"]].set_visible(False)
    return figure
