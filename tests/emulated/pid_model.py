"""A force-feedback stick of the USB class PID: a handle in a hand behind its effects.

Written from the standard (Device Class Definition for Physical Interface Devices 1.0); it shares no
code with the driver. A constant force of positive magnitude comes *from* its direction, an angle
from north (away from the user), clockwise; X is to the right, Y towards the user.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from emulated.handle import Handle
from emulated.hid_device import HidDevice
from emulated.pid_layouts import FEATURE, OUT, USUAL, Report, descriptor
from emulated.usb_device import StallError
from hapticbridge.device import SimulatedDevice

_START, _START_ALONE, _STOP = 0x79, 0x7A, 0x7B
_ENABLE, _DISABLE, _STOP_ALL, _RESET, _PAUSE, _CONTINUE = range(0x97, 0x9D)
_CONSTANT, _LOADED, _FULL, _ERROR = 0x26, 0x8C, 0x8D, 0x8E


@dataclass
class Effect:
    """An effect as the device keeps it; times in s, ``ends`` None while it does not play."""

    kind: int
    magnitude: float = 0.0
    direction: float = 0.0
    gain: float = 1.0
    duration: float = math.inf
    ends: float | None = None


class PidStick(HidDevice):
    """Plays constant forces and reports where it stands.

    Args:
        mechanics: What is behind it; None: it stands where ``place`` says.
        layout: Its reports.
        newtons: Force at full scale in N.
        travel: From stop to stop of each axis, in m.
        rate: Reports per second.
        is_chatty: Whether it reports at its rate, or only what has changed.
        room: Effects that it has memory for.

    Attributes:
        place: Deflection to the right and towards the user, each -1 to 1.
        outputs: Output reports that came.
        log: Of each report that came: kind and bytes, while ``is_logging``.
        error: Whether it answers every new effect with an error.
    """

    vendor, product = 0x1209, 0x4801
    manufacturer, product_name = "hapticbridge", "PID test stick"
    endpoint_in: ClassVar[int] = 0x81
    endpoint_out: ClassVar[int | None] = 0x01

    def __init__(
        self,
        mechanics: SimulatedDevice | None = None,
        layout: Mapping[str, Report] = USUAL,
        *,
        newtons: float = 4.0,
        travel: float = 0.08,
        rate: float = 1000.0,
        is_chatty: bool = True,
        room: int = 10,
        most: int | None = None,
        serial: str = "P1",
        buttons: int = 0,
    ) -> None:
        self.report_descriptor = descriptor(layout.values())
        super().__init__()
        self.serial, self.buttons = serial, buttons
        self.layout, self.newtons, self.travel, self.rate = layout, newtons, travel, rate
        self.is_chatty, self.room, self.most = is_chatty, room, room if most is None else most
        self.place = (0.0, 0.0)
        self.effects: dict[int, Effect] = {}
        self.is_enabled, self.is_paused, self.gain = False, False, 1.0
        self.outputs, self.error, self.is_logging = 0, False, False
        self.log: list[tuple[str, bytes]] = []
        self._loaded = (0, _ERROR)
        self._handle = None if mechanics is None else Handle(mechanics)
        self._start: float | None = None
        self._frames = 0
        self._said = b""

    # -- time ------------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        if self._start is None:
            self._start = now
            self._move(now)
        while (due := self._start + (self._frames + 1) / self.rate) <= now + 1e-9:
            self._move(due)
            self._frames += 1
            report = self.input_report(self.layout["state"].number, due)
            if report is not None and (self.is_chatty or report != self._said):
                self.push(report)
                self._said = report
        self._move(now)

    def next_time(self, now: float) -> float | None:
        if self._start is None:
            return now
        return self._start + (self._frames + 1) / self.rate

    def force(self) -> tuple[float, float]:
        """Returns the force of the motors in N, to the right and towards the user."""
        x = y = 0.0
        if self.is_enabled and not self.is_paused:
            for effect in self.effects.values():
                if effect.ends is not None and effect.kind == _CONSTANT:
                    strength = self.newtons * self.gain * effect.gain * effect.magnitude
                    angle = math.radians(effect.direction)
                    x -= strength * math.sin(angle)
                    y += strength * math.cos(angle)
        return x, y

    def _move(self, now: float) -> None:
        """Moves the handle up to a time, with effects ending on the way."""
        ends = sorted(e.ends for e in self.effects.values() if e.ends is not None)
        for end in [end for end in ends if end <= now]:
            self._push_until(end)
            for effect in self.effects.values():
                if effect.ends == end:
                    effect.ends = None
        self._push_until(now)

    def _push_until(self, now: float) -> None:
        if self._handle is not None:
            x, y = self.force()
            self._handle.force[:2] = x, -y
            self._handle.advance(now)

    # -- reports ---------------------------------------------------------------------------------

    def input_report(self, number: int, now: float) -> bytes | None:
        state = self.layout["state"]
        if number != state.number:
            return None
        x, y = self.place
        if self._handle is not None:
            position, _ = self._handle.pose()
            x, y = 2.0 / self.travel * position[0], -2.0 / self.travel * position[1]
        values = {"x": _counts(state, "x", x), "y": _counts(state, "y", y)}
        bits = {f"button{i + 1}": self.buttons >> i & 1 for i in range(8)}
        return state.packed(**values, **bits)

    def output(self, report: bytes, now: float) -> None:
        self._move(now)
        self.outputs += 1
        self._note("out", report)
        name = self._name(OUT, report)
        if name is None:
            return
        values = self.layout[name].unpacked(report)
        effect = self.effects.get(values.get("index", 0))
        if name == "control":
            self._control(self.layout[name].chosen("control", values["control"]))
        elif name == "gain":
            self.gain = values["gain"] / self.layout[name].part("gain").high
        elif effect is not None:
            self._change(name, effect, values, now)

    def set_feature(self, report: bytes, now: float) -> None:
        self._note("feature", report)
        if self._name(FEATURE, report) != "create":
            raise StallError
        create = self.layout["create"]
        kind = create.chosen("type", create.unpacked(report)["type"])
        free = next((i for i in range(1, self.room + 1) if i not in self.effects), 0)
        if self.error or not kind:
            self._loaded = (0, _ERROR)
        elif not free:
            self._loaded = (0, _FULL)
        else:
            self.effects[free] = Effect(kind)
            self._loaded = (free, _LOADED)

    def feature(self, number: int, now: float) -> bytes | None:
        load, pool = self.layout["load"], self.layout["pool"]
        if number == load.number:
            index, status = self._loaded
            part = load.part("status")
            value = part.low + [choice & 0xFFFF for choice in part.choices].index(status)
            return load.packed(index=index, status=value, memory=1000)
        if number == pool.number:
            return pool.packed(most=self.most, memory=4096, managed=1)
        return None

    def _change(self, name: str, effect: Effect, values: dict[str, int], now: float) -> None:
        report = self.layout[name]
        if name == "force":
            effect.magnitude = values["magnitude"] / report.part("magnitude").high
        elif name == "free":
            del self.effects[values["index"]]
        elif name == "operation":
            operation = report.chosen("operation", values["operation"])
            if operation in (_START, _START_ALONE):
                effect.ends = now + effect.duration
            elif operation == _STOP:
                effect.ends = None
        elif name == "effect":
            duration = report.part("duration")
            is_endless = values["duration"] in (0, (1 << duration.bits) - 1)
            seconds = values["duration"] * 10.0 ** duration.unit[1]
            effect.duration = math.inf if is_endless else seconds
            effect.gain = values["gain"] / report.part("gain").high
            assert values["by_direction"]
            turn = report.part("direction").high + 1
            effect.direction = 360.0 * values["direction"] / turn

    def _control(self, usage: int) -> None:
        if usage in (_ENABLE, _DISABLE):
            self.is_enabled = usage == _ENABLE
        elif usage in (_PAUSE, _CONTINUE):
            self.is_paused = usage == _PAUSE
        elif usage == _STOP_ALL:
            for effect in self.effects.values():
                effect.ends = None
        elif usage == _RESET:
            self.effects.clear()
            self.is_enabled = self.is_paused = False

    def _name(self, kind: int, report: bytes) -> str | None:
        for name, one in self.layout.items():
            if (one.kind, one.number) == (kind, report[0] if report else 0):
                return name if len(report) >= one.length else None
        return None

    def _note(self, kind: str, report: bytes) -> None:
        if self.is_logging:
            self.log.append((kind, bytes(report)))


def _counts(state: Report, name: str, share: float) -> int:
    """Returns what an axis reports at a deflection of -1 to 1; its stops hold what goes beyond."""
    part = state.part(name)
    middle, half = 0.5 * (part.low + part.high), 0.5 * (part.high - part.low)
    return int(np.clip(math.floor(middle + half * share + 0.5), part.low, part.high))
