"""Force-feedback wheels and sticks of Linux: one rotation with a streamed constant force.

Linux's drivers offer the same effects for wheels with a maker's own protocol (Logitech,
Thrustmaster, Fanatec and others) as for those of the class PID. The driver keeps one effect of a
constant force and changes its level:

    φ = range (X − X_m)/(X_max − X_min),   level = 32767 τ/max_torque

X is the count of the first axis, X_m the middle of its range, φ the rotation in rad about one axis
of the device, τ the torque in N m. No driver reports newton metres, so ``max_torque`` states them.

The kernel queues changes of an effect and may drop some of them without a word when the device is
slower than the loop. So a level is written only when it changes, and the effect is started again
every ``RESTART``. It ends by itself after ``LIFE`` if nothing more comes, and at once when the
program ends, because the kernel removes the effects of a closed node.

Gamepads have motors that shake and cannot push; they are refused. The sign of the force is not the
same in all drivers: ``reverse=1`` changes it. The driver has not been verified on hardware.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.base import (
    AXES,
    USUAL_FORCE_LIMIT,
    DeviceInfo,
    calling_on_error,
    checked_number,
    checked_period,
    released,
    stated_numbers,
    stated_switch,
)
from hapticbridge.device.driver import (
    Driver,
    FoundDevice,
    Notify,
    access_problem,
    ignore_message,
    select_device,
)
from hapticbridge.device.profile import profile_named, profile_of
from hapticbridge.device.transport.trace import HexLog
from hapticbridge.device.watchdog import ForceOffGuardian, guard_device_node
from hapticbridge.device.wheel.evdev import (
    ABS_X,
    EV_ABS,
    EV_FF,
    EV_KEY,
    EV_SYN,
    FF_AUTOCENTER,
    FF_CONSTANT,
    FF_GAIN,
    FF_RUMBLE,
    FIRST_BUTTON,
    FULL,
    LAST_BUTTON,
    SYN_DROPPED,
    InputNode,
    Kernel,
    Linux,
    event,
    interval_of,
    open_node,
    range_of,
)
from hapticbridge.errors import DeviceError, DeviceLost, choices
from hapticbridge.kernel.pose import canonical, quaternion_exp
from hapticbridge.kernel.record import SAMPLE_DTYPE

RESTART, LIFE = 0.02, 0.1
"""Time in s between restarts of the effect, and its duration. Five restarts in a row may be lost
without a gap in the torque; if the program stands still, it ends after 0.1 s."""

LIFE_PERIODS = 5
"""Shortest duration of the effect in periods of the loop, so that a slow loop keeps its torque."""

USUAL_RATE = 125.0
"""Rate in Hz of a device whose polling interval is unknown, the lowest usual one."""

WIDEST_RANGE = 3600.0
"""Largest rotation in degrees from stop to stop that is plausible."""

MAX_BUTTONS = 32
"""Number of buttons that a sample holds."""

MEASURED = ("rotational_inertia", "rotational_damping")
"""Numbers of the data sheet that are known only from a measurement."""


class Rim(NamedTuple):
    """Turning part of a wheel.

    Attributes:
        max_torque: Torque at full level in N m, > 0.
        turn: Rotation from stop to stop in rad, > 0.
        axis: Axis of the rotation, ``rx``, ``ry`` or ``rz``.
        rate: Rate of the device in Hz, > 0.
        is_reversed: True to change the sign of the torque.
    """

    max_torque: float
    turn: float
    axis: str
    rate: float
    is_reversed: bool


class WheelDevice:
    """An open wheel.

    Its data sheet has one rotational axis. The force limit applies to no motor; it is the usual one
    with which the coupling holds the tool's place. Its delay is unknown.

    Args:
        node: The open input device.
        rim: Its turning part.
        known: Numbers of the data sheet, by name.

    Attributes:
        info: Its data sheet.
        last_word: Ends the torque if the program hangs; None if no second process can be started.

    Raises:
        DeviceError: The device has no constant force, or no axis; the message names what it lacks.
    """

    def __init__(
        self,
        node: InputNode,
        rim: Rim,
        known: Mapping[str, float] | None = None,
    ) -> None:
        self._node, self._name = node, node.name
        self._is_open, self._is_started = True, False
        if reason := lack_of(node):
            raise DeviceError(f"{self._name} cannot be driven: {reason}")
        self._range = node.axis(ABS_X)
        self._turn = rim.turn
        self._place = AXES.index(rim.axis)
        self._scale = (-FULL if rim.is_reversed else FULL) / rim.max_torque
        keys = [code for code in node.codes(EV_KEY) if FIRST_BUTTON <= code <= LAST_BUTTON]
        stated: dict[str, Any] = dict(known or {})
        self._bits = {code: 1 << bit for bit, code in enumerate(sorted(keys)[:MAX_BUTTONS])}
        self.info = DeviceInfo(
            name=self._name,
            axes=(rim.axis,),
            force_limit=USUAL_FORCE_LIMIT,
            torque_limit=rim.max_torque,
            rate=rim.rate,
            serial=node.serial,
            buttons=len(self._bits),
            **stated,
        )
        has = node.codes(EV_FF)
        if FF_AUTOCENTER in has:
            node.set(FF_AUTOCENTER, 0)
        if FF_GAIN in has:
            node.set(FF_GAIN, 0xFFFF)
        self._effect = node.upload(0, round(1e3 * LIFE))
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._count = self._range.value
        self._pressed = 0
        self._level = self._ticks = self._every = 0
        self._life = round(1e3 * LIFE)
        self.last_word: ForceOffGuardian | None = None

    def start(self, period: float) -> NDArray[np.void]:
        """Starts the effect without torque, and reads the position.

        Raises:
            DeviceError: The period is not valid.
            DeviceLost: The device is gone.
        """
        checked_period(period)
        self._every, self._ticks = max(int(RESTART / period), 1), 0
        self._life = round(1e3 * max(LIFE, LIFE_PERIODS * period))
        self._node.events()  # older than the position that is read now
        self._ask_state()
        self._push(0)
        self._node.set(self._effect, 1)
        self._is_started = True
        if self.last_word is not None:
            self.last_word.expect(period)
        self._fill()
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the position; a silent device is at rest, because it reports only changes.

        If the kernel has lost events, such as in a long pause of the loop, it is asked instead.
        """
        if not self._is_started:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        has_lost = False
        for kind, code, value in self._node.events():
            has_lost |= (kind, code) == (EV_SYN, SYN_DROPPED)
            if (kind, code) == (EV_ABS, ABS_X):
                self._count = value
            elif kind == EV_KEY and code in self._bits:
                bit = self._bits[code]
                self._pressed = self._pressed | bit if value else self._pressed & ~bit
        if has_lost:
            self._ask_state()
        self._fill()
        sample[0] = self._sample[0]
        return 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a finite torque about the axis, clipped to full level.

        Raises:
            DeviceError: It is not finite, or the loop hung and the guardian ended the torque.
            DeviceLost: The device is gone.
        """
        torque = float(wrench[self._place])
        if not math.isfinite(torque):
            raise DeviceError(f"{self._name}: a torque that is not finite was not sent")
        level = round(min(max(self._scale * torque, -FULL), FULL))
        if self.last_word is not None:
            self.last_word.beat(has_force=level != 0)
        self._ticks += 1
        is_due = self._ticks >= self._every
        # changed again with a restart, in case the kernel dropped the one before
        if is_due or level != self._level:
            self._push(level)
        if is_due:
            self._ticks = 0
            self._node.set(self._effect, 1)

    def close(self) -> None:
        """Ends the torque and releases the device."""
        if not self._is_open:
            return
        self._is_open = self._is_started = False
        with released(self._node, self.last_word):
            self._push(0)
            self._node.set(self._effect, 0)
            self._node.erase(self._effect)

    def leave_last_word(self) -> None:
        """Starts a guardian process that ends the torque if the program hangs."""
        self.last_word = guard_device_node(
            self._node.path, event(self._effect, 0), event(FF_GAIN, 0)
        )

    def _ask_state(self) -> None:
        self._count = self._node.axis(ABS_X).value
        down = self._node.buttons_down()
        self._pressed = sum(bit for code, bit in self._bits.items() if code in down)

    def _push(self, level: int) -> None:
        self._effect = self._node.upload(level, self._life, self._effect)
        self._level = level

    def _fill(self) -> None:
        limits = self._range
        share = (self._count - 0.5 * (limits.least + limits.most)) / (limits.most - limits.least)
        angle = [0.0, 0.0, 0.0]
        angle[self._place - 3] = self._turn * share
        x, y, z = angle
        self._sample["quaternion"] = canonical(quaternion_exp((x, y, z)))
        self._sample["buttons"] = self._pressed


def lack_of(node: InputNode) -> str:
    """Returns the reason why an input device is no wheel; empty if it is one."""
    effects = node.codes(EV_FF)
    if FF_CONSTANT not in effects:
        if FF_RUMBLE in effects:
            return (
                "its motors shake and cannot push (rumble), which is a cue and no force; a wheel "
                "or a force-feedback stick is needed"
            )
        return "it has no constant force (FF_CONSTANT); its Linux driver may be missing"
    if ABS_X not in node.codes(EV_ABS) or node.axis(ABS_X).most <= node.axis(ABS_X).least:
        return "it reports no axis that turns (ABS_X)"
    return ""


# Discovery of force-feedback devices among the input devices


def open_wheel(
    options: Mapping[str, object], notify: Notify = ignore_message, kernel: Kernel | None = None
) -> WheelDevice:
    """Finds and opens a wheel.

    The options are ``serial`` (serial number or node), ``max_torque``, ``range`` in degrees,
    ``axis``, ``rate``, ``reverse``, ``log``, ``profile``, and numbers of the data sheet.

    Raises:
        DeviceError: No wheel is found, an option is missing or not valid, or the device is no
            wheel.
        DeviceLost: The device is gone.
    """
    numbers = stated_numbers(options, MEASURED)
    axis = options.get("axis", "rz")
    if axis not in AXES[3:]:
        raise DeviceError(f"axis is {axis!r}; it must be one of {choices(AXES[3:])}")
    is_reversed = "reverse" in options and stated_switch(options, "reverse")
    system = Linux() if kernel is None else kernel
    plugged = select_device(DRIVER, find(system), options.get("serial"))
    max_torque = _strength(options, plugged)
    degrees = options.get("range", range_of(plugged.path))
    if degrees is None:
        raise DeviceError(
            f"{plugged}: its driver does not report how far it turns; state the degrees from stop "
            "to stop with range=, such as range=900"
        )
    turn = checked_number("range", degrees, "degrees", is_positive=True)
    if turn > WIDEST_RANGE:
        raise DeviceError(f"range is {turn:g}; it must be at most {WIDEST_RANGE:g} degrees")
    interval = interval_of(plugged.path)
    rate = 1.0 / interval if interval else USUAL_RATE
    rate = checked_number("rate", options.get("rate", rate), "Hz", is_positive=True)
    node = open_node(system, plugged.path, HexLog.from_options(options))
    with calling_on_error(node.close):
        rim = Rim(max_torque, math.radians(turn), str(axis), rate, is_reversed)
        device = WheelDevice(node, rim, numbers)
    notify(
        f"{plugged}: {max_torque:g} N m at full level, {turn:g} degrees from stop to stop, changed "
        f"up to {rate:g} times a second; autocentre off"
    )
    if kernel is None:
        device.leave_last_word()
    return device


def _strength(options: Mapping[str, object], plugged: FoundDevice) -> float:
    """Returns the torque at full level in N m, as stated or as in the unit's profile.

    Raises:
        DeviceError: It is not stated, not valid, or contradicts the profile, whose damping would
            then have other units than the torque.
    """
    named = options.get("profile")
    profile = profile_of("wheel", plugged.serial, plugged.name) if named is None else None
    if named not in (None, "none"):
        profile = profile_named(str(named))
    known = None if profile is None else profile.quantities.get("torque_limit")
    measured = known.value if known is not None and isinstance(known.value, float) else None
    stated = options.get("max_torque", measured)
    if stated is None:
        raise DeviceError(
            f"{plugged}: no driver reports its strength; state the torque at full level in N m "
            "with max_torque=, from the maker's data or a luggage scale at the rim"
        )
    if measured is not None and stated != measured:
        raise DeviceError(
            f"max_torque = {stated!r}: the profile of this wheel was measured with {measured:g}, "
            "and its damping holds for that only; leave out max_torque=, or add profile=none"
        )
    return checked_number("max_torque", stated, "N m", is_positive=True)


def find(kernel: Kernel | None = None) -> list[FoundDevice]:
    """Lists the input devices with force feedback, with the reason if one is no wheel.

    A node that this user may not open is left out, because only an open one says what it is.
    """
    system = Linux() if kernel is None else kernel
    found = []
    for path in system.nodes():
        try:
            node = open_node(system, path)
        except DeviceError:
            continue
        try:
            if node.codes(EV_FF) & {FF_CONSTANT, FF_RUMBLE}:
                found.append(
                    FoundDevice(
                        driver="wheel",
                        name=node.name,
                        serial=node.serial,
                        path=path,
                        transport="evdev",
                        vendor=node.vendor,
                        product=node.product,
                        problem=lack_of(node) or None,
                    )
                )
        except DeviceLost:
            continue
        finally:
            node.close()
    return found


def medium() -> str:
    """Returns a sentence on whether this system has input devices that may be opened."""
    system = Linux()
    nodes = system.nodes()
    if not nodes:
        if sys.platform != "linux":
            return "only Linux offers force feedback through /dev/input"
        return "no input devices are seen in /dev/input"
    closed = [path for path in nodes if not os.access(path, os.R_OK | os.W_OK)]
    if not closed:
        return f"{len(nodes)} input devices may be opened"
    return (
        f"{len(closed)} of {len(nodes)} input devices may not be opened, and a wheel among them is "
        f"not seen: {access_problem(closed[0])}"
    )


DRIVER = Driver(
    name="wheel",
    about="force-feedback wheels and sticks with a Linux driver, any maker's",
    ids=(),
    transport="evdev",
    axes="rz, or rx or ry with axis=",
    force="percent of a torque in N m, which max_torque= sets",
    rate="125 Hz to 1 kHz",
    has_guardian=True,
    on_stall=f"its effect ends by itself after {LIFE:g} s",
    options={
        "serial": str,
        "log": str,
        "axis": str,
        "profile": str,
        **dict.fromkeys(("max_torque", "range", "rate", "reverse", *MEASURED), float),
    },
    open=open_wheel,
    find=find,
    medium=medium,
    products="an input device with a constant force",
    stated="max_torque=NM",
)
"""Driver of the input devices that can push."""
