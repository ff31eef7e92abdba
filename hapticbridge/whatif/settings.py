"""Settings of a run that may be changed, by name."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields, replace

from hapticbridge.coupling import Coupling
from hapticbridge.errors import RecordingError, choices
from hapticbridge.guard import CONTROLLERS
from hapticbridge.kernel.codes import Grip
from hapticbridge.options import RunSetup, Workspace
from hapticbridge.rendering import CONTACTS, Method, method_named, method_names
from hapticbridge.request import RunRequest

UNITS = {
    "stiffness": "N/m",
    "damping": "N s/m",
    "rotational_stiffness": "N m/rad",
    "rotational_damping": "N m s/rad",
    "method": "",
    "contact": "",
    "rate": "Hz",
    "substeps": "",
    "scene_rate": "Hz",
    "scale": "",
    "force_scale": "",
    "contact_stiffness": "N/m",
    "controller": "",
}
"""Settings that may be changed besides the scene's parameters, with units."""

GAINS = tuple(field.name for field in fields(Coupling))
"""Names of K and B of translation, then of rotation."""

OF_HAND = (*GAINS, "scale", "force_scale")
"""Settings that each of several hands has for itself."""

Value = float | int | str


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings of a run besides scene, device and limits.

    Attributes:
        coupling: Requested K and B.
        method: Rendering method.
        rate: Ticks per second.
        substeps: MuJoCo steps per tick, or between two results of a slower scene.
        scene_rate: Results of the scene per second in Hz; ``rate`` steps it in every tick.
        scale: Handle motion per device motion.
        force_scale: Force on the device per force on the tool.
        contact_stiffness: K_c in N/m of method ``direct``; None takes the coupling's.
        scene: Values of the scene's parameters, by name.
        controller: Passivity controller by name; None takes the bridge's choice for the device.
    """

    coupling: Coupling
    method: Method
    rate: float
    substeps: int
    scene_rate: float
    scale: float
    force_scale: float
    contact_stiffness: float | None
    scene: Mapping[str, float]
    controller: str | None = None

    @classmethod
    def of(cls, request: RunRequest, setup: RunSetup) -> Settings:
        """Returns the settings of one hand of a request."""
        scale, force_scale = setup.workspace.scales
        return cls(
            coupling=setup.coupling,
            method=setup.method,
            rate=request.options.rate,
            substeps=setup.substeps,
            scene_rate=request.options.rate / max(setup.scene_ticks, 1),
            scale=scale,
            force_scale=force_scale,
            contact_stiffness=setup.contact_stiffness or None,
            scene=request.parameters,
            controller=request.options.controller,
        )

    @property
    def scales(self) -> tuple[float, float]:
        """Scales of motion and of force."""
        return self.scale, self.force_scale

    def scaled(self, workspace: Workspace) -> Workspace:
        """Returns a workspace with these scales."""
        own = None if self.force_scale == self.scale else self.force_scale
        return replace(workspace, scale=self.scale, force_scale=own)

    @property
    def timestep(self) -> float:
        """MuJoCo's h in s."""
        return max(round(self.rate / self.scene_rate), 1) / (self.rate * self.substeps)

    def value(self, name: str) -> Value | None:
        """Returns the value of a setting or scene parameter."""
        if name in GAINS:
            return float(getattr(self.coupling, name))
        if name == "method":
            return self.method.name
        if name == "contact":
            return self.method.contact
        if name == "controller":
            return self.controller or "as the device needs"
        if name in UNITS:
            value: Value | None = getattr(self, name)
            return value
        return self.scene[name]

    def changed(self, changes: Mapping[str, Value]) -> Settings:
        """Returns the settings with changes applied.

        If both scales were equal, a new ``scale`` also changes ``force_scale``, so that power stays
        equal on both sides. A scene that steps in every tick does so at a new ``rate`` too. A
        contact stiffness is dropped if the new method has none.

        Raises:
            RecordingError: A name is unknown, or its value is not valid.
            CouplingError: A gain is out of range.
        """
        known = {*UNITS, *self.scene}
        if unknown := [name for name in changes if name not in known]:
            raise RecordingError(
                f"'{unknown[0]:.60}' cannot be changed; choices: {choices(UNITS)}; of the scene: "
                f"{choices(self.scene)}"
            )
        values = {name: _convert(name, value) for name, value in changes.items()}
        method = method_named(str(values.get("method", self.method.name)))
        contact_name = values.get("contact")
        if contact_name is None and (method.can_be_rigid or not self.method.is_rigid):
            contact_name = self.method.contact
        method = method.with_contact(None if contact_name is None else str(contact_name))
        gains = {name: float(values[name]) for name in GAINS if name in values}
        rate = float(values.get("rate", self.rate))
        is_slow = self.scene_rate < self.rate
        scale = float(values.get("scale", self.scale))
        is_equal = self.scale == self.force_scale
        contact = values.get("contact_stiffness", self.contact_stiffness)
        controller = values.get("controller", self.controller)
        if method.has_coupling and "contact_stiffness" not in values:
            contact = None
        return Settings(
            coupling=replace(self.coupling, **gains),
            method=method,
            rate=rate,
            substeps=int(values.get("substeps", self.substeps)),
            scene_rate=float(values.get("scene_rate", self.scene_rate if is_slow else rate)),
            scale=scale,
            force_scale=float(values.get("force_scale", scale if is_equal else self.force_scale)),
            contact_stiffness=None if contact is None else float(contact),
            scene={name: float(values.get(name, was)) for name, was in self.scene.items()},
            controller=None if controller is None else str(controller),
        )


def changed_of_hands(
    hands: Mapping[str, Settings], changes: Mapping[str, Value]
) -> tuple[dict[str, Settings], tuple[Change, ...]]:
    """Returns the changed settings of each hand, and each change with unit, old and new value.

    Args:
        hands: Settings by grip, in the order of the hands.
        changes: As for ``Settings.changed``. Of several hands, ``OF_HAND`` change every hand but
            those on a joint, whose gains have other units; ``GRIP:NAME`` changes one hand.

    Raises:
        HapticBridgeError: As for ``Settings.changed``, or no hand has that grip.
    """
    if len(hands) == 1:
        [(grip, old)] = hands.items()
        new = old.changed(changes)
        rows = [(name, UNITS.get(name, ""), old.value(name), new.value(name)) for name in changes]
        return {grip: new}, tuple(rows)
    chosen: dict[str, dict[str, Value]] = {grip: {} for grip in hands}
    for name, value in sorted(changes.items(), key=lambda each: ":" in each[0]):
        grip, is_named, setting = name.rpartition(":")
        if is_named and (grip not in hands or setting not in OF_HAND):
            raise RecordingError(
                f"'{name:.60}' cannot be changed; write GRIP:NAME with a grip of {choices(hands)} "
                f"and a name of {choices(OF_HAND)}, or the name alone for all"
            )
        for each in [grip] if is_named else hands:
            if is_named or name not in OF_HAND or not Grip.from_text(each).is_joint:
                chosen[each][setting] = value
    news = {grip: old.changed(chosen[grip]) for grip, old in hands.items()}
    rows = []
    for number, (grip, own) in enumerate(chosen.items()):
        old, new = hands[grip], news[grip]
        for name in own:
            unit = "" if Grip.from_text(grip).is_joint else UNITS.get(name, "")
            if name in OF_HAND:
                rows.append((f"{name} at '{grip}'", unit, old.value(name), new.value(name)))
            elif number == 0:
                rows.append((name, unit, old.value(name), new.value(name)))
    return news, tuple(rows)


def changes_from(words: Iterable[str]) -> list[dict[str, Value]]:
    """Parses changes such as ``stiffness=3000`` and ``method=explicit``.

    One setting may have several values, as ``stiffness=400,800`` or by its name again: each of them
    gives a change of its own, beside the other settings.

    Raises:
        RecordingError: A word is not a name and a value, or two settings have several values.
    """
    values: dict[str, list[Value]] = {}
    for word in words:
        name, sign, text = (part.strip() for part in word.partition("="))
        if not (name and sign and text):
            raise RecordingError(
                f"cannot change '{word:.80}'; write a name and a value, such as stiffness=3000; "
                f"names: {choices(UNITS)}, and the scene's parameters"
            )
        values.setdefault(name, []).extend(part.strip() for part in text.split(","))
    several = [name for name, each in values.items() if len(each) > 1]
    if len(several) > 1:
        raise RecordingError(
            f"{choices(several)} have several values each; one setting at a time may have them"
        )
    count = max(map(len, values.values()), default=1)
    return [
        {name: each[index if len(each) > 1 else 0] for name, each in values.items()}
        for index in range(count)
    ]


def _convert(name: str, value: Value) -> Value:
    """Converts a value to the type of its setting; the bridge checks its range."""
    named: dict[str, Collection[object]] = {
        "method": method_names(),
        "contact": CONTACTS,
        "controller": CONTROLLERS,
    }
    if name in named:
        if value not in named[name]:
            raise RecordingError(
                f"{name} is {value!r:.60}; choose one of {choices(map(str, named[name]))}"
            )
        return value
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    unit = f" in {UNITS[name]}" if UNITS.get(name) else ""
    if not math.isfinite(number):
        raise RecordingError(f"{name} is {value!r:.60}; it must be a finite number{unit}")
    if name in ("scale", "force_scale") and number <= 0:
        raise RecordingError(f"{name} is {number!r}; it must be > 0")
    if name == "substeps":
        if not number.is_integer():
            raise RecordingError(f"substeps is {value!r:.60}; it must be a whole number")
        return int(number)
    return number


Change = tuple[str, str, Value | None, Value | None]
"""Name and unit of a setting, and its value before and after."""
