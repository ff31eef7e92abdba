"""A Falcon from plugged in to ready: its program, and the zeros of its encoders.

And what is said to it outside the ticks: no force.
"""

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
"""In s. It is asked once a tick; slower, two lost replies would already count as silence."""

ZERO_TRIES = 20
"""How often a packet without force is sent again that was not taken, for 1 ms each: no watchdog of
a Falcon is known, so the force before it would stay."""

HOMING_TIME = 60.0
"""In s: how long the user has to move the grip through its range."""

_ALL = 7  # a bit per encoder


def silent(name: str) -> DeviceLost:
    """Returns the error that a Falcon has fallen silent."""
    return DeviceLost(f"{name}: gave no usable reply for {1e3 * SILENCE:g} ms")


def insist(link: Link, packet: array.array[int], name: str) -> None:
    """Sends a packet without force that was not taken until it is.

    Args:
        link: To the Falcon.
        packet: Of no force.
        name: What errors call it.

    Raises:
        DeviceLost: It is gone, or takes none in ``ZERO_TRIES``.
    """
    if not any(link.write(packet) for _ in range(ZERO_TRIES)):
        raise DeviceLost(f"{name}: does not take that it is to give no force")


def ask_anew(link: Link, stream: ReplyStream, name: str) -> float:
    """Takes the force away and asks where the grip is now, after the loop stood still.

    Nothing takes the force of a Falcon away while its host stands still. The reply that waits is to
    a question from before that; a coupling that is re-seated by it is stretched, as soon as the
    next reply comes, by all that the hand has moved since.

    Args:
        link: To a Falcon that speaks.
        stream: Takes its replies; the newest is then to a question asked here.
        name: What errors call it.

    Returns:
        When it was first asked, in s: the pose is no older.

    Raises:
        DeviceLost: It is gone, or silent.
    """
    asked = link.now()
    for _ in range(2):  # the first reply may be to a question of the loop's
        if not ask(link, stream, Request.GREEN, SILENCE):
            raise silent(name)
    return asked


def bring_up(link: Link, stream: ReplyStream, name: str, firmware: str | None, tell: Tell) -> None:
    """Makes a Falcon speak: asks it first, and sends its program only where it does not answer.

    Args:
        link: To the Falcon.
        stream: Takes its replies.
        name: What errors call it.
        firmware: File with its program, or None.
        tell: Told how far the program is.

    Raises:
        DeviceError: It has no program, and none was named or it does not run.
        DeviceLost: It is gone.
    """
    image = None if firmware is None else read_firmware(firmware)
    enter_run_mode(link)
    if speaks(link, stream):
        return
    if image is None:
        raise DeviceError(
            f"{name}: has no firmware (it forgets it without power); name the file with "
            "the maker's program: falcon:firmware=FILE"
        )
    upload(link, image, name, tell)
    enter_run_mode(link)
    stream.clear()
    if not speaks(link, stream):
        raise DeviceError(
            f"{name}: took '{firmware}', and does not answer; it is no firmware for it"
        )


def home(link: Link, stream: ReplyStream, name: str, tell: Tell) -> None:
    """Waits until every encoder has passed its zero; asks the user to see to it.

    Args:
        link: To a Falcon that speaks.
        stream: Takes its replies.
        name: What errors call it.
        tell: Told what the user has to do.

    Raises:
        DeviceError: Nobody did within ``HOMING_TIME``.
        DeviceLost: It is gone, or fell silent.
    """
    end, is_told = link.now() + HOMING_TIME, False
    heard = link.now()
    while link.now() < end:
        if ask(link, stream, Request.HOMING | Request.RED, SILENCE):
            heard = link.now()
            if stream.reply["homed"][0] == _ALL:
                if is_told:
                    tell(f"{name}: homed")
                return
        elif link.now() - heard > 2 * SILENCE:
            raise silent(name)
        if not is_told:
            is_told = True
            tell(f"{name}: pull the grip all the way out and push it back in, slowly")
    raise DeviceError(
        f"{name}: was not homed within {HOMING_TIME:g} s; open it again and move the "
        "grip all the way out and in"
    )
