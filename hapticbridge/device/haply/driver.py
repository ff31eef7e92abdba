"""Haply Inverse3 and related devices: three translations with force, through the maker's service.

The service answers each message with the device's state when the message arrived. So each tick
sends a force, and its answer is read in the next tick. As with the Falcon, one message carries the
force and requests the state. The force that responds to a sample acts as many whole ticks later as
an answer takes. At most ``MOST_UNDER_WAY`` messages wait for answers. If the service is slower than
the loop, only the newest force waits and older ones are dropped, so nothing queues up.

The service filters forces. Its force gate and its damping are set when the device is opened, the
force gate by the option ``force_gate``. The gain that disables the gate is not documented; 0 is
sent. Its oscillation damper and its global force scale cannot be set from here and are reported to
the user.

Positions are in the service's right-handed frame, whose axes depend on the preset and basis chosen
there. The driver has not been verified on hardware.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from hapticbridge.device.data_sheet import (
    USUAL_SPEED_LIMIT,
    USUAL_TORQUE_LIMIT,
    DeviceInfo,
    checked_period,
)
from hapticbridge.device.haply import messages
from hapticbridge.device.haply.messages import SERVICE, Listed
from hapticbridge.device.haply.timing import measured_timing
from hapticbridge.device.plugged import Tell, tell_nobody
from hapticbridge.device.silence import SILENCE, SilenceWatch
from hapticbridge.device.transport.websocket import Link
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.tick import SAMPLE_DTYPE, TickFlag

FORCE_LIMIT = 2.0
"""Largest force in N, as in Isaac Lab's driver. The maker publishes no continuous force; the option
``force_limit`` sets a larger one."""

FIRST_ANSWER = 1.0
"""Longest wait in s for the list of devices and for the first state."""

LONGEST_PERIOD = 0.02
"""Longest period of the loop in s. A force lasts only for its message; at a longer period the
device would idle between two ticks."""

MOST_UNDER_WAY = 2
"""Largest number of messages without an answer. With one, the service would idle while its answer
travels."""


class HaplyDevice:
    """An open device of the service, with its filters set and its timing measured.

    The sheet's ``rate`` is the rate of states with two messages always on their way. Its ``delay``
    is the time within which 95 % of the answers to single messages came. Mass, damping, friction
    and resolution are not published; they are unknown unless the user states measured values.

    Args:
        link: Connected link to the service, after the list of devices was read.
        listed: The device.
        force_gate: Gain of the service's force gate, without unit, >= 0.
        numbers: Numbers of the data sheet, by name.
        tell: Receives a description of the service's force filters.

    Attributes:
        held_back: Number of forces dropped because the service was slower than the loop.

    Raises:
        DeviceError: The service scales positions, or its answer is invalid.
        DeviceLost: The service is gone.
    """

    def __init__(
        self,
        link: Link,
        listed: Listed,
        *,
        force_gate: float = 0.0,
        numbers: Mapping[str, float] | None = None,
        tell: Tell = tell_nobody,
    ) -> None:
        self._link, self._listed = link, listed
        self._name = f"{listed.kind} {listed.device_id}"
        self._is_open, self._is_started = True, False
        self._under_way = self.held_back = 0
        self._pending: tuple[float, ...] | None = None
        known: dict[str, float | None] = {
            "mass": None, "damping": None, "friction": None, "resolution": None,
            "force_limit": FORCE_LIMIT, **(numbers or {}),
        }  # fmt: skip
        try:
            messages.refuse_scaled(listed)
            tell(messages.told_filters(listed, force_gate))
            self._exchange(messages.first_message(listed, force_gate))
            rate, delay = measured_timing(
                link, messages.force_message(listed, (0.0, 0.0, 0.0)), self._name
            )
            self.info = DeviceInfo(
                name=listed.kind,
                axes=("x", "y", "z"),
                rotational_inertia=None,
                rotational_damping=None,
                torque_limit=USUAL_TORQUE_LIMIT,
                speed_limit=USUAL_SPEED_LIMIT,
                rate=rate,
                delay=delay,
                is_prescribed=False,
                is_real=True,
                duration=None,
                serial=listed.device_id,
                **known,  # type: ignore[arg-type]
            )
        except BaseException:
            self.close()
            raise
        self._sample = np.zeros(1, SAMPLE_DTYPE)
        self._sample["quaternion"] = (1.0, 0.0, 0.0, 0.0)
        self._watch = SilenceWatch(link.now())

    def start(self, period: float) -> NDArray[np.void]:
        """Requests the state, without force.

        Raises:
            DeviceError: The period exceeds ``LONGEST_PERIOD``, or the service reports no position.
            DeviceLost: The service is gone or silent.
        """
        if checked_period(period) > LONGEST_PERIOD:
            raise DeviceError(
                f"{self._name}: a force holds only for its message, so the rate must be at least "
                f"{1 / LONGEST_PERIOD:g} Hz, not {1 / period:g} Hz"
            )
        self._take()
        self._pending, self.held_back = None, 0
        self._fill(self._exchange(messages.force_message(self._listed, (0.0, 0.0, 0.0))))
        self._watch = SilenceWatch(self._link.now())
        self._is_started = True
        return self._sample.copy()

    def read(self, sample: NDArray[np.void]) -> int:
        """Returns the newest state; waits only after a pause of the loop, for a new answer.

        Raises:
            DeviceError: The device was not started, or an answer is not a state.
            DeviceLost: The connection was lost, the device is no longer listed, or no answer came
                for ``SILENCE``.
        """
        if not self._is_started:
            raise DeviceError(f"{self._name} is read before it was started; call start() first")
        is_late = self._watch.was_away(self._link.now())
        newest = self._fresh_answer() if is_late else self._take()
        if newest is not None:
            self._fill(newest)
        if self._watch.is_silent(self._link.now(), is_new=newest is not None):
            raise DeviceLost(
                f"{SERVICE} has not answered for {1e3 * SILENCE:g} ms; check that it runs"
            )
        sample[0] = self._sample[0]
        return int(TickFlag.STALE_SAMPLE) if newest is None else 0

    def write(self, wrench: NDArray[np.float64]) -> None:
        """Sends a finite force together with the next request; the torque is ignored."""
        force = tuple(wrench[:3].tolist())
        if not all(map(math.isfinite, force)):
            raise DeviceError(f"{self._name}: a force that is not finite was not sent")
        self.held_back += self._pending is not None
        self._pending = force
        self._send_pending()

    def close(self) -> None:
        """Commands zero force, waits up to ``SILENCE`` for the answer, and disconnects."""
        if not self._is_open:
            return
        self._is_open = self._is_started = False
        try:
            self._take()
            self._link.send(messages.force_message(self._listed, (0.0, 0.0, 0.0)))
            for _ in range(self._under_way + 1):
                self._link.wait(SILENCE)
        except DeviceLost:
            pass  # without messages the device idles
        finally:
            self._link.close()

    def _take(self) -> str | None:
        """Returns the newest of all waiting answers, after sending a pending force."""
        answers = self._link.take()
        self._under_way = max(self._under_way - len(answers), 0)
        if answers and self._pending is not None:
            self._send_pending()
        return answers[-1] if answers else None

    def _fresh_answer(self) -> str | None:
        """Requests the state without force after a pause of the loop; returns the answer.

        Waiting answers and a pending force are older than the pause and are discarded.
        """
        self._pending = None
        self._take()
        self._link.send(messages.force_message(self._listed, (0.0, 0.0, 0.0)))
        answer = None
        for _ in range(self._under_way + 1):
            if (newer := self._link.wait(SILENCE)) is None:
                break
            answer = newer
        self._under_way = 0
        return answer

    def _send_pending(self) -> None:
        if self._pending is None or self._under_way >= MOST_UNDER_WAY:
            return
        self._link.send(messages.force_message(self._listed, self._pending))
        self._under_way += 1
        self._pending = None

    def _exchange(self, message: str) -> str:
        """Sends a message and returns its answer."""
        self._link.send(message)
        answer = None
        for _ in range(self._under_way + 1):
            answer = self._link.wait(FIRST_ANSWER)
        self._under_way = 0
        if answer is None:
            raise DeviceLost(f"{SERVICE} does not answer within {FIRST_ANSWER:g} s; restart it")
        return answer

    def _fill(self, message: str) -> None:
        state = messages.state(message, self._listed.device_id)
        self._sample["position"] = state.position
        self._sample["buttons"] = state.buttons
