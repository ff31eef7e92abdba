"""Map between the device's frame and the scene's, and the run parameters of a start.

The live loop, the closed-loop sweeps and the studies build their parameters here. One method on one
device therefore has equal parameters in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.guard import UNLIMITED, Limits
from hapticbridge.kernel.guarding import UNGUARDED, Guarding
from hapticbridge.kernel.parameters import (
    RunParameters,
    checked_substeps,
    rotation_numbers,
)
from hapticbridge.pose import IDENTITY_POSE
from hapticbridge.rendering import Method, contact_stiffness_of
from hapticbridge.scene import Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Map from the device's frame to the scene's.

        h = h_0 + scale · A (p − p_0),   R_h = A R_p R_p0ᵀ Aᵀ R_h0,   w = −force_scale · Aᵀ f

    p is the device's position in m, h the handle's, f the force on the tool and w the force on the
    device in N. p_0 is the device's start and h_0 the grip's; with absolute poses both are zero.

    Attributes:
        scale: Handle motion per device motion, without unit, finite and > 0.
        force_scale: Force on the device per force on the tool, without unit, finite and > 0.
            ``RunParameters`` checks both ranges.
        axes: A, row by row.
        is_absolute: True if the device's poses are poses in the scene.
    """

    scale: float = 1.0
    force_scale: float = 1.0
    axes: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    is_absolute: bool = False

    @classmethod
    def of(
        cls, scale: float, force_scale: float | None, axes: ArrayLike | None, *, is_absolute: bool
    ) -> Workspace:
        """Builds a workspace from the user's arguments.

        Args:
            scale: Handle motion per device motion.
            force_scale: Force on the device per force on the tool; None takes ``scale``, which
                keeps power equal on both sides.
            axes: 3 × 3 rotation; None is the identity.
            is_absolute: True if the device's poses are poses in the scene.

        Raises:
            HapticBridgeError: The axes are not a right-handed rotation.
        """
        return cls(
            scale=scale,
            force_scale=scale if force_scale is None else force_scale,
            axes=rotation_numbers(np.eye(3) if axes is None else axes),
            is_absolute=is_absolute,
        )


SAME_FRAME = Workspace()
"""Workspace with equal axes and scales; the device starts at the grip."""


def run_parameters(
    scene: Scene,
    coupling: Coupling,
    method: Method,
    first: NDArray[np.void],
    *,
    period: float,
    felt: Coupling | None,
    substeps: int = 1,
    info: DeviceInfo | None = None,
    limits: Limits = UNLIMITED,
    workspace: Workspace = SAME_FRAME,
    contact_stiffness: float | None = None,
    guarding: Guarding = UNGUARDED,
) -> RunParameters:
    """Returns the parameters of a run that starts now.

    Args:
        scene: Scene after ``rendering.prepare``; the handle starts at its grip.
        coupling: Requested coupling.
        method: Rendering method.
        first: The device's first sample, ``SAMPLE_DTYPE``, shape (1,).
        period: T in s.
        felt: Result of ``rendering.prepare``.
        substeps: MuJoCo steps per tick.
        info: The device, for its damping; None if unknown.
        limits: Limits of the wrench.
        workspace: Map from the device's frame to the scene's.
        contact_stiffness: K_c in N/m for a massless tool; None takes the coupling's stiffness.
        guarding: Guard parameters.

    Raises:
        HapticBridgeError: A value is out of range.
    """
    start = tuple(float(v) for v in (*first["position"][0], *first["quaternion"][0]))
    burning, rotational = (None, None) if info is None else info.burning_damping
    return RunParameters(
        grip=scene.grip,
        period=period,
        substeps=substeps,
        coupling=method.used(coupling, period / checked_substeps(substeps)),
        scale=workspace.scale,
        force_scale=workspace.force_scale,
        axes=workspace.axes,
        force_limit=limits.force,
        torque_limit=limits.torque,
        ramp_ticks=limits.ramp_ticks(period),
        device_origin=IDENTITY_POSE if workspace.is_absolute else start,
        handle_origin=IDENTITY_POSE if workspace.is_absolute else scene.grip_pose(),
        device_start=start,
        scheme=method.scheme,
        felt=felt,
        contact_stiffness=contact_stiffness_of(method, coupling, contact_stiffness),
        device_damping=burning,
        device_rotational_damping=rotational,
        guarding=guarding,
    )
