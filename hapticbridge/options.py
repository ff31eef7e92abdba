"""What a run is made of: device, scene, coupling, method, guard, checked against each other."""

from __future__ import annotations

from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.certificate import default_coupling, required_axis_damping
from hapticbridge.clock import Clock, RealClock, period_of
from hapticbridge.commands import CommandQueue, CouplingLimits
from hapticbridge.coupling import Coupling
from hapticbridge.device import Device, DeviceInfo, device_for
from hapticbridge.errors import RecordingError
from hapticbridge.guard import (
    UNLIMITED,
    Limits,
    button_mask,
    guard_parameters_for,
    limits_for,
    refuse_simulated_time,
)
from hapticbridge.inputs import Write
from hapticbridge.kernel.parameters import (
    UNGUARDED,
    GuardParameters,
    RunParameters,
    checked_substeps,
    refuse_substeps,
    rotation_numbers,
)
from hapticbridge.pose import IDENTITY_POSE
from hapticbridge.realtime import wants_real_time
from hapticbridge.record import SAMPLE_DTYPE
from hapticbridge.recording.recorder import RingObserver
from hapticbridge.rendering import (
    Method,
    default_method,
    method_named,
    require_hazard_consent,
    resolve_contact_stiffness,
)
from hapticbridge.scene import Scene, load_scene

# Map between the device's frame and the scene's, and the run parameters of a start.
#
# The live loop, the closed-loop sweeps and the studies build their parameters here. One method
# on one device therefore has equal parameters in all of them.


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
    guarding: GuardParameters = UNGUARDED,
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
        contact_stiffness=resolve_contact_stiffness(method, coupling, contact_stiffness),
        device_damping=burning,
        device_rotational_damping=rotational,
        guarding=guarding,
    )


class Arrangement:
    """What a run is made of, chosen where it was left open and refused where it cannot be.

    A device that it opened itself is let go if something else is refused.

    Attributes:
        scene: The loaded scene.
        device: The device, open but not started.
        coupling: K and B that should be felt.
        method: How the tool is rendered.
        clock: What gives the ticks their time.
        period: T in s.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        device: Device | str = "simulated",
        coupling: Coupling | None = None,
        *,
        rate: float = 1000.0,
        substeps: int = 1,
        method: str | None = None,
        contact_stiffness: float | None = None,
        i_know: bool = False,
        recording: str | Path | None = None,
        clock: Clock | None = None,
        scale: float = 1.0,
        force_scale: float | None = None,
        axes: ArrayLike | None = None,
        absolute: bool = False,
        limits: Limits | None = None,
        controller: str | None = None,
        clutch: int | None = None,
        dead_man: int | None = None,
        live: bool = False,
        onlooker: RingObserver | None = None,
        pipelined: bool | None = None,
        realtime: bool | None = None,
        mark: int | None = None,
    ) -> None:
        """Checks everything that can be checked before the device is started.

        Args:
            scene: A loaded scene, a name, or a path to MJCF.
            device: A device, or what ``open_device`` understands.
            coupling: K and B that should be felt; None chooses the stiffest safe one for the
                device's damping (80 % of the bound, a quarter of b used as damping, less where
                substeps need it; for a device of unknown damping, that of the default simulated
                one).
            rate: Ticks per second, 1 to 1e6.
            substeps: MuJoCo steps per tick, 1 to 100. With more than one the mean of their wrenches
                is sent, and the device needs another damping: ``certificate.required_damping``.
            method: How the tool is rendered; see ``rendering.METHODS``. None: ``lossless``, or with
                substeps, which that does not take, ``implicit``.
            contact_stiffness: K_c in N/m of method ``direct``; None takes the coupling's stiffness.
            i_know: Accept a method that may kick (``Method.hazard``) on a real device.
            recording: File to write (``.mcap``), or None; an existing file is replaced.
            clock: ``RealClock()`` by default; ``SimulatedClock()`` runs as fast as it goes.
            scale: Handle motion per device motion.
            force_scale: Force on the device per force on the tool; None takes ``scale``, which
                keeps power equal on both sides.
            axes: 3 × 3 rotation from the device's frame to the scene's.
            absolute: Take the device's poses as poses in the scene instead of relative to its
                start.
            limits: Limits on the wrench, within the device's own; None takes these.
            controller: Passivity controller: ``damper`` acts where the device was given more than
                its damping burns and the scene gives up, ``environment`` where the scene created
                more than the coupling's slack; ``off``. None: ``damper`` where the device
                condition does not hold, else ``environment``.
            clutch: Number of the device's button, from 0, that lets it move without the handle.
            dead_man: Number of the button that must be held for any force.
            live: Draw a status line on stderr, from the recorder's process.
            onlooker: Who looks at the run from another process, as ``view.Window`` does; it is
                started when the bridge is entered and closed when it is left.
            pipelined: Compute what needs no new sample once the wrench is out, where scene and
                method let it (``kernel.ahead``): the same numbers to the bit, the wrench sooner,
                the whole tick 5 % longer. Between two ticks ``scene.data`` then holds the contacts
                of the new positions, without forces. None: in real time, where a device waits.
            realtime: Ask the system for real time while the loop runs (``realtime.real_time``);
                what it refuses is warned of once, with the command that grants it. None: for a real
                device.
            mark: Number of the button that writes an event ``mark`` into the recording each time it
                is pressed.

        Raises:
            HapticBridgeError: An argument is out of range; the message says which and what is
                valid.
        """
        self.scene = scene if isinstance(scene, Scene) else load_scene(scene)
        self.period = period_of(rate)
        self._substeps = checked_substeps(substeps)
        self.method = default_method(substeps) if method is None else method_named(method)
        refuse_substeps(self.method.scheme, substeps)
        self._workspace = Workspace.of(scale, force_scale, axes, is_absolute=absolute)
        self._path = Path(recording) if recording is not None else None
        self._is_live, self._onlooker = live, onlooker
        self._mark_button = button_mask(mark, "mark")
        if self._mark_button and self._path is None:
            raise RecordingError(
                f"button {mark} is to mark moments of a recording, but nothing is recorded; name a "
                "file to record to"
            )
        self.clock = clock or RealClock()
        self._is_pipelined = self.clock.name == RealClock.name if pipelined is None else pipelined
        with ExitStack() as refused:
            if isinstance(device, str):
                refuse_simulated_time(device, self.clock)
                device = device_for(self.scene, device)
                refused.callback(device.close)  # else nobody could, if it is refused
            self.device = device
            self.coupling = coupling or default_coupling(
                device.info,
                self.period,
                self._workspace.scale,
                self._workspace.force_scale,
                self.laws,
                self.method,
            )
            self._limits = limits_for(device.info, limits)
            self._guarding = guard_parameters_for(
                device.info,
                self._limits,
                self.period,
                needed=required_axis_damping(
                    device.info,
                    self.used,
                    self.period,
                    self._workspace.scale,
                    self._workspace.force_scale,
                    self.laws,
                    self.method,
                ),
                scale=self._workspace.scale,
                controller=controller,
                clutch=clutch,
                dead_man=dead_man,
                is_absolute=self._workspace.is_absolute,
            )
            require_hazard_consent(self.method, is_real=device.info.is_real, i_know=i_know)
            # refused here already
            resolve_contact_stiffness(self.method, self.coupling, contact_stiffness)
            refuse_simulated_time(device.info, self.clock)
            self._is_realtime = wants_real_time(realtime, self.clock, is_real=device.info.is_real)
            refused.pop_all()
        self._contact_stiffness = contact_stiffness
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._inputs: deque[list[Write]] = deque()
        # who wants the run to end, and the signal's name if one does; other threads append
        self._stops: deque[tuple[str, str]] = deque()
        allowance = CouplingLimits(
            info=self.device.info,
            method=self.method,
            start=self.rendered,
            period=self.period,
            scale=self._workspace.scale,
            force_scale=self._workspace.force_scale,
            substeps=self._substeps,
            limits=self._limits,
        )
        self._commands = CommandQueue(allowance, is_recorded=self._path is not None)

    @property
    def used(self) -> Coupling:
        """The coupling whose law gives the wrench; ``coupling`` is what should be felt."""
        return self.method.used(self.coupling, self.period / self._substeps)

    @property
    def rendered(self) -> Coupling:
        """``coupling``, but for damping below what the method can show; ``Method.rendered``."""
        return self.method.rendered(self.used, self.period / self._substeps)

    @property
    def reach(self) -> float:
        """Distance of the device in m from the origin of its frame that ends handle and force."""
        return self._guarding.reach

    @property
    def laws(self) -> int:
        """How often per tick the wrench on the tool is computed."""
        return self.method.laws(self._substeps)
