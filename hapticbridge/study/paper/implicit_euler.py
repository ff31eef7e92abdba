"""Equations (15) and (16): implicit Euler, and MuJoCo's two ways to apply a force."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.study.paper.check import Check
from hapticbridge.study.paper.discrete_passivity import MASS, PERIOD, under_random_force
from hapticbridge.study.paper.drawing import panels
from hapticbridge.study.paper.in_mujoco import AppliedForceMass, ImplicitMass, drive
from hapticbridge.study.paper.section import Curve, Section

COUPLING = Coupling(2000.0, 2.0, 0.0, 0.0)
"""K and B of the runs with MuJoCo."""

SECONDS = 2.0
"""How long the handle moves."""

_Array = NDArray[np.float64]


def section() -> Section:
    """Walks through (15) and (16)."""
    motion = under_random_force("implicit")
    squared = PERIOD**2 * motion.force[1:] ** 2 / (2 * MASS)

    ticks = round(SECONDS / PERIOD)
    handle = 0.01 * np.sin(2 * np.pi * 3 * PERIOD * np.arange(1, ticks + 1))
    rows = drive(ImplicitMass(COUPLING, PERIOD, MASS), handle)
    force = rows["wrench_on_tool"][:, 0]
    gains = np.diff(rows["environment_energy"], prepend=0.0)
    expected = -(PERIOD**2) * force**2 / (2 * MASS)
    applied, applied_gains, predicted = _applied_force_gains(handle)

    figure, (energy, ratio) = panels(1, height=3.8, columns=2)
    time = PERIOD * np.arange(1, ticks + 1)
    energy.plot(time, 1e3 * np.cumsum(gains), color="C0", label="coupling actuators, discrete")
    energy.plot(time, 1e3 * np.cumsum(expected), "k:", label="−Σ T²f²/(2m), (16)")
    energy.plot(time, 1e3 * np.cumsum(applied_gains), color="C1", label="applied force, Euler")
    energy.plot(time, 1e3 * np.cumsum(predicted), "k--", lw=1, label="+Σ T²f²/(2m)")
    energy.set_xlabel("time (s)")
    energy.set_ylabel("Σ E_k (mJ)")
    energy.legend(fontsize="small")
    ratio.plot(1e3 * squared, 1e3 * motion.energy_gain, ".", ms=3, label="random forces, (15)")
    end = 1e3 * float(squared.max())
    ratio.plot([0, end], [0, -end], "k", lw=0.8, label="(16)")
    ratio.set_xlabel("T²f²/(2m) (mJ)")
    ratio.set_ylabel("E_k of a step (mJ)")
    ratio.legend(fontsize="small")

    scale = float(np.abs(motion.energy_gain).max())
    return Section(
        equation="(15), (16)",
        title="Implicit Euler loses energy in every step",
        formulas=(
            "v<sub>k</sub> = v<sub>k−1</sub> + (T/m) f<sub>k</sub>, &ensp; "
            "x<sub>k</sub> = x<sub>k−1</sub> + T v<sub>k</sub>&emsp;(15)",
            "E<sub>k</sub> = −½ m (v<sub>k</sub> − v<sub>k−1</sub>)² = −T² f<sub>k</sub>²/(2m) ≤ 0"
            "&emsp;(16)",
        ),
        paragraphs=(
            "The force belongs to the position at the end of the step, so it must be solved for. "
            "In MuJoCo the coupling is six actuators, and the integrator <code>discrete</code> "
            "solves them together with the rest: it is (15), step by step.",
            "A force that is written before the step (<code>xfrc_applied</code> under "
            "<code>Euler</code>) arrives one sample late, j = 1. It creates exactly what (15) "
            f"loses. Here a handle moves 1 cm at 3 Hz, K = {COUPLING.stiffness:g} N/m, "
            f"B = {COUPLING.damping:g} N s/m, m = {MASS:g} kg, T = 1 ms.",
        ),
        curves=(
            Curve(
                "implicit_euler",
                "Left: energy created (+) or lost (−) in MuJoCo. Right: single steps of (15).",
                figure,
            ),
        ),
        checks=(
            Check(
                equation="(16)",
                quantity="largest |E_k + T²f²/(2m)| over the largest |E_k|, 2000 random forces",
                route="E_k by its definition (11)",
                expected=0.0,
                got=float(np.abs(motion.energy_gain + squared).max()) / scale,
                tolerance=1e-9,
            ),
            Check(
                equation="(16)",
                quantity="largest E_k of a step",
                route="MuJoCo in the loop, discrete",
                expected=0.0,
                got=float(gains.max()),
                unit="J",
                # the ledger's sums of millijoules round at 1e-18
                tolerance=1e-15,
                relation="at most",
            ),
            Check(
                equation="(16)",
                quantity=f"Σ E_k in {SECONDS:g} s, −Σ T²f²/(2m)",
                route="MuJoCo in the loop, discrete",
                expected=float(expected.sum()),
                got=float(gains.sum()),
                unit="J",
                tolerance=1e-9,
            ),
            Check(
                equation="(16)",
                quantity="applied force, j = 1: Σ E_k, +Σ T²f²/(2m)",
                route="MuJoCo, Euler; storage after the force has acted",
                expected=float(predicted.sum()),
                got=float(applied_gains.sum()),
                unit="J",
                tolerance=1e-9,
            ),
            Check(
                equation="(14)",
                quantity="applied force, j = 1: Σ E_k by (11) itself, the same but for ½mv²",
                route="MuJoCo, Euler",
                expected=float(predicted.sum()),
                got=applied,
                unit="J",
                # the storages differ by one step, at the end by 6 nJ here
                tolerance=1e-4,
            ),
        ),
    )


def _applied_force_gains(handle: _Array) -> tuple[float, _Array, _Array]:
    """Runs the mass under an applied force; Σ E_k of (11), E_k by j = 1's storage, T²f²/(2m)."""
    mass = AppliedForceMass(COUPLING, PERIOD, MASS)
    # position and velocity at the samples, force at the sample that it was computed from
    x, v, f = np.zeros((3, len(handle) + 1))
    for k, target in enumerate(handle, start=1):
        x[k], v[k] = mass.motion
        f[k] = mass.force(float(target))
    stored = 0.5 * MASS * np.append(v, mass.motion[1]) ** 2
    work = f[1:] * np.diff(x)
    by_definition = float(np.sum(np.diff(stored[:-1]) - work))
    return by_definition, np.diff(stored)[1:] - work, PERIOD**2 * f[1:] ** 2 / (2 * MASS)
