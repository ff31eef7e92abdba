"""Records and energies of a run, prepared for plots and rules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.energy import energy_balances
from hapticbridge.audit.events import AuditedRun, AuditState
from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import printable
from hapticbridge.kernel.codes import JOINT
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.plotting import new_figure, write_picture
from hapticbridge.record import due_times, force_on_hand
from hapticbridge.recording import Recording
from hapticbridge.recording.reader import BLOCK
from hapticbridge.rendering import Method, RunCoupling
from hapticbridge.run_description import method_of, parameters_of, requested_of
from hapticbridge.summary import was_always_implicit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Curves of a recording over time, reduced without loss of peaks


BINS = 1500
"""Largest number of bins per curve. Each bin draws its minimum and maximum, so no peak is lost.
More bins enlarge the file without a visible gain."""

AXES = ("x", "y", "z")
COLOURS = ("#d55e00", "#009e73", "#0072b2")
"""Colours of the axes: vermilion, green and blue, distinct for colour-blind readers (Okabe &
Ito)."""

DRAWABLE = 1e9
"""Largest magnitude in N, m or J that is drawn; a larger one is not physical and breaks the plot's
axes."""

_ENERGIES = (
    ("coupling_work", "work of the coupling", "#0072b2", "-"),
    ("environment_energy", "created (+) or dissipated (−)", "#009e73", "-"),
    ("device_energy", "given to the device", "#e69f00", "-"),
    ("actuator_work", "work of the scene's motors", "#cc79a7", "-"),
    ("external_work", "work of inputs and resets", "#56b4e9", "-"),
    ("kinetic", "kinetic", "#555555", "--"),
    ("potential", "potential, from the start", "#a08000", "--"),
)
"""Energies that are drawn. The dashed ones are stored: together they grow by the sum of the works
and of what was created."""
_DRAWN = (
    "wrench_on_tool",
    "wrench_on_device",
    "tool_position",
    "handle_position",
    *(name for name, *_ in _ENERGIES),
)


HANDLE = {"lw": 5.0, "alpha": 0.3, "solid_capstyle": "butt"}
"""Line of the handle: broad and pale, so that it is seen on both sides of the tool's."""


def decimated(
    time: NDArray[np.float64], values: NDArray[np.float64], bins: int = BINS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Keeps the minimum and the maximum of each bin, in their order.

    Args:
        time: Shape (n,), n >= 1.
        values: Shape (n,).
        bins: Number of bins, >= 1.

    Returns:
        At most 2 bins + 1 times and values.
    """
    size = -(-len(values) // bins)
    if size <= 2:
        return time, values
    count = len(values) // size
    blocks = values[: count * size].reshape(count, size)
    picks = np.sort(np.stack([blocks.argmin(1), blocks.argmax(1)], axis=1), axis=1)
    index = (picks + size * np.arange(count)[:, None]).ravel()
    if rest := len(values) - count * size:  # a fault often lies at the end of a run
        last = values[-rest:]
        index = np.append(index, count * size + np.sort([last.argmin(), last.argmax()]))
    index = np.append(index, len(values) - 1)
    return time[index], values[index]


def is_motion_prescribed(meta: Mapping[str, str]) -> bool:
    """Returns True if no hand felt the recorded forces, or if the data sheet is damaged."""
    try:
        return DeviceInfo.from_json(meta.get("device", "")).is_prescribed
    except HapticBridgeError:
        return True


def draw_recording(*hands: Recording) -> Figure:
    """Draws force, position and energies over time; of several hands, each in a column.

    Raises:
        RecordingError: The recording has no tick, no run parameters, or a number that cannot be
            drawn.
    """
    has_several_hands = len(hands) > 1
    figure = new_figure(5.5 * len(hands) if has_several_hands else 8, 8)
    columns = figure.subplots(3, len(hands), sharex=True, squeeze=False).T
    for recording, panels in zip(hands, columns, strict=True):
        _draw_hand(recording, panels, has_several_hands=has_several_hands)
    meta = hands[0].meta
    method, period = method_of(meta), parameters_of(meta).period
    title = printable(f"{meta.get('scene', '')}: method {method.name}, {1 / period:g} Hz")
    if not has_several_hands:
        title += f"\n{_coupling_sentence(hands[0])}"
    figure.suptitle(title, fontsize="medium", parse_math=False)
    return figure


def recorded_coupling(recording: Recording) -> RunCoupling:
    """Returns the coupling of a run at its start; for a joint, at the fingers.

    Raises:
        RecordingError: The recording does not describe it.
    """
    meta, parameters = recording.meta, parameters_of(recording.meta)
    return RunCoupling.of(
        method_of(meta),
        parameters.timestep,
        requested_of(meta),
        law=parameters.coupling,
        measured=parameters.effective,
        is_always_implicit=was_always_implicit(recording.ticks),
    ).felt_at(parameters.grip, parameters.scale, parameters.force_scale)


def _coupling_sentence(recording: Recording) -> str:
    return recorded_coupling(recording).sentences()[0]


def _draw_hand(
    recording: Recording, panels: NDArray[np.object_], *, has_several_hands: bool
) -> None:
    ticks, meta = recording.ticks, recording.meta
    if not len(ticks):
        raise RecordingError(f"'{recording.path}' has no tick to draw")
    parameters = parameters_of(meta)
    if not all((np.abs(ticks[name]) < DRAWABLE).all() for name in _DRAWN):
        raise RecordingError(f"'{recording.path}' holds numbers that cannot be drawn")
    time = due_times(ticks, parameters.period)
    force_axes, position_axes, energy_axes = panels
    position_axes.plot([], [], color="grey", **HANDLE, label="handle")
    hand = force_on_hand(ticks, parameters.axes)
    is_held = not is_motion_prescribed(meta)
    is_joint = parameters.grip.startswith(JOINT)
    unit = 1.0 if is_joint else 1e3
    for i, (axis, colour) in enumerate(zip(AXES[:1] if is_joint else AXES, COLOURS, strict=False)):
        tool_force = decimated(time, ticks["wrench_on_tool"][:, i])
        if is_held:
            force_axes.plot(*decimated(time, hand[:, i]), color=colour, label=f"hand {axis}")
        force_axes.plot(*tool_force, color=colour, ls=":", lw=1, label=f"tool {axis}")
        start = ticks["tool_position"][0, i]
        tool = unit * (ticks["tool_position"][:, i] - start)
        handle = unit * (ticks["handle_position"][:, i] - start)
        position_axes.plot(*decimated(time, tool), color=colour, label=f"tool {axis}")
        position_axes.plot(*decimated(time, handle), color=colour, **HANDLE)
    for name, label, colour, style in _ENERGIES:
        joules = ticks[name] - (ticks[name][0] if name == "potential" else 0.0)
        if joules.any():
            energy_axes.plot(*decimated(time, 1e3 * joules), color=colour, ls=style, label=label)
    force_axes.set_ylabel("force on hand and tool (N)" if is_held else "force on the tool (N)")
    position_axes.set_ylabel("displacement (mm)")
    if is_joint:
        force_axes.set_ylabel("force on the fingers (N), on the joint (N or N m)")
        position_axes.set_ylabel("displacement of the joint (m or rad)")
    energy_axes.set_ylabel("energy (mJ)")
    energy_axes.set_xlabel("time (s)")
    for axes in panels:
        finish(axes)
    if has_several_hands:
        head = f"{printable(parameters.grip)}: {_coupling_sentence(recording)}"
        head = head.partition(" effective")[0]
        force_axes.set_title(head, fontsize="small", loc="left", pad=46, parse_math=False)


def finish(axes: Axes) -> None:
    """Adds the grid, and a legend above the curves."""
    axes.grid(alpha=0.3)
    axes.margins(x=0.01)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), fontsize="small", ncols=4, frameon=False)


def plot_recording(path: Path, *hands: Recording) -> None:
    """Writes ``draw_recording`` to a picture file.

    Raises:
        RecordingError: The recording cannot be drawn.
        HapticBridgeError: The file's extension is no picture format, or it cannot be written.
    """
    write_picture(draw_recording(*hands), path)


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Evidence:
    """A run of n ticks that can be drawn.

    Attributes:
        recording: The recording, with n >= 1 ticks.
        parameters: Run parameters.
        worst: Run parameters with the most demanding coupling that commands selected.
        info: The device.
        method: The rendering method.
        time: Due time of each tick in s on the clock of the events, (n,).
        created: Energy that the environment has created so far, (n,) in J.
        allowed: Slack: energy that the environment may have created so far, (n,) in J.
        excess: Energy given to the device beyond its dissipation and what scene and coupling
            released, so far, (n,) in J; zeros if it cannot be computed
            (``EnergyBalance.excess_device_energy``).
        model: The compiled scene, in the process that may compile it; else None.
    """

    recording: Recording
    parameters: RunParameters
    worst: RunParameters
    info: DeviceInfo
    method: Method
    time: Array
    created: Array
    allowed: Array
    excess: Array
    model: mujoco.MjModel | None = None

    @property
    def ticks(self) -> NDArray[np.void]:
        """Records, ``TICK_DTYPE``, (n,)."""
        return self.recording.ticks

    @property
    def events(self) -> list[dict[str, Any]]:
        """Recorded events."""
        return self.recording.events

    @property
    def requested(self) -> Coupling:
        """Smallest requested coupling that leads to ``worst``.

        If the law's damping is 0, the method removed all requested damping, which may have had any
        value up to the effective one. It then counts as 0.
        """
        law, step = self.worst.coupling, self.worst.timestep
        requested = self.method.requested_coupling(law, step)
        return replace(
            requested,
            damping=requested.damping if law.damping else 0.0,
            rotational_damping=requested.rotational_damping if law.rotational_damping else 0.0,
        )

    @property
    def lateness(self) -> Array:
        """Delay of each tick's start after its deadline, (n,) in s."""
        return np.asarray(1e-9 * (self.ticks["wake_ns"] - self.ticks["deadline_ns"]))

    def judged(self, report: AuditReport) -> tuple[Array, Array]:
        """Returns the energy of the port at fault and its bound, (n,) in J each.

        The verdict must be ``active``.
        """
        if report.port == "device":
            return self.excess, np.zeros_like(self.excess)
        # a strict audit grants no slack
        is_slack_used_up = report.environment == "active"
        return self.created, self.allowed if is_slack_used_up else np.zeros_like(self.allowed)

    @classmethod
    def of_hands(cls, hands: Sequence[Recording]) -> tuple[Evidence, ...]:
        """Computes the evidence of every hand; empty if one is damaged or has no ticks.

        The slack of the scene is that of all hands together.
        """
        found = []
        for hand in hands:
            others = [other for other in hands if other is not hand]
            evidence = cls.of(hand, others)
            if evidence is None:
                return ()
            found.append(evidence)
        allowed = np.sum([each.allowed for each in found], axis=0)
        return tuple(replace(each, allowed=allowed) for each in found)

    @classmethod
    def of(cls, recording: Recording, others: Sequence[Recording] = ()) -> Evidence | None:
        """Computes the evidence of a recording; None if it is damaged or has no ticks.

        The recording need not have passed an audit. ``others`` are those of the other hands, whose
        work on the scene counts.
        """
        ticks = recording.ticks
        fields = (name for name in ticks.dtype.names or () if ticks.dtype[name].base.kind == "f")
        if not len(ticks) or not all((np.abs(ticks[name]) < DRAWABLE).all() for name in fields):
            return None
        try:
            run = AuditedRun.of(recording)
            worst = run.worst
            state = AuditState.at_start(recording, run.parameters)
            # by blocks, because the whole run at once would need much more memory
            begins = range(0, len(ticks), BLOCK)
            blocks = (ticks[begin : begin + BLOCK] for begin in begins)
            work = None
            if others:
                total = np.sum([other.ticks["coupling_work"] for other in others], axis=0)
                work = (total[begin : begin + BLOCK] for begin in begins)
            balances = energy_balances(blocks, state, run.events, run.delay, work)
            energies = np.concatenate(
                [
                    (each.environment_energy, each.slack, each.excess_device_energy)
                    for _, each in balances
                ],
                axis=1,
            )
        except HapticBridgeError:
            return None
        return cls(
            recording=recording,
            parameters=run.parameters,
            worst=worst,
            info=run.info,
            method=run.method,
            time=due_times(ticks, run.parameters.period),
            created=energies[0],
            allowed=energies[1],
            excess=energies[2],
        )
