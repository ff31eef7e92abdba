"""USB force-feedback sticks (class PID): two axes, each with a streamed constant force."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.data_sheet import checked_period
from hapticbridge.device.last_word import LastWord, last_word_at
from hapticbridge.device.pid.effects import Effects
from hapticbridge.device.pid.reports import PidReports, has_force_feedback
from hapticbridge.device.pid.sheet import CHANGES, Scale, data_sheet, scale_of
from hapticbridge.device.pid.stick import Stick
from hapticbridge.device.plugged import Family, Tell, chosen
from hapticbridge.device.transport.hex_log import HexLog
from hapticbridge.device.transport.hid import HidLink
from hapticbridge.device.transport.hid_layout import Layout
from hapticbridge.device.transport.hid_search import HidApi, find, polling
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.tick import SAMPLE_DTYPE, TickFlag

LOOKS, LOOK_MS = 20, 10
"""Number and length in ms of the waits for reports at the start: 0.2 s for a silent stick at rest,
less for one that streams."""

STREAMING = 15
"""Smallest number of these waits that bring a report from a streaming stick. A stick that reports
only changes brings none in a still hand. A wrong classification costs only a flag."""

SLOTS = 4
"""Kinds of report in the loop: force and restart, for each of two effects."""


class PidDevice:
    """Force-feedback stick; its axes are x (to the right) and y (away from the user).

        p = travel/2 (X, −Y),   counts = full · F/newtons

    X and Y are the deflection, -1 to 1. The standard has no units of force or length, so both
    scales are stated (``Scale``). If a scale is wrong by a factor, every force or length is, and
    with it K, B and the b that ``identify`` measures. The condition b >= KT/2 + B is not affected.

    Each axis has a constant-force effect of its own with a fixed direction. A tick therefore sends
    one short report per axis whose count has changed, at most two. A single effect with a direction
    would need SetEffect (some 18 bytes) at each change of angle, and SetConstantForce. Pushing a
    peg into its hole that takes 1.62 reports a tick, compared to 1.44 with two effects. Between its
    two reports the force would also point in a wrong direction.

    A silent stick is at rest, because many sticks report only changes. An unplugged stick raises an
    error at the next call.

    Args:
        link: Open link for its reports, with ``SLOTS``.
        name: Name of the device in messages.
        scale: Newtons, metres, and signs.
        known: ``mass``, ``damping``, ``friction`` of the data sheet, as stated by the user.
        intervals: Polling intervals for reports from and to the device in s; None if unknown.
        serial: Its serial number.

    Attributes:
        info: Its data sheet.
        last_word: Ends the force if this process dies. None if no second process can open the node;
            then only the effects' duration (``Effects.life``) ends it.
        workspace: Travel along x, y and z in m, as stated or assumed (it has no z).

    Raises:
        DeviceError: The stick lacks a required capability; the message names it.
    """

    def __init__(
        self,
        link: HidLink,
        name: str,
        *,
        scale: Scale,
        known: Mapping[str, object] | None = None,
        intervals: tuple[float | None, float | None] = (None, None),
        serial: str = "",
    ) -> None:
        self._link, self._name = link, name
        self._is_open = True
        try:
            layout = Layout(link.requests.report_descriptor())
            reports = PidReports(layout)
            self._stick = Stick(layout)
        except DeviceError as error:
            raise DeviceError(f"{name} cannot be driven: {error}") from None
        self._effects = Effects(link, name, reports, intervals[1])
        self.info = data_sheet(name, serial, scale, self._stick.step, intervals, dict(known or {}))
        self.workspace = (scale.travel,) * 3
        self._reach = np.array([0.5, -0.5]) * scale.travel
        self._shares = scale.signs / scale.newtons
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._sample["quaternion"][:, 0] = 1.0
        self._has_started = self._streams = False
        self.last_word: LastWord | None = None

    def start(self, period: float) -> NDArray[np.void]:
        """Starts the effects without force, and reads the stick's position.

        Raises:
            DeviceError: The period is not valid, or the stick does not report its position.
            DeviceLost: The device is gone.
        """
        checked_period(period)
        self._effects.start(period)
        self._link.take()
        received = sum(self._stick.takes(self._link.wait(LOOK_MS)) for _ in range(LOOKS))
        self._streams = received >= STREAMING
        if not received and not self._stick.takes(
            self._link.requests.input_report(*self._stick.report)
        ):
            raise DeviceError(f"{self._name} does not report its position; move it and start again")
        self._has_started = True
        self._fill()
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the stick's position without waiting.

        The sample is stale only if a streaming stick has sent nothing since the last read.
        """
        if not self._has_started:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        is_new = False
        for report in self._link.take():
            is_new |= self._stick.takes(report)
        if is_new:
            self._fill()
        sample[0] = self._sample[0]
        return 0 if is_new or not self._streams else int(TickFlag.STALE_SAMPLE)

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Commands a finite force along x and y, each clipped to full scale."""
        shares = self._shares * wrench[:2]
        if not np.isfinite(shares).all():
            raise DeviceError(f"{self._name}: a force that is not finite was not sent")
        self._effects.push(shares.tolist())

    def close(self) -> None:
        """Stops the effects, switches the motors off and releases the device."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            with contextlib.suppress(DeviceLost):  # a lost device ends its effects by itself
                self._effects.close()
        finally:
            self._link.close()
            if self.last_word is not None:
                self.last_word.close()

    def leave_last_word(self, path: str) -> None:
        """Starts a guardian process that ends the force, if two processes can hold the node."""
        self.last_word = last_word_at(path, *self._effects.farewell())

    def _fill(self) -> None:
        sample = self._sample[0]
        sample["position"][:2] = self._reach * self._stick.deflection
        sample["buttons"] = self._stick.buttons


def open_pid(options: Mapping[str, object], tell: Tell, api: HidApi | None = None) -> PidDevice:
    """Finds and opens a force-feedback stick.

    The options are ``serial``, ``log``, ``newtons``, ``travel``, ``reverse``, ``profile``, and the
    numbers ``CHANGES`` of the data sheet. ``tell`` receives a message about assumed values. With a
    substitute of hidapi, ``api``, reports are sent without a thread.

    Raises:
        DeviceError: No stick is found, it cannot be opened, or it lacks a required capability.
    """
    plugged = chosen(FAMILY, find(FAMILY, api), options.get("serial"))
    scale, known = scale_of(options, plugged.serial, str(plugged), tell)
    link = HidLink.open(
        plugged, api, is_overlapped=api is None, log=HexLog.asked(options), slots=SLOTS
    )
    try:
        device = PidDevice(
            link,
            str(plugged),
            scale=scale,
            known=known,
            intervals=polling(plugged.path) if api is None else (None, None),
            serial=plugged.serial,
        )
    except BaseException:
        link.close()
        raise
    if api is None:
        device.leave_last_word(plugged.path)
    return device


FAMILY = Family(
    name="pid",
    about="USB force-feedback sticks of the class PID, any maker's",
    ids=(),
    transport="hid",
    axes="2",
    force="a share of full scale, which newtons= states",
    rate="125 Hz to 1 kHz, one axis at a time",
    on_stall="its effects end by themselves after 0.1 s, on a slow bus after up to 0.4 s",
    options=("serial", "log", "newtons", "travel", "reverse", "profile", *CHANGES),
    open=open_pid,
    recognises=has_force_feedback,
)
"""Driver of a device class: devices are recognised by their report descriptor, not by a list."""
