"""Settings of a run that may be changed, by name: the fields of its options, and the scene's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import Field, dataclass, fields, replace
from typing import Any

from hapticbridge.arguments import number_from, rule_of, shown, types_of, value_from
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.demand.methods import SCENE, Method, method_named
from hapticbridge.errors import RecordingError, choices
from hapticbridge.kernel.codes import Grip
from hapticbridge.run.options import BridgeOptions, RunSetup, Workspace
from hapticbridge.run.request import RunRequest

KEPT = {
    "axes": "the recorded motion is that of these axes",
    "absolute": "the recorded motion is relative or not",
    "clutch": "its presses are recorded",
    "dead_man": "its presses are recorded",
    "mark": "its presses are recorded",
    "probe": "no device is there to be probed",
    "tool_weight": "the recorded scene carries it or not",
    "i_know": "no hand is at the device",
    "realtime": "the time is not real",
    "pipelined": "the numbers are the same",
    "live": "a repetition is not shown",
}
"""Options that a what-if does not change, each with the reason."""


def _changeable() -> dict[str, tuple[Any, Field[Any]]]:
    """Returns class and field of each setting that may be changed, by the name of its flag."""
    settings: dict[str, tuple[Any, Field[Any]]] = {}
    kinds: tuple[Any, ...] = (Coupling, BridgeOptions, Workspace, Limits)
    for kind in kinds:
        for each in fields(kind):
            name = (rule_of(each).flag or each.name).replace("-", "_")
            if name not in KEPT and types_of(kind)[each.name] not in kinds:
                settings[name] = kind, each
    return settings


CHANGEABLE = _changeable()
"""Settings that may be changed besides the scene's parameters: class and field."""

GAINS = tuple(field.name for field in fields(Coupling))
"""Names of K and B of translation, then of rotation."""

OF_HAND = (*GAINS, "scale", "force_scale")
"""Settings that each of several hands has for itself."""

Value = float | int | str


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings of a run besides scene and device, of one hand.

    Attributes:
        coupling: Requested K and B.
        options: Options, with what the run chose where they left it open, and with the hand's own
            workspace and limits.
        scene: Values of the scene's parameters, by name.
    """

    coupling: Coupling
    options: BridgeOptions
    scene: Mapping[str, float]

    @classmethod
    def of(cls, request: RunRequest, setup: RunSetup) -> Settings:
        """Returns the settings of one hand of a request."""
        options = replace(
            request.options,
            method=setup.method.name,
            contact=setup.method.contact,
            substeps=setup.substeps,
            rate=request.options.loop_rate,
            scene_rate=request.options.loop_rate / max(setup.scene_ticks, 1),
            contact_stiffness=setup.contact_stiffness or None,
            workspace=setup.workspace,
            limits=setup.limits,
        )
        return cls(coupling=setup.coupling, options=options, scene=request.parameters)

    @property
    def method(self) -> Method:
        """Rendering method."""
        return self.options.rendering_method

    @property
    def timestep(self) -> float:
        """MuJoCo's h in s."""
        ticks = max(self.options.scene_ticks, 1)
        return ticks / (self.options.loop_rate * (self.options.substeps or 1))

    @property
    def loop(self) -> tuple[object, ...]:
        """Settings on which the effective coupling depends."""
        return self.coupling, self.method, self.options.loop_rate, self.timestep

    @property
    def steps_per_second(self) -> float:
        """MuJoCo's steps per second of a scene that steps in every tick."""
        return self.options.loop_rate * (self.options.substeps or 1)

    def value(self, name: str) -> Value | None:
        """Returns the value of a setting or scene parameter."""
        if name not in CHANGEABLE:
            return self.scene[name]
        if name == "force_scale":
            return self.options.workspace.scales[1]
        value: Value | None = getattr(self._holder(name), CHANGEABLE[name][1].name)
        return "as the device needs" if name == "controller" and value is None else value

    def _holder(self, name: str) -> object:
        """Returns the object with the field of a setting."""
        kind = CHANGEABLE[name][0]
        parts = self.coupling, self.options, self.options.workspace, self.options.limits
        return next(part for part in parts if isinstance(part, kind))

    def changed(self, changes: Mapping[str, Value]) -> Settings:
        """Returns the settings with changes applied.

        If both scales were equal, a new ``scale`` also changes ``force_scale``, so that power stays
        equal on both sides. A scene that steps in every tick does so at a new ``rate`` too. A
        contact stiffness is dropped if the new method has none.

        Raises:
            RecordingError: A name is unknown, or its value is of another type.
            HapticBridgeError: A value is out of range.
        """
        known = {*CHANGEABLE, *self.scene}
        if unknown := [name for name in changes if name not in known]:
            raise RecordingError(
                f"'{unknown[0]:.60}' cannot be changed; choices: {choices(CHANGEABLE)}; of the "
                f"scene: {choices(self.scene)}"
            )
        options, workspace = self.options, self.options.workspace
        if workspace.scale == workspace.force_scale:
            workspace = replace(workspace, force_scale=None)
        own: dict[Any, dict[str, Any]] = {kind: {} for kind, _ in CHANGEABLE.values()}
        for name in CHANGEABLE.keys() & changes.keys():
            kind, field = CHANGEABLE[name]
            own[kind][field.name] = _converted(name, changes[name], kind, field)
        new = own[BridgeOptions]
        method = method_named(str(new.get("method", options.method)))
        if "contact" not in new and self.method.is_rigid and not method.can_be_rigid:
            new["contact"] = None
        if options.scene_ticks == 0:
            new.setdefault("scene_rate", new.get("rate", options.loop_rate))
        if method.has_coupling:
            new.setdefault("contact_stiffness", None)
        if new.get("impact_pulses") == 0.0:
            new.setdefault("pulse", SCENE)
        new["workspace"] = replace(workspace, **own[Workspace])
        new["limits"] = replace(options.limits, **own[Limits])
        scene = {
            name: _number(name, changes[name]) if name in changes else was
            for name, was in self.scene.items()
        }
        return Settings(
            coupling=replace(self.coupling, **own[Coupling]),
            options=replace(options, **new),
            scene=scene,
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
        rows = [(name, _unit(name), old.value(name), new.value(name)) for name in changes]
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
            unit = "" if Grip.from_text(grip).is_joint else _unit(name)
            if name in OF_HAND:
                rows.append((f"{name} at '{grip}'", unit, old.value(name), new.value(name)))
            elif number == 0:
                rows.append((name, unit, old.value(name), new.value(name)))
    return news, tuple(rows)


def changes_from(words: Iterable[str]) -> list[dict[str, Value]]:
    """Parses changes such as ``stiffness=3000`` and ``method=explicit``.

    One setting may have several values, as ``stiffness=400,800`` or by its name again: each of them
    gives a change of its own, beside the other settings. A name may have the dashes of its flag.

    Raises:
        RecordingError: A word is not a name and a value, or two settings have several values.
    """
    values: dict[str, list[Value]] = {}
    for word in words:
        name, sign, text = (part.strip() for part in word.partition("="))
        if not (name and sign and text):
            raise RecordingError(
                f"cannot change '{word:.80}'; write a name and a value, such as stiffness=3000; "
                f"names: {choices(CHANGEABLE)}, and the scene's parameters"
            )
        name = _plain_name(name)
        values.setdefault(name, []).extend(_values(name, text))
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


def _values(name: str, text: str) -> list[str]:
    """Returns the values that a text has between commas; a pulse of numbers, HZ,MS, is one."""
    parts = [part.strip() for part in text.split(",")]
    if name == "pulse" and not any(part.isalpha() for part in parts):
        parts = [",".join(parts[i : i + 2]) for i in range(0, len(parts), 2)]
    return parts


def _plain_name(name: str) -> str:
    """Returns a name without the dashes of a flag; one of the scene's parameters stays."""
    grip, colon, setting = name.rpartition(":")
    plain = setting.replace("-", "_")
    return f"{grip}{colon}{plain}" if plain in CHANGEABLE else name


def _unit(name: str) -> str:
    return rule_of(CHANGEABLE[name][1]).unit if name in CHANGEABLE else ""


def _converted(name: str, value: Value, kind: Any, field: Field[Any]) -> Any:
    """Returns a value of a setting's type; its class checks the range."""
    if not isinstance(value, str):
        return value
    try:
        return value_from(types_of(kind)[field.name], value, rule_of(field))
    except ValueError as valid:
        raise RecordingError(f"{name} is {shown(value)}; it must be {valid}") from None


def _number(name: str, value: Value) -> float:
    """Returns the value of a scene's parameter, whose range the scene checks."""
    try:
        return number_from(value) if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        raise RecordingError(f"{name} is {shown(value)}; it must be a number") from None


Change = tuple[str, str, Value | None, Value | None]
"""Name and unit of a setting, and its value before and after."""
