"""Devices by name, for the command line and scripts.

To add a driver to this tree (``hapticbridge guide device-package`` adds one from outside):

1. A module of ``device`` with a class of the protocol ``base.Device`` and a ``driver.Driver`` as
   ``DRIVER``: name, USB ids, options, the function that opens it. ``spacemouse`` is the shortest
   example; ``transport`` moves its bytes.
2. A row in ``DRIVERS``: its name and its module.
3. A profile in ``device/profiles`` for each model with measured or stated numbers.
4. A row in README's table of devices, and a section in ``guide/devices.md``.
5. Tests: an emulated unit in ``tests/emulated``, its entry in ``DEVICES`` of the contract suite
   (``tests/test_device_contract.py``), and ``tests/test_device_NAME.py`` for its own protocol.
6. ``scripts/freeze``: the printed lists of devices have the new name.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from hapticbridge.arguments import number_from
from hapticbridge.device.base import (
    Device,
    calling_on_error,
    checked,
    device_fault,
    telling,
)
from hapticbridge.device.driver import Driver, FoundDevice, Notify, Options, ignore_message
from hapticbridge.device.motion_file import motion_in, read_recorded
from hapticbridge.device.profile import modelled, profile_named, profile_of
from hapticbridge.device.simulated.device import (
    GrippingDevice,
    SimulatedDevice,
    hand_for,
    scene_hand,
)
from hapticbridge.device.simulated.dynamics import Hand
from hapticbridge.device.trajectory import Motion, ReplayDevice, TrajectoryDevice
from hapticbridge.errors import DeviceError, choices, nearest
from hapticbridge.kernel.codes import Grip
from hapticbridge.scene import Scene

# Table of the hardware drivers; a driver is imported when one of its devices is opened

DRIVERS = {
    "mouse": "hapticbridge.device.mouse",
    "falcon": "hapticbridge.device.falcon.device",
    "spacemouse": "hapticbridge.device.spacemouse",
    "rawhid": "hapticbridge.device.rawhid.device",
    "serial": "hapticbridge.device.rawhid.serial",
    "pid": "hapticbridge.device.pid.device",
    "wheel": "hapticbridge.device.wheel.device",
    "haply": "hapticbridge.device.haply",
    "forcedimension": "hapticbridge.device.force_dimension",
    "touch": "hapticbridge.device.touch.device",
}
"""Module of each driver by the driver's name, in the order in which drivers are listed. The module
holds the ``Driver`` as ``DRIVER``."""


GROUP = "hapticbridge.devices"
"""Entry points by which other packages add drivers. The name is the device's, the object a
``Driver`` of that name. A name of this package cannot be replaced."""


def installed_drivers() -> dict[str, EntryPoint]:
    """Returns the entry points of other packages by name, without importing them."""
    found = sorted(entry_points(group=GROUP), key=lambda entry: entry.name)
    return {entry.name: entry for entry in found if not is_own(entry.name)}


def is_own(name: str) -> bool:
    """Returns whether a device's name is of this package."""
    return name in DRIVERS or name in _OPENERS


def is_driver(name: str) -> bool:
    """Returns whether a name is that of a hardware driver, own or installed; imports none."""
    return name in DRIVERS or (not is_own(name) and name in installed_drivers())


def is_device(spec: str) -> bool:
    """Returns whether a specification begins with the name of a device; imports none."""
    name = spec.partition(":")[0]
    return is_own(name) or is_driver(name)


def driver_named(name: str) -> Driver | None:
    """Returns the driver that ``open_device`` knows by a name, or None.

    Raises:
        DeviceError: The driver is of another package, which cannot be imported or holds no
            ``Driver`` of that name.
    """
    if name in DRIVERS:
        driver: Driver = import_module(DRIVERS[name]).DRIVER
        return driver
    if is_own(name) or (entry := installed_drivers().get(name)) is None:
        return None
    package = entry.dist.name if entry.dist is not None else entry.module
    try:
        driver_of_package = entry.load()
    except (Exception, SystemExit) as error:
        raise DeviceError(
            f"the device '{name}' of the package {package} cannot be imported: "
            f"{type(error).__name__}: {error}"
        ) from error
    if not isinstance(driver_of_package, Driver) or driver_of_package.name != name:
        raise DeviceError(
            f"the package {package} names {entry.value} as the device '{name}'; it must be a "
            "hapticbridge.device.driver.Driver of that name"
        )
    return _with_device_errors(driver_of_package, package)


def _with_device_errors(driver: Driver, package: str) -> Driver:
    """Returns the driver of a package with every error of its functions as a ``DeviceError``."""
    about = f"the device '{driver.name}' of the package {package}"

    def found() -> list[FoundDevice]:
        with telling(f"{about}: find"):
            devices = list(driver.find() if driver.find is not None else [])
            if any(getattr(each, "driver", None) != driver.name for each in devices):
                raise TypeError(f"it must list FoundDevice with the driver '{driver.name}'")
            return devices

    def medium() -> str:
        try:
            with telling(f"{about}: medium"):
                return str(driver.medium() if driver.medium is not None else "")
        except DeviceError as error:
            return str(error)

    def opened(options: Mapping[str, object], notify: Notify) -> Device:
        with telling(f"{about}: open"):
            device = driver.open(options, notify)
            if fault := device_fault(device):
                raise TypeError(f"it must return a device, and what it returned {fault}")
            return device

    return replace(
        driver,
        open=opened,
        find=None if driver.find is None else found,
        medium=None if driver.medium is None else medium,
    )


def all_drivers() -> tuple[Driver, ...]:
    """Returns every driver that can be imported, those of this package first; imports them."""
    drivers = []
    for name in (*DRIVERS, *installed_drivers()):
        with suppress(DeviceError):  # broken_drivers() has the reason
            drivers.append(driver_named(name))
    return tuple(driver for driver in drivers if driver is not None)


def broken_drivers() -> list[str]:
    """Returns a sentence for each driver of another package that cannot be used."""
    reasons = []
    for name in installed_drivers():
        try:
            driver = driver_named(name)
            if driver is not None and driver.find is not None:
                driver.find()
        except DeviceError as error:
            reasons.append(str(error))
    return reasons


# Options of a device specification: ``name=value,name=value``


def parsed(device: str, text: str, valid: Options, first: str = "") -> dict[str, object]:
    """Parses the options after a device's name, separated by commas.

    A ``Path`` takes all remaining text, commas included. If ``first`` names an option, the text may
    begin with its value alone.

    Raises:
        DeviceError: A part is not ``name=value``, a name occurs twice or is unknown, or a value is
            not a number.
    """
    values: dict[str, object] = {}
    if first and text and "=" not in text.partition(",")[0]:
        text = f"{first}={text}"
    while text:
        name, equals, text = text.partition("=")
        name = name.strip()
        if not equals:
            raise DeviceError(f"'{name}' is not an option; write options as name=value")
        if name in values:
            raise DeviceError(f"option '{name}' is set twice; set it once")
        refuse_unknown(device, [name], valid)
        kind = valid[name]
        if kind is Path:
            value, text = text, ""
            _refuse_options_in_path(name, value, valid)
        else:
            value, _, text = text.partition(",")
        try:
            written = value.strip()
            is_number = kind in (int, float)
            values[name] = number_from(written, kind) if is_number else kind(written)
        except ValueError:
            number = "a whole number" if kind is int else "a number"
            raise DeviceError(f"{name} is '{written}'; it must be {number}") from None
    return values


def _refuse_options_in_path(name: str, text: str, valid: Options) -> None:
    """Refuses options after a file's name, to which the text would count, unless it is a file.

    Raises:
        DeviceError: They follow it.
    """
    file, *others = text.split(",")
    are_options = [each.partition("=")[0].strip() in valid for each in others]
    if any(are_options) and not os.path.exists(text):  # noqa: PTH110 - a name may be too long
        first = are_options.index(True)
        options = ",".join(others[first:])
        raise DeviceError(
            f"{name}= must come last, because all text after it is the file's name: write "
            f"{options},{name}={','.join([file, *others[:first]])}"
        )


def refuse_unknown(device: str, options: Iterable[str], valid: Iterable[str]) -> None:
    """Raises DeviceError for an unknown option; the message lists the valid ones."""
    names = tuple(valid)
    unknown = [name for name in options if name not in names]
    if device == "simulated" and not {"loop_rate", "loop_delay"}.isdisjoint(unknown):
        raise DeviceError(
            "the simulated device has no board with a loop of its own; 'hapticbridge bound "
            "--loop-rate HZ --loop-delay SECONDS' judges a coupling on one without hardware"
        )
    if unknown:
        raise DeviceError(
            f"unknown option '{unknown[0]}' of the {device} device; choose one of {choices(names)}"
        )


_HAND_PREFIX = "hand_"
_HAND_OPTIONS = tuple(_HAND_PREFIX + name for name in inspect.signature(Hand).parameters)
_STATED_PREFIX = "stated_"
_STATED_OPTIONS = tuple(
    _STATED_PREFIX + name for name in ("damping", "delay", "friction", "resolution")
)


def _stated(text: str) -> float | None:
    """Returns a value of a data sheet; None for ``unknown``."""
    return None if text == "unknown" else number_from(text)


_SIMULATED_OPTIONS: Options = {
    **dict.fromkeys((*inspect.signature(SimulatedDevice).parameters, *_HAND_OPTIONS), float),
    **dict.fromkeys(_STATED_OPTIONS, _stated),
    "delay": int,
    "dof": int,
    "hand": str,
    "path": Path,
}
_LIMITS = ("force_limit", "torque_limit", "speed_limit")


def open_device(spec: str, *, notify: Notify = ignore_message, **options: object) -> Device:
    """Opens a device by its specification.

    A specification is a name, or a name, a colon and details of the device:

    - ``simulated``, ``simulated:damping=5,friction=0.1``: a ``SimulatedDevice`` with these
      parameters, numbers in SI units. ``hand_mass``, ``hand_damping``, ``hand_stiffness``,
      ``hand_rotational_inertia``, ``hand_rotational_damping`` and ``hand_rotational_stiffness``
      change its hand, ``hand=none`` removes it. ``stated_damping``, ``stated_delay`` in s,
      ``stated_friction`` and ``stated_resolution`` are what its data sheet says, or ``unknown``, in
      place of the truth. ``path=FILE`` must be last: all text after it is the file's name.
    - ``trajectory:FILE``: follows a CSV file (``read_motion``), or a bag of ROS 2 in MCAP, or
      repeats the device motion of a recording. All text after the colon is the file's name, with
      commas and colons; of a bag with several poses, ``FILE:/TOPIC``.
    - ``mouse``: a handle that is dragged in the view, ``mouse:speed=0.5``.
    - a connected device, by the name of its driver (``hapticbridge devices`` lists them), with
      options of that driver: ``spacemouse:speed=0.1,turn=1,dead_band=0.05``,
      ``rawhid:serial=12345,damping=2``, ``serial:/dev/ttyACM0,baud=115200``,
      ``falcon:firmware=FILE``, ``pid:newtons=4,travel=0.08``, ``wheel:max_torque=2``,
      ``haply:serial=049D``, ``forcedimension:library=FILE``, ``touch:library=FILE``. ``serial``
      selects one of several, ``log=FILE`` records the transferred bytes. Numbers unknown to the
      driver come from the profile of the unit or its model, or from ``profile=NAME`` (or a file,
      or ``none``).

    Args:
        spec: The specification.
        notify: Receives messages for the user while the device is opened: instructions and
            progress.
        **options: The parameters as keyword arguments; the specification takes precedence. A
            trajectory takes ``force_limit`` (N), ``torque_limit`` (N m) and ``speed_limit`` (m/s).

    Returns:
        The device, not yet started. A real device is claimed, so that a missing one is refused at
        once.

    Raises:
        DeviceError: The name, an option or a value is not valid, the file is not a motion, or the
            device is not connected or cannot be opened.
        RecordingError: The file is a recording that cannot be read.
    """
    name, _, rest = spec.partition(":")
    if (driver := driver_named(name)) is not None:
        valid: Options = {**driver.options, "profile": str}
        refuse_unknown(name, options, valid)
        requested = {**options, **parsed(name, rest, valid, driver.first)}
        profile_option = requested.get("profile")
        if "profile" not in driver.options:
            requested.pop("profile", None)
        profile = None if profile_option in (None, "none") else profile_named(str(profile_option))
        device = driver.open(requested, notify)
        with calling_on_error(checked(device).close):
            if profile_option is None:
                model = device.info.name
                profile = profile_of(name, device.info.serial, model)
                if profile is None and (models := modelled(name)):
                    notify(f"no profile of '{model}' exists; profiles: {choices(models)}")
            if profile is not None:
                device.info = profile.fill(device.info)
                notify(f"what '{name}' leaves out is taken from the profile '{profile.name}'")
        return device
    if name not in _OPENERS:
        names = [*_OPENERS, *DRIVERS, *installed_drivers()]
        raise DeviceError(
            f"unknown device '{name}'; {_meant(name) or nearest(name, names)}choose one of "
            f"{choices(names)}"
        )
    return _OPENERS[name](rest, options)


def _motion_beside(scene: Scene, part: str) -> Path | None:
    """Returns the motion ``NAME.csv`` or ``NAME_PART.csv`` beside a scene, or None.

    A slash in a name, as those of attached parts have, is an underscore in the file's.
    """
    name = "_".join(filter(None, (scene.name, part))).replace("/", "_")
    path = scene.path.parent / f"{name}.csv"
    return path if os.path.isfile(path) else None  # noqa: PTH113 - a name may be too long


def _meant(product: str) -> str:
    """Asks for the device that opens a maker's product, as 'haply' an 'Inverse3'; else empty."""
    asked = re.findall(r"[a-z]{4,}", product.lower())
    for driver in filter(None, map(driver_named, DRIVERS)):
        sold = (driver.about.partition(" through ")[0], *(each.model for each in driver.ids))
        if set(asked[:1]) & set(re.findall(r"[a-z]{4,}", " ".join(sold).lower())):
            return f"did you mean '{driver.name}' ({driver.about})? "
    return ""


def device_for(
    scene: Scene, spec: str, notify: Notify = ignore_message, grip_axis: str = ""
) -> Device:
    """Opens a device for a scene; a simulated device takes its hand and its path from the scene.

    The hand is the scene's (``hand_for``) and follows ``NAME.csv`` beside the scene, if present;
    one of several hands follows ``NAME_GRIP.csv``. Every option in the specification takes
    precedence over the scene. If its grip axis moves a joint, ``grip_axis``, a simulated device has
    one, whose fingers follow ``NAME_JOINT.csv``.

    Raises:
        DeviceError: As for ``open_device``.
        SceneError: The scene specifies an impossible hand.
    """
    name, _, rest = spec.partition(":")
    if name != "simulated":
        return open_device(spec, notify=notify)
    options: dict[str, object] = {}
    if "hand" not in parsed(name, rest, _SIMULATED_OPTIONS):
        hand, usual = hand_for(scene), scene_hand(scene.model, scene.path)
        options |= {_HAND_PREFIX + field: value for field, value in asdict(hand).items()}
        if hand != usual:
            notify(
                f"the simulated hand grips with {hand.stiffness:.0f} N/m instead of "
                f"{usual.stiffness:g}, so that it holds this tool"
            )
    others = [each for each in scene.other_grips if each != str(Grip(grip_axis, "joint"))]
    grip = Grip.from_text(scene.grip).name
    if path := _motion_beside(scene, grip if others else ""):
        options["path"] = path
    device = open_device(spec, notify=notify, **options)
    if not grip_axis:
        return device
    fingers = SimulatedDevice(
        mass=GRIP_AXIS[0],
        damping=GRIP_AXIS[1],
        hand=FINGERS_HAND,
        path=_motion_beside(scene, grip_axis),
        force_limit=GRIP_AXIS[2],
        dof=3,
    )
    return GrippingDevice(device, fingers, GRIP_AXIS[3])


FINGERS_HAND = Hand(mass=0.02, stiffness=1500.0, damping=8.0)
"""Fingers that close a grip axis, in kg, N/m and N s/m. Stiffer ones follow their path more
closely, and yield less to the force."""

GRIP_AXIS = 0.05, 2.0, 8.0, 0.03
"""Grip axis of a simulated device: inertia in kg, damping in N s/m, and its largest force in N and
travel in m, those of a sigma.7."""


def _open_simulated(rest: str, options: Mapping[str, object]) -> Device:
    refuse_unknown("simulated", options, _SIMULATED_OPTIONS)
    requested = parsed("simulated", rest, _SIMULATED_OPTIONS)
    parameters: dict[str, Any] = {**options, **requested}
    changes = {name: parameters.pop(name) for name in _HAND_OPTIONS if name in parameters}
    stated: dict[str, Any] = {
        name.removeprefix(_STATED_PREFIX): parameters.pop(name)
        for name in _STATED_OPTIONS
        if name in parameters
    }
    if "hand" not in parameters:
        parameters["hand"] = Hand(
            **{name.removeprefix(_HAND_PREFIX): value for name, value in changes.items()}
        )
    elif changes:
        raise DeviceError(f"hand and {choices(changes)} exclude each other; set one of them")
    if parameters["hand"] == "none":
        parameters["hand"] = None
    elif not isinstance(parameters["hand"], Hand | None):
        raise DeviceError(
            f"hand is {parameters['hand']!r}; it must be 'none'; {choices(_HAND_OPTIONS)} change it"
        )
    device = SimulatedDevice(**parameters)
    if "delay" in stated:
        stated["is_delay_measured"] = False
    device.info = replace(device.info, **stated)
    return device


def _open_trajectory(rest: str, options: Mapping[str, object]) -> Device:
    refuse_unknown("trajectory", options, _LIMITS)
    limits: dict[str, Any] = dict(options)
    if not rest:
        raise DeviceError("trajectory needs a file: 'trajectory:FILE', a CSV file or a recording")
    found = motion_in(rest)
    if isinstance(found, Motion):
        return TrajectoryDevice(found, **limits)
    ticks, period = read_recorded(found)
    return ReplayDevice(ticks, period, name=str(found), **limits)


_OPENERS: dict[str, Callable[[str, Mapping[str, object]], Device]] = {
    "simulated": _open_simulated,
    "trajectory": _open_trajectory,
}
