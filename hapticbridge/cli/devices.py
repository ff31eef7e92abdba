"""``hapticbridge devices``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import tyro

from hapticbridge.cli.terminal import out, plain, print_json
from hapticbridge.device.discovery import RULES_FILE, blind_spots, plugged_devices, udev_rules
from hapticbridge.device.driver import RULES_COMMAND, Driver, FoundDevice
from hapticbridge.device.registry import all_drivers
from hapticbridge.device.watchdog import HANG
from hapticbridge.errors import HapticBridgeError


@dataclass(frozen=True, slots=True)
class Devices:
    """List the haptic devices plugged in and supported.

    For a device that cannot be opened, says what is missing. Moves no motor.

    Example:
        hapticbridge devices --udev-rules | sudo tee /etc/udev/rules.d/70-hapticbridge.rules
    """

    udev_rules: bool = False
    """Print udev rules by which the user at this machine may open the devices, and nothing else."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the lists as JSON."""

    def execute(self) -> int:
        """Prints the lists; returns the exit code, 0 also where nothing is plugged in."""
        if self.udev_rules and self.as_json:
            raise HapticBridgeError("--udev-rules are no JSON; leave --json out")
        if self.udev_rules:
            out.out(udev_rules(), end="")
            return 0
        plugged, unseen = plugged_devices(), blind_spots()
        if self.as_json:
            print_json(_facts(plugged, unseen))
            return 0
        out.print("[bold]supported[/bold]")
        for driver in all_drivers():
            out.print(f"{driver.name}: {plain(driver.about)}")
            out.print(f"  axes {driver.axes}; force on the hand {driver.force}; rate {driver.rate}")
            for sentence in _standstill(driver):
                out.print(f"  {plain(sentence)}")
            if driver.medium is not None:
                out.print(f"  {plain(driver.medium())}")
        out.print("[bold]plugged in[/bold]")
        for device in plugged:
            out.print(f"{device.driver}: {plain(str(device))} at {plain(device.path)}")
            if device.problem:
                out.print(f"  [yellow]not usable:[/yellow] {plain(device.problem)}")
        if not plugged:
            out.print("none; 'simulated' and 'trajectory:FILE' need none")
        for sentence in unseen:
            out.print(f"[yellow]warning:[/yellow] {plain(sentence)}")
        usable = [device for device in plugged if device.problem is None]
        if any(RULES_COMMAND in (device.problem or "") for device in plugged):
            out.print(
                f"next: {RULES_COMMAND} | sudo tee {RULES_FILE}, "
                "then sudo udevadm control --reload && sudo udevadm trigger"
            )
        elif usable:
            specification = _specification(usable[0], plugged)
            out.print(
                f"next: hapticbridge run peg_in_hole --device {specification} --force-limit 2"
            )
        return 0


def _specification(first: FoundDevice, plugged: list[FoundDevice]) -> str:
    """Returns what to type for a device; its serial where there are more like it."""
    is_only = sum(device.driver == first.driver for device in plugged) == 1
    return first.driver if is_only else f"{first.driver}:serial={first.serial or first.path}"


def _standstill(driver: Driver) -> Iterator[str]:
    """Yields what becomes of the force of a program or a machine that stands still."""
    if driver.has_guardian:
        yield f"if the program stands still: on Linux a second process ends the force after {_HANG}"
        yield f"if this machine stands still: {driver.on_stall}"
    elif driver.on_stall:
        yield f"if the program or this machine stands still: {driver.on_stall}"


_HANG = f"{1e3 * HANG:g} ms"

_FACTS = ("name", "about", "transport", "axes", "force", "rate", "on_stall", "has_guardian")


def _facts(plugged: list[FoundDevice], unseen: list[str]) -> dict[str, Any]:
    return {
        "supported": [
            {
                **{name: getattr(driver, name) for name in _FACTS},
                "options": list(driver.options),
                "medium": None if driver.medium is None else driver.medium(),
                "ids": [{"id": str(usb_id), "model": usb_id.model} for usb_id in driver.ids],
            }
            for driver in all_drivers()
        ],
        "plugged": [asdict(device) for device in plugged],
        "warnings": unseen,
    }
