"""Port to a device with a loop of its own: the tool is shown to it, and it reports its force.

    read:   the newest pose, and the wrench that the device had there (kernel: ``reported``)
    write:  the tool of the step that just ended, its surfaces and W, what the scene has taken

The device's loop renders the coupling at its own period; its account is that of
``kernel.shown_tool``. The scene is pulled at by the same coupling in the bridge's tick, so W is
exact. The force follows the lever: at 0 it fades on the device, and a lowered one softens it.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.demand.own_loop import COUNTERS, REPORT_DTYPE, OwnLoopTally
from hapticbridge.device.own_loop import SURFACES, BoardSetting, LoopDevice, ShownTool
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.shown_tool import FASTEST, FASTEST_TURN, shown_to_device
from hapticbridge.kernel.state import BoundKernel

AGILITY = 0.05
"""Share of a new measurement of the delay that is taken over at once, without unit."""

_LINES, _TURNS = ("stiffness", "damping"), ("rotational_stiffness", "rotational_damping")

_REMEMBERED = 256
"""Shown tools whose work is kept until the device has answered them."""

_REPEAT = 100
"""Ticks after which the coupling is told again, for a link that may lose a message."""


class OwnLoop:
    """Port of a run to a device with a loop of its own, in the place of ``read`` and ``write``.

    Args:
        device: The device, started.
        bound: The bound kernel of the run.
        parameters: Parameters of the run.

    Attributes:
        tally: Account of what the loop has reported.
    """

    def __init__(self, device: LoopDevice, bound: BoundKernel, parameters: RunParameters) -> None:
        self._device, self._state = device, bound.state
        self._parameters = parameters
        self._numbers = np.zeros(7 + 4 * SURFACES)
        self._lead = lead = device.info.delay or 0.0  # to the coming of what answers a sample
        self._turns = not device.info.moves
        self._part = slice(3, 6) if self._turns else slice(0, 3)
        self._limit, fastest = parameters.force_limit, FASTEST
        self._ratio, self._names = parameters.scale * parameters.force_scale, _LINES
        if self._turns:
            self._limit, fastest = parameters.torque_limit, FASTEST_TURN
            self._ratio, self._names = parameters.force_scale / parameters.scale, _TURNS
        self._passing = 2.0 * self._limit * fastest * (parameters.period + lead)
        self._show = direct(shown_to_device, bound.state, lead, self._numbers)
        loop, guard = bound.state["loop"], bound.state["guard"]
        self._reported, self._tick = loop["reported"][0], loop["tick"]
        self._lever, self._cap = guard["lever"], bound.state["watch"]["max_lever"]
        self._coupling, self._level = bound.state["coupling"], bound.state["level"]["level"][0]
        self._told: tuple[float, ...] = ()
        self._told_tick, self._is_followed, self._last_lever = 0, False, 0.0
        self._works, self._sent = np.zeros(_REMEMBERED), np.full(_REMEMBERED, -1, np.int64)
        self._reports: list[tuple[int, float, float, float]] = []
        self.tally = OwnLoopTally.begin(parameters.loop_period, parameters.guarding.resolution)

    def read(self, sample: NDArray[np.void]) -> int:
        """Reads the newest pose and the wrench there, as ``Device.read``."""
        flags = self._device.read(sample)
        state = self._device.loop_state
        if state is None:  # it follows no tool yet, and has no force
            self._reported[:] = 0.0
            return flags
        self._reported[self._part], self._is_followed = state.force, True
        place, tick = state.echo % _REMEMBERED, int(self._tick[0])
        self._reports.append((tick, float(self._works[place]), state.passed, state.tank))
        if self._sent[place] >= 0 and not flags:
            took = self._parameters.period * float(tick - self._sent[place])
            self._lead += AGILITY * (took - self._lead)
        return flags

    def write(self, _wrench: NDArray[np.float64]) -> None:
        """Shows the tool of the step that just ended, in the place of ``Device.write``."""
        self._tell()
        count = self._show(self._state, self._lead, self._numbers)
        dx, dy, dz, vx, vy, vz, work, *planes = self._numbers.tolist()
        x, y, z = self._device.place
        surfaces = tuple(
            ((nx, ny, nz), gap)
            for nx, ny, nz, gap in zip(*[iter(planes[: 4 * count])] * 4, strict=True)
        )
        shown = ShownTool(
            (x + dx, y + dy, z + dz),
            (vx, vy, vz),
            work,
            surfaces,
            is_placed=not self._is_followed,
            is_enabled=self._is_on(),
        )
        place = self._device.show(shown) % _REMEMBERED
        self._works[place], self._sent[place] = work, self._tick[0]

    def _is_on(self) -> bool:
        """Returns False while the lever falls, which the device's own fade then follows."""
        lever, last = float(self._lever[0]), self._last_lever
        self._last_lever = lever
        return lever > 0.0 and not (lever < last and lever < self._cap[0])

    def _tell(self) -> None:
        """Tells the device its coupling, when that changes and now and then."""
        setting = self._setting()
        tick = int(self._tick[0])
        if setting != self._told or tick - self._told_tick >= _REPEAT:
            self._told, self._told_tick = setting, tick
            self._device.set_loop(setting)

    def _setting(self) -> BoardSetting:
        """Returns the coupling at the device; with a lever r it is r² as stiff."""
        own, coupling = self._parameters, self._coupling
        gains = coupling["tuning_goal"] if coupling["tuning_ticks"][0] else coupling
        cap = float(self._cap[0])
        stiffness, damping = (float(gains[name][0]) for name in self._names)
        is_risen = self._lever[0] >= cap
        return BoardSetting(
            stiffness=self._ratio * cap * cap * stiffness,
            damping=self._ratio * cap * cap * damping,
            level=cap * self._limit,
            passing=cap * self._passing,
            fade=own.period * (own.guarding.fade_ticks if is_risen else max(own.ramp_ticks, 1)),
        )

    def take_notes(self) -> dict[str, Any] | None:
        """Returns the details of an event on the reports since the last call, or None."""
        if not self._reports:
            return None
        reports, self._reports = np.array(self._reports, REPORT_DTYPE), []
        counters = self._device.loop_report
        told = {} if counters is None else {name: getattr(counters, name) for name in COUNTERS}
        self.tally.add(reports, told)
        return {"reports": base64.b64encode(reports.tobytes()).decode(), **told}
