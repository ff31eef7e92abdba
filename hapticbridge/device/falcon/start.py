"""Start of a Falcon: firmware and homing."""

from __future__ import annotations

import array

from hapticbridge.device.falcon.boot import (
    Link,
    ask,
    enter_run_mode,
    read_firmware,
    speaks,
    upload,
)
from hapticbridge.device.falcon.packets import ReplyStream, Request
from hapticbridge.device.plugged import Tell
from hapticbridge.device.silence import SILENCE
from hapticbridge.errors import DeviceError, DeviceLost

LONGEST_PERIOD = 0.02
"""Longest period of the loop in s. The device is polled once per tick; at a longer period two lost
replies would already count as silence."""

ZERO_TRIES = 20
"""Number of attempts, of 1 ms each, to send a zero force that was not accepted. No watchdog of a
Falcon is known, so the previous force would remain."""

HOMING_TIME = 60.0
"""Time in s in which the user must move the grip through its range."""

_ALL = 7  # a bit per encoder


def silent(name: str) -> DeviceLost:
    """Returns the error of a Falcon that stopped replying."""
    return DeviceLost(
        f"{name}: gave no usable reply for {1e3 * SILENCE:g} ms; check its cable and its power"
    )


def insist(link: Link, packet: array.array[int], name: str) -> None:
    """Repeats a zero-force packet until it is accepted.

    Raises:
        DeviceLost: The device is gone, or refused ``ZERO_TRIES`` attempts.
    """
    if not any(link.write(packet) for _ in range(ZERO_TRIES)):
        raise DeviceLost(
            f"{name}: did not accept zero force in {ZERO_TRIES} attempts; switch its power off"
        )


def ask_anew(link: Link, stream: ReplyStream, name: str) -> float:
    """Commands zero force and reads the pose again, after a pause of the loop.

    A Falcon keeps its last force while the host pauses, and the waiting reply holds an outdated
    pose. If the handle were re-anchored there, the next reply would stretch the coupling by the
    hand's motion in the meantime.

    Returns:
        Time of the first request in s; the pose is not older.

    Raises:
        DeviceLost: The device is gone or silent.
    """
    asked = link.now()
    for _ in range(2):  # the first reply may answer a request of the loop
        if not ask(link, stream, Request.GREEN, SILENCE):
            raise silent(name)
    return asked


def bring_up(link: Link, stream: ReplyStream, name: str, firmware: str | None, tell: Tell) -> None:
    """Brings a Falcon into run mode, and loads its firmware if it does not answer.

    Raises:
        DeviceError: The device has no firmware, and no file was named or the file does not run.
        DeviceLost: The device is gone.
    """
    image = None if firmware is None else read_firmware(firmware)
    enter_run_mode(link)
    if speaks(link, stream):
        return
    if image is None:
        raise DeviceError(
            f"{name}: has no firmware (it loses it without power); name the maker's firmware "
            "file: falcon:firmware=FILE"
        )
    upload(link, image, name, tell)
    enter_run_mode(link)
    stream.clear()
    if not speaks(link, stream):
        raise DeviceError(
            f"{name}: accepted '{firmware}' but does not answer; name a file with its firmware"
        )


def home(link: Link, stream: ReplyStream, name: str, tell: Tell) -> None:
    """Waits until the user, instructed by ``tell``, has moved every encoder through its zero.

    Raises:
        DeviceError: The grip was not moved within ``HOMING_TIME``.
        DeviceLost: The device is gone or silent.
    """
    end, is_prompted = link.now() + HOMING_TIME, False
    last_reply = link.now()
    while link.now() < end:
        if ask(link, stream, Request.HOMING | Request.RED, SILENCE):
            last_reply = link.now()
            if stream.reply["homed"][0] == _ALL:
                if is_prompted:
                    tell(f"{name}: homed")
                return
        elif link.now() - last_reply > 2 * SILENCE:
            raise silent(name)
        if not is_prompted:
            is_prompted = True
            tell(f"{name}: pull the grip all the way out and push it back in, slowly")
    raise DeviceError(
        f"{name}: was not homed within {HOMING_TIME:g} s; open it again and move the "
        "grip all the way out and in"
    )
