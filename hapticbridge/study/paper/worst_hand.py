"""The hand for which the bounds are tight, in the time domain."""

from __future__ import annotations

from itertools import product

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.drawing import panels
from hapticbridge.study.paper.in_mujoco import HEAVY, ImplicitMass, decays, hold
from hapticbridge.study.paper.section import Curve, Section
from hapticbridge.theory.bounds import minimum_damping
from hapticbridge.theory.sampled_loop import SampledLoop, WorstHand, stability_limit

PERIOD = 1e-3
"""T in s."""

COUPLING = Coupling(1000.0, 2.0, 0.0, 0.0)
PERIODS = (5e-4, 1e-3, 2e-3)
DELAYS = (0, 1)
FILTER_TIMES = (0.0, 2e-3)
"""Grid of the checks: T in s, samples of delay, time constant of the low-pass in s."""

TICKS = 3000
"""Of a run with MuJoCo in the loop: 3 s, in which a force that decays is gone."""


def _in_mujoco(share: float) -> NDArray[np.float64]:
    bound = COUPLING.stiffness * PERIOD / 2 + COUPLING.damping
    hand = WorstHand(share * bound, np.pi / PERIOD, PERIOD)
    return hold(ImplicitMass(COUPLING, PERIOD, HEAVY).force, hand, TICKS)


def section() -> Section:
    """Shows that the bounds are reached."""
    figure, (delayed, simulated) = panels(1, height=4.0, columns=2)
    loop = SampledLoop(COUPLING, PERIOD, delay=1)
    frequency = loop.worst_frequency()
    response = complex(loop.response(frequency))
    bound = float(loop.damping_spectrum(frequency))
    for share, colour in ((0.98, "C3"), (1.02, "C0")):
        hand = WorstHand(share * bound, frequency, PERIOD, response)
        _draw_envelope(delayed, np.abs(loop.simulate(hand, 1500).force), share, colour)
        _draw_envelope(simulated, np.abs(_in_mujoco(share))[:300], share, colour)
    delayed.set_title(
        f"one sample of delay, wall; worst at {frequency / 2 / np.pi:.0f} Hz", fontsize="small"
    )
    simulated.set_title("MuJoCo in the loop, worst at Nyquist", fontsize="small")

    checks = []
    for period, delay, filter_time in product(PERIODS, DELAYS, FILTER_TIMES):
        case = SampledLoop(COUPLING, period, delay=delay, filter_time=filter_time)
        expected = float(minimum_damping(COUPLING, period, delay=delay, filter_time=filter_time))
        checks.append(
            Check(
                equation="worst hand",
                quantity=f"T = {1e3 * period:g} ms, delay {delay}, τ = {1e3 * filter_time:g} ms: "
                "b at the limit",
                route="time-domain loop, bisection, against the bound over frequency",
                expected=expected,
                got=stability_limit(case),
                unit="N s/m",
                tolerance=1e-3,
            )
        )
    checks.extend(
        Check(
            equation="worst hand",
            quantity=f"heavy tool, b = {share:g} of (6): 1 if the force decays",
            route="MuJoCo in the loop",
            expected=expected,
            got=float(decays(_in_mujoco(share), TICKS)),
            tolerance=0.0,
        )
        for share, expected in ((0.98, 0.0), (1.02, 1.0))
    )
    return Section(
        equation="worst hand",
        title="The hand that reaches the bound",
        formulas=(
            "(b + Z<sub>0</sub>) v<sub>k</sub> + (b − Z<sub>0</sub>) v<sub>k−1</sub> = "
            "F<sub>k</sub> + F<sub>k−1</sub>, &ensp; h<sub>k+1</sub> = h<sub>k</sub> + T "
            "v<sub>k</sub>",
            "Z<sub>0</sub> tuned so that the loop closes on itself at θ<sub>0</sub>; "
            "Z<sub>0</sub> = b cot²(θ<sub>0</sub>/2) for a spring",
        ),
        paragraphs=(
            "The paper's conditions hold for every passive hand. They are tight: device mass and "
            "hand together may be a lossless line, Z<sub>0</sub> tanh(sT/2), which takes no power "
            "and turns the phase until the loop is marginal. Its recursion under a held force is "
            "exact. With it a time-domain loop loses stability where the bound over frequency "
            "says.",
            "With the delay of one sample the bound is that against a wall. At Nyquist "
            "Z<sub>0</sub> = 0 and the device's damper alone is the worst hand.",
        ),
        curves=(
            Curve(
                "worst_hand",
                "Force at 0.98 and 1.02 of the damping needed, in the plain loop and with MuJoCo.",
                figure,
            ),
        ),
        checks=tuple(checks),
    )


def _draw_envelope(axes: Axes, force: NDArray[np.float64], share: float, colour: str) -> None:
    """Draws the largest force of every 20 ticks, relative to the first."""
    blocks = force[: len(force) // 20 * 20].reshape(-1, 20).max(axis=1)
    time = 20e3 * PERIOD * np.arange(len(blocks))
    axes.semilogy(time, blocks / blocks[0], color=colour, label=f"b = {share:g} of the bound")
    axes.set_xlabel("time (ms)")
    axes.set_ylabel("largest force, over the first")
    axes.legend(fontsize="small", loc="upper left")
