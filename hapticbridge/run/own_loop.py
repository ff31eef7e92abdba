"""Port to a device with a loop of its own: the tool is shown to it, and it reports its force.

    read:   the newest pose, and the wrench that the device had there (kernel: ``reported``)
    write:  the tool of the step that just ended, its surfaces and W, what the scene has taken

The device's loop renders the coupling at its own period; its account is that of
``kernel.shown_tool``. The scene is pulled at by the same coupling in the bridge's tick, so W is
exact. The force follows the lever: on its way to 0 it fades on the device, which renders a lower
one softer.
"""

from __future__ import annotations

import base64
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticbridge.demand.own_loop import COUNTERS, REPORT_DTYPE, TEMPERATURES, OwnLoopTally
from hapticbridge.device.own_loop import (
    SURFACES,
    BoardSetting,
    LoopDevice,
    LoopState,
    ShownTool,
)
from hapticbridge.kernel.jit import direct
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.pose import (
    Quaternion,
    canonical,
    product,
    quaternion_exp,
    quaternion_log,
)
from hapticbridge.kernel.shown_tool import FASTEST, FASTEST_TURN, shown_to_device
from hapticbridge.kernel.state import BoundKernel

AGILITY = 0.05
"""Share of a new measurement of the delay that is taken over at once, without unit."""

_LINES, _TURNS = ("stiffness", "damping"), ("rotational_stiffness", "rotational_damping")
_WAY, _TWIST, _PLANES = 0, 7, 13
"""Places of motions along lines, of rotations and of surfaces in what ``shown_to_device`` finds."""

_UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)

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
        self._numbers = np.zeros(_PLANES + 4 * SURFACES)
        self._lead = lead = device.info.delay or 0.0  # to the coming of what answers a sample
        self._is_posed = device.is_posed
        self._turns = not (device.info.moves or device.is_posed)
        self._part = slice(3, 6) if self._turns else slice(0, 3)
        power = parameters.force_limit * FASTEST, parameters.torque_limit * FASTEST_TURN
        fastest = sum(power) if self._is_posed else power[self._turns]
        self._passing = 2.0 * fastest * (parameters.period + lead)
        self._turn = _UPRIGHT
        self._show = direct(shown_to_device, bound.state, lead, self._numbers)
        loop, guard = bound.state["loop"], bound.state["guard"]
        self._reported, self._tick = loop["reported"][0], loop["tick"]
        self._lever, self._rise_ticks = guard["lever"], guard["rise_ticks"]
        self._cap, self._coupling = bound.state["watch"]["max_lever"], bound.state["coupling"]
        self._told_tick = 0
        self._works, self._least_works = np.zeros(_REMEMBERED), np.zeros(_REMEMBERED)
        self._sent = np.full(_REMEMBERED, -1, np.int64)
        self._least_work = self._least_known = 0.0  # of all that was sent, of all that was answered
        self._reports: list[tuple[int, float, float, float]] = []
        self.begin()
        self.tally = OwnLoopTally.begin(parameters.loop_period, parameters.guarding.resolution)

    def begin(self) -> None:
        """Begins a run, or goes on with it: the device has no coupling and no tool."""
        self._told: tuple[float, ...] = ()
        self._is_followed, self._last_lever = False, 0.0

    def read(self, sample: NDArray[np.void]) -> int:
        """Reads the newest pose and the wrench there, as ``Device.read``."""
        flags = self._device.read(sample)
        self._turn = tuple(sample["quaternion"][0].tolist())
        state = self._device.loop_state
        if state is None:  # it follows no tool yet, and has no force
            self._reported[:] = 0.0
            return flags
        self._reported[self._part], self._is_followed = state.force, True
        if self._is_posed:
            self._reported[3:] = state.torque
        place, tick = state.echo % _REMEMBERED, int(self._tick[0])
        self._note(place, tick, state)
        if self._sent[place] >= 0 and not flags:
            took = self._parameters.period * float(tick - self._sent[place])
            self._lead += AGILITY * (took - self._lead)
        return flags

    def _note(self, place: int, tick: int, state: LoopState) -> None:
        """Notes a report; and first the least W among tools that no report has answered."""
        least = float(self._least_works[place])
        if least < min(self._least_known, float(self._works[place])):
            self._reports.append((tick, least, state.passed, state.tank))
        self._least_known = min(self._least_known, least)
        self._reports.append((tick, float(self._works[place]), state.passed, state.tank))

    def write(self, _wrench: NDArray[np.float64]) -> None:
        """Shows the tool of the step that just ended, in the place of ``Device.write``."""
        lever, cap = float(self._lever[0]), float(self._cap[0])
        is_rising, is_falling = lever > self._last_lever, lever < min(self._last_lever, cap)
        self._last_lever = lever
        self._tell(cap, is_rising=is_rising)
        count = self._show(self._state, self._lead, self._numbers)
        numbers = self._numbers.tolist()
        work, planes = numbers[6], numbers[_PLANES:]
        first = _TWIST if self._turns else _WAY
        way, velocity = numbers[first : first + 3], numbers[first + 3 : first + 6]
        surfaces = tuple(
            ((nx, ny, nz), gap)
            for nx, ny, nz, gap in zip(*[iter(planes[: 4 * count])] * 4, strict=True)
        )
        shown = ShownTool(
            tuple(map(add, self._device.place, way)),
            tuple(velocity),
            work,
            surfaces,
            is_placed=not self._is_followed,
            is_enabled=lever > 0.0 and not is_falling,
        )
        if self._is_posed:
            x, y, z, *turning = numbers[_TWIST:_PLANES]
            orientation = canonical(product(quaternion_exp((x, y, z)), self._turn))
            shown = shown._replace(
                rotation=quaternion_log(orientation), angular_velocity=tuple(turning)
            )
        place = self._device.show(shown) % _REMEMBERED
        self._works[place], self._sent[place] = work, self._tick[0]
        self._least_work = self._least_works[place] = min(self._least_work, work)

    def _tell(self, cap: float, *, is_rising: bool) -> None:
        """Tells the device its coupling, when that changes and now and then."""
        setting = self._setting(cap, is_rising=is_rising)
        tick = int(self._tick[0])
        is_old = not self._is_followed or tick - self._told_tick >= _REPEAT
        if is_old or setting != self._told:
            self._told, self._told_tick = setting, tick
            self._device.set_loop(setting)

    def _setting(self, cap: float, *, is_rising: bool) -> BoardSetting:
        """Returns the coupling at the device; with a lever r it is r² as stiff."""
        own = self._parameters
        ticks = self._rise_ticks[0] + 1 if is_rising else own.guarding.fade_ticks
        lines = self._gains(_LINES, own.scale * own.force_scale, own.force_limit, cap)
        turns = self._gains(_TURNS, own.force_scale / own.scale, own.torque_limit, cap)
        passing, fade = cap * self._passing, own.period * int(ticks)
        if self._turns:
            lines = turns
        return BoardSetting(*lines, passing, fade, 0.0, *(turns if self._is_posed else ()))

    def _gains(
        self, names: tuple[str, str], ratio: float, limit: float, cap: float
    ) -> tuple[float, float, float]:
        """Returns stiffness, damping and level at the device along one kind of axis."""
        coupling = self._coupling
        gains = coupling["tuning_goal"] if coupling["tuning_ticks"][0] else coupling
        stiffness, damping = (ratio * cap * cap * float(gains[name][0]) for name in names)
        return stiffness, damping, cap * limit

    def take_notes(self) -> dict[str, Any] | None:
        """Returns the details of an event on the reports since the last call, or None."""
        if not self._reports:
            return None
        reports, self._reports = np.array(self._reports, REPORT_DTYPE), []
        counters = self._device.loop_report
        numbers = {} if counters is None else counters._asdict()
        known = (*COUNTERS, *TEMPERATURES)
        told = {name: numbers[name] for name in known if numbers.get(name) is not None}
        self.tally.add(reports, told)
        return {"reports": base64.b64encode(reports.tobytes()).decode(), **told}
