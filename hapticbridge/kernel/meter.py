"""The coupling's port: storage after a step, the work of the coupling, and what is allowed.

What the environment may have created until tick k is held against BC97 (14) and against the slack
that the coupling leaves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hapticbridge.jit import compiled
from hapticbridge.kernel.native import (
    floats,
    mj_com_pos,
    mj_energy_pos,
    mj_energy_vel,
    mj_fwd_kinematics,
    mj_kinematics,
    mj_make_m,
)
from hapticbridge.pose import dot, vector_of

ENERGY_TOLERANCE = 1e-9
"""An environment is strict while Σ E_k <= 1e-9 J + 1e-9 Σ|f·δx|: rounding of a sum of many small
works, not physics. Larger hides real creation, smaller reports rounding."""


@compiled
def refresh_poses(state: NDArray[np.void]) -> None:
    """Brings the bodies' poses to the state after the step (``mj_step`` leaves those before)."""
    s = state[0]
    mj_kinematics(s.model, s.data)


@compiled
def refresh_energies(state: NDArray[np.void]) -> None:
    """Brings the energies to the state after the step.

    Kinetic energy needs the inertia matrix, potential energy the positions and, where there are
    any, tendon lengths. Where MuJoCo's position stage has run since the step, all that is there.
    """
    s = state[0]
    if not s.has_positions:
        if s.has_tendons_or_flexes:
            mj_fwd_kinematics(s.model, s.data)
        else:
            mj_com_pos(s.model, s.data)
        mj_make_m(s.model, s.data)
    mj_energy_pos(s.model, s.data)
    mj_energy_vel(s.model, s.data)
    energy = floats(s.energy, 2)
    s.potential, s.kinetic = energy[0], energy[1]


@compiled
def add_coupling_work(state: NDArray[np.void], work: float) -> None:
    """Adds f·δx + τ·δφ to the coupling's port, for as long as that wrench acted."""
    s = state[0]
    s.coupling_work += work
    s.throughput += abs(work)


@compiled
def judge_environment(state: NDArray[np.void]) -> None:
    """Closes the tick's balance and holds the environment against (14) and the slack.

    E_k = S_k − S_{k−1} − (f_k·δx_k + τ_k·δφ_k) − actuators − external
    slack_k = Σ ½ g ‖δx_k‖² + ½ g_r ‖δφ_k‖²

    with the gains of ``RunParameters.slack_gains``: K + B/T and K_r + B_r/T with one law a tick.

    Where there is no coupling law (a weld, a tool without mass), the environment may satisfy (14)
    and the device still be kicked: there, what it was given is held against what its damping burns,
    b ‖δp_k‖² over the time between two samples at least, and against what the scene gave up.
    """
    s = state[0]
    moved, turned = vector_of(s.motion), vector_of(s.motion[3:6])
    s.slack += 0.5 * s.slack_stiffness * dot(moved, moved)
    s.slack += 0.5 * s.slack_rotational_stiffness * dot(turned, turned)
    stored = (s.kinetic + s.potential) - s.start_energy
    s.environment_energy = stored - s.coupling_work - s.actuator_work - s.external_work
    allowed = ENERGY_TOLERANCE * (1.0 + s.throughput)
    if s.watches_device:
        # what left the scene towards the device must come from the scene, or be burnt there
        gained = (s.force_scale / s.scale) * (stored - s.actuator_work - s.external_work)
        if s.first_kick < 0 and s.device_energy - s.device_burnt + gained > allowed:
            s.first_kick = s.tick
    if s.environment_energy > allowed:
        if s.first_unstrict < 0:
            s.first_unstrict = s.tick
        s.slack_share = max(s.slack_share, s.environment_energy / (s.slack + allowed))
        if s.environment_energy > s.slack + allowed and s.first_active < 0:
            s.first_active = s.tick
