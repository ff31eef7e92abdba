"""``hapticbridge devices`` and ``hapticbridge doctor``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from hapticbridge.arguments import option, shared
from hapticbridge.cli.terminal import out, plain, print_json, progress
from hapticbridge.device.discovery import RULES_FILE, blind_spots, plugged_devices, udev_rules
from hapticbridge.device.driver import RULES_COMMAND, Driver, FoundDevice, selector
from hapticbridge.device.registry import all_drivers, driver_named
from hapticbridge.device.watchdog import HANG
from hapticbridge.errors import HapticBridgeError
from hapticbridge.realtime.doctor import LONGEST, SHORTEST, Diagnosis, diagnose
from hapticbridge.run.options import USUAL_RATE, BridgeOptions


@dataclass(frozen=True, slots=True)
class Devices:
    """List the haptic devices plugged in and supported.

    Those plugged in come first, with the next command to type; for one that cannot be opened, says
    what is missing. Moves no motor, and opens no serial port.

    Example:
        hapticbridge devices --udev-rules | sudo tee /etc/udev/rules.d/70-hapticbridge.rules
    """

    udev_rules: bool = False
    """Print udev rules by which the user at this machine may open the devices, and nothing else."""
    as_json: bool = option(False, flag="json")
    """Print the lists as JSON."""

    def execute(self) -> int:
        """Prints the lists; returns the exit code, 0 also where nothing is plugged in."""
        if self.udev_rules and self.as_json:
            raise HapticBridgeError("--udev-rules are no JSON; leave --json out")
        if self.udev_rules:
            out.out(udev_rules(), end="")
            return 0
        plugged, unseen = plugged_devices(), [*map(str, blind_spots())]
        if self.as_json:
            print_json(_facts(plugged, unseen))
            return 0
        drivers = all_drivers()
        width = max(len(name) for name in ("simulated", *(driver.name for driver in drivers)))
        _print_row("device", "state", "what it is", width)
        for device in plugged:
            _print_plugged(device, plugged, drivers, width)
        for name, about in _WITHOUT_HARDWARE:
            _print_row(name, "ready", about, width)
        for driver in drivers:
            _print_supported(driver, plugged, width)
        for sentence in unseen:
            out.print(f"[yellow]warning:[/yellow] {plain(sentence)}")
        for document in sorted({driver.document for driver in drivers if driver.document}):
            firmware = document.with_suffix("") / "firmware"
            out.print(f"to build one: {plain(str(document))}; firmware: {plain(str(firmware))}")
        out.print("to add one by name: hapticbridge guide device-package")
        if any(driver.ids for driver in drivers):
            out.print(f"permissions on Linux: {RULES_COMMAND} | sudo tee {RULES_FILE}")
        if not any(_next(device, plugged) for device in plugged):
            out.print(f"next: {RUN} mouse")
        return 0


IDENTIFY, RUN = "hapticbridge identify", "hapticbridge run peg_in_hole --device"
"""Commands to measure a device that has motors, and to try one without; then the device's name."""


_WITHOUT_HARDWARE = (
    ("simulated", "a simulated device in the scene's own hand; the default"),
    ("trajectory", "trajectory:FILE follows a CSV file or a bag of poses, or repeats a recording"),
)


def _print_row(name: str, state: str, what: str, width: int) -> None:
    out.print(f"[bold]{name:{width}}[/bold]  {state:15}  {plain(what)}")


def _print_plugged(
    device: FoundDevice, plugged: list[FoundDevice], drivers: tuple[Driver, ...], width: int
) -> None:
    state = "not usable" if device.problem else "plugged in"
    _print_row(device.driver, state, f"{device} at {device.path}", width)
    if device.problem:
        out.print(f"  [yellow]not usable:[/yellow] {plain(device.problem)}")
    elif device.transport == "serial":
        out.print("  a serial port, not opened: a board of ours is recognised when it answers")
    driver = next(driver for driver in drivers if driver.name == device.driver)
    for sentence in () if device.problem else _standstill(driver):
        out.print(f"  {plain(sentence)}")
    if command := _next(device, plugged):
        is_identified = device.problem is None and _is_felt(device)
        hands_off = ", and let go of it" if is_identified else ""
        out.print(f"  next: {plain(command)}{hands_off}")


def _print_supported(driver: Driver, plugged: list[FoundDevice], width: int) -> None:
    facts = f"{driver.about}; axes {driver.axes}; force {driver.force}; rate {driver.rate}"
    is_ready = driver.transport == "view"
    is_plugged = any(device.driver == driver.name for device in plugged)
    _print_row(
        driver.name,
        "ready" if is_ready else "see above" if is_plugged else "none plugged in",
        facts,
        width,
    )
    if driver.medium is not None:
        out.print(f"  {plain(driver.medium())}")


def _next(device: FoundDevice, plugged: list[FoundDevice]) -> str:
    """Returns the command to type for a device; empty if its problem has another remedy."""
    if device.problem is None:
        return f"{IDENTIFY if _is_felt(device) else RUN} {_specification(device, plugged)}"
    if device.lacks_permission:
        return (
            f"{RULES_COMMAND} | sudo tee {RULES_FILE}, "
            "then sudo udevadm control --reload && sudo udevadm trigger"
        )
    return ""


def _is_felt(device: FoundDevice) -> bool:
    driver = driver_named(device.driver)
    return driver is None or driver.is_felt


def _specification(device: FoundDevice, plugged: list[FoundDevice]) -> str:
    """Returns what to type for a device: its port, or its serial where there are more like it."""
    if device.transport == "serial":
        return f"{device.driver}:{device.path}"
    driver = driver_named(device.driver)
    details = [driver.stated] if driver is not None and driver.stated else []
    alike = [other for other in plugged if other.driver == device.driver]
    if len(alike) > 1:
        details.append(f"serial={selector(device, alike)}")
    return ":".join(filter(None, (device.driver, ",".join(details))))


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
                "document": str(driver.document) if driver.document else None,
                "ids": [{"id": str(usb_id), "model": usb_id.model} for usb_id in driver.ids],
            }
            for driver in all_drivers()
        ],
        "plugged": [
            {**asdict(device), "next": _next(device, plugged) or None} for device in plugged
        ],
        "warnings": unseen,
    }


_MARKS = {True: "[green]good[/green]", False: "[yellow]mend[/yellow]", None: "note"}


@dataclass(frozen=True, slots=True)
class Doctor:
    """Measure whether this machine holds the loop's rate.

    Says what stands in the way. Needs no device and moves no motor. The exit code is 1 where the
    verdict is 'unfit'.

    Example:
        hapticbridge doctor --rate 2000 --duration 60
    """

    rate: float = shared(BridgeOptions, "rate", USUAL_RATE)
    """Ticks per second."""
    duration: float = option(20.0, unit="s", least=SHORTEST, most=LONGEST)
    """Seconds to measure; the loops that are compared take turns."""
    as_json: bool = option(False, flag="json")
    """Print the diagnosis as JSON."""

    def execute(self) -> int:
        """Measures and prints; returns the exit code."""
        with progress(f"measuring for {self.duration:g} s") as show:
            diagnosis = diagnose(self.rate, self.duration, progress=_in_tenths(show))
        if self.as_json:
            print_json(asdict(diagnosis))
        else:
            _print_diagnosis(diagnosis)
        return 1 if diagnosis.verdict == "unfit" else 0


def _in_tenths(show: Callable[..., None]) -> Callable[[float, float], None]:
    return lambda done, whole: show(round(10 * done), round(10 * whole))


def _print_diagnosis(diagnosis: Diagnosis) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("lateness in µs", "p50", "p99", "p99.9", "max", "missed"):
        table.add_column(heading, justify="left" if heading.startswith("late") else "right")
    for name, late in diagnosis.lateness.items():
        numbers = (late.median, late.p99, late.p999, late.worst)
        missed = f"{late.missed} of {late.ticks + late.missed}"
        table.add_row(name, *(f"{value * 1e6:.0f}" for value in numbers), missed)
    out.print(table)
    for finding in diagnosis.findings:
        out.print(f"{_MARKS[finding.is_good]}  {finding.name}: {plain(finding.sentence)}")
        if finding.remedy and finding.is_good is not True:
            out.print(f"      do: {plain(finding.remedy)}")
    out.print(f"[bold]{plain(diagnosis.sentence)}[/bold]")
