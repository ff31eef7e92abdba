"""Parameters of a scene, set in its specification."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from numbers import Real
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hapticbridge.arguments import number_from
from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.mujoco_c import copy_of

# Parameter file of a scene

KINDS = {
    "body": "bodies",
    "geom": "geoms",
    "joint": "joints",
    "site": "sites",
    "tendon": "tendons",
    "actuator": "actuators",
    "equality": "equalities",
    "pair": "pairs",
    "key": "keys",
}
"""Elements that a parameter may set, and the attribute of MjSpec that lists them."""

TAKEN = ("path_or_name", "grip", "as_is")
"""Arguments of ``load_scene`` that are not parameters."""


@dataclass(frozen=True, slots=True)
class Effect:
    """One number of the MJCF that depends on a parameter: offset + factor · value.

    Attributes:
        kind: Kind of the element: ``geom``, ``joint``, …
        name: Name of the element, or a pattern.
        field: Name of the field in MjSpec.
        index: Index within the field; None for a field that is one number.
        offset: Offset in the field's unit.
        factor: Factor in the field's unit per unit of the parameter.
    """

    kind: str
    name: str
    field: str
    index: int | None = None
    offset: float = 0.0
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """A settable number of a scene, such as a clearance.

    Attributes:
        name: Name in ``load_scene`` and ``--set``.
        unit: SI unit, or empty.
        default: Value in the scene's MJCF.
        minimum: Smallest allowed value.
        maximum: Largest allowed value.
        about: Description, in half a sentence.
        sets: Numbers of the MJCF that depend on it.
    """

    name: str
    unit: str
    default: float
    minimum: float
    maximum: float
    about: str
    sets: tuple[Effect, ...]

    @property
    def range(self) -> str:
        """Allowed range with its unit: ``5e-05 to 0.001 m``."""
        return f"{self.minimum:g} to {self.maximum:g} {self.unit}".rstrip()

    def __str__(self) -> str:
        return f"{self.name} ({self.range}, default {self.default:g})"


def parameters_file(scene: Path) -> Path:
    """Returns the path of a scene's parameter file, which may not exist."""
    return scene.with_suffix(".toml")


def scene_parameters(scene: Path) -> tuple[Parameter, ...]:
    """Returns the parameters of a scene, in the order of its file; empty without a file.

    A scene ``NAME.xml`` may have a file ``NAME.toml`` beside it. Each table describes one parameter
    and the numbers of the MJCF that depend on it:

        [parameters.clearance]
        unit = "m"
        default = 0.2e-3
        minimum = 0.05e-3
        maximum = 1e-3
        about = "gap between peg and wall, a side"
        sets = [
          { kind = "geom", name = "hole_east", field = "pos", index = 0, offset = 0.02, factor = 1.0
          },
        ]

        field[index] = offset + factor · value

    in the units of the MJCF. ``name`` may contain ``*``, ``?`` and ``[]`` and then selects all
    matching elements. ``index`` is omitted for a field that is a single number.

    The default must reproduce the value in the MJCF, so that the MJCF alone is the default scene in
    any viewer. Numbers without a setting remain as in the file, bit for bit. If several parameters
    set one number, it is the sum of their terms. For example, the holding torque of a clamp is the
    nut's breakaway torque minus its running torque.

    A TOML file without a table ``parameters`` is ignored.

    Args:
        scene: The MJCF file.

    Raises:
        SceneError: The file cannot be read, or an entry is unknown, missing or out of range.
    """
    file = parameters_file(scene)
    if not file.is_file():
        return ()
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8")).get("parameters", {})
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"cannot read the scene's parameters in '{file}': {error}") from None
    if not isinstance(tables, dict):
        raise SceneError(f"'parameters' in '{file}' must be a table of parameters")
    return tuple(_parameter(name, table, file) for name, table in tables.items())


def is_finite_number(value: object) -> bool:
    """Returns whether a value is a finite real number; booleans are not numbers."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


_KEYS = {"unit", "default", "minimum", "maximum", "about", "sets"}
_SET_KEYS = {"kind", "name", "field", "index", "offset", "factor"}


def _parameter(name: str, table: object, file: Path) -> Parameter:
    where = f"parameter '{name}' in '{file}'"
    if not name.isidentifier() or name in TAKEN:
        raise SceneError(
            f"{where} must have the name of a Python argument, but not {choices(TAKEN)}"
        )
    if not isinstance(table, dict) or set(table) != _KEYS:
        raise SceneError(f"{where} must have the keys {choices(_KEYS)} and no others")
    numbers = [table[key] for key in ("minimum", "default", "maximum")]
    low, default, high = numbers
    if not all(map(is_finite_number, numbers)) or not low <= default <= high:
        raise SceneError(f"{where} needs finite numbers, minimum <= default <= maximum: {numbers}")
    if not isinstance(table["unit"], str) or not isinstance(table["about"], str):
        raise SceneError(f"{where} needs texts as unit and about")
    if not isinstance(table["sets"], list) or not table["sets"]:
        raise SceneError(f"{where} sets nothing; 'sets' must be a list of tables")
    sets = tuple(_setting(entry, where) for entry in table["sets"])
    return Parameter(
        name, table["unit"], float(default), float(low), float(high), table["about"], sets
    )


def _setting(entry: object, where: str) -> Effect:
    if not isinstance(entry, dict) or not {"kind", "name", "field"} <= set(entry) <= _SET_KEYS:
        raise SceneError(
            f"an entry of 'sets' of {where} is {entry!r:.80}; it must be a table with kind, name "
            "and field, and at most index, offset and factor"
        )
    index, numbers = entry.get("index"), [entry.get("offset", 0.0), entry.get("factor", 1.0)]
    is_index = index is None or (type(index) is int and index >= 0)
    if (
        not (entry["kind"] in KINDS and is_index and all(map(is_finite_number, numbers)))
        or not isinstance(entry["name"], str)
        or not isinstance(entry["field"], str)
    ):
        raise SceneError(
            f"an entry of 'sets' of {where} is {entry!r:.120}; kind must be one of "
            f"{choices(KINDS)}, index a whole number >= 0, offset and factor finite"
        )
    return Effect(entry["kind"], entry["name"], entry["field"], index, *map(float, numbers))


_AGREEMENT, _ROUNDING = 1e-9, 1e-12
"""Largest relative and absolute difference between the MJCF and the default. The first admits a
file with ten digits, the second the rounding of a sum that should be 0."""


def apply_parameters(
    spec: mujoco.MjSpec, scene: Path, values: Mapping[str, float]
) -> dict[str, float]:
    """Sets parameters in a scene before it is compiled.

    Args:
        spec: The scene as read from its file; changed in place.
        scene: The MJCF file.
        values: Values by name; other parameters keep their defaults.

    Returns:
        Every parameter of the scene with its effective value.

    Raises:
        SceneError: A name is unknown, a value is not finite or out of range, or the parameter file
            does not fit the scene.
    """
    known = {parameter.name: parameter for parameter in scene_parameters(scene)}
    for name, value in values.items():
        _check_value(scene.stem, name, value, known)
    effective = {name: float(values.get(name, p.default)) for name, p in known.items()}
    places: dict[tuple[str, str, str, int | None], _Place] = {}
    for parameter in known.values():
        for setting in parameter.sets:
            for element in _elements(spec, setting, parameter.name):
                key = setting.kind, str(element.name), setting.field, setting.index
                places.setdefault(key, _Place(element, setting)).add(parameter, setting)
    for place in places.values():
        place.set(effective, values)
    _check_effects(spec, places.values())
    return effective


_TRIED = 3
"""Number of elements of a setting, from the first on, whose effect is tried. Those that a pattern
names are copies of a part, and each trial compiles the scene: 889 of a bowl of beads take 10 s."""


def _check_effects(spec: mujoco.MjSpec, places: Iterable[_Place]) -> None:
    """Refuses a number that was set and, beside all others, changes nothing when compiled."""
    of_setting: dict[int, list[tuple[_Place, float]]] = {}
    for place in places:
        if place.was is not None:
            of_setting.setdefault(id(place.setting), []).append((place, place.was))
    changed = [pair for pairs in of_setting.values() for pair in pairs[:_TRIED]]
    whole = _compiled(spec) if changed else None
    for place, was in changed:
        result, place.number = place.number, was
        other, place.number = _compiled(spec), result
        if whole is not None and other == whole:
            raise SceneError(
                f"{place.subject} to {result:g}, which changes nothing: the scene's file "
                "determines it otherwise, as <inertial> does the mass of geoms, fromto a length, "
                "a mesh its size and euler a quat"
            )


def _compiled(spec: mujoco.MjSpec) -> bytes | None:
    """Returns the compiled scene; None if MuJoCo refuses it, which its loading tells."""
    with suppress(ValueError, mujoco.FatalError):
        copy = copy_of(spec)
        copy.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
        copy.memory, copy.nstack, copy.njmax, copy.nconmax = -1, -1, -1, -1
        model = copy.compile()
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer.tobytes()
    return None


def settings_from(words: Iterable[str]) -> dict[str, float]:
    """Returns values by name from words such as ``clearance=0.1e-3``.

    Raises:
        SceneError: A word is not a name and a number, or a name occurs twice.
    """
    values: dict[str, float] = {}
    for word in words:
        name, sign, number = word.partition("=")
        try:
            value = number_from(number)
        except ValueError:
            sign, value = "", math.nan
        if not (name and sign) or name in TAKEN:
            raise SceneError(
                f"cannot set '{word:.80}'; write a parameter of the scene and a number, such as "
                "clearance=0.1e-3"
            )
        if name in values:
            raise SceneError(f"parameter '{name}' is set twice; set it once")
        values[name] = value
    return values


def _check_value(scene: str, name: str, value: float, known: Mapping[str, Parameter]) -> None:
    if not known:
        raise SceneError(
            f"scene '{scene}' has no parameters, so '{name}' cannot be set; define parameters in "
            f"'{scene}.toml' beside it"
        )
    exist = "; ".join(map(str, known.values()))
    if name not in known:
        raise SceneError(f"scene '{scene}' has no parameter '{name}'; it has: {exist}")
    parameter = known[name]
    if not is_finite_number(value) or not parameter.minimum <= value <= parameter.maximum:
        raise SceneError(
            f"parameter '{name}' of scene '{scene}' is {value!r}; it must be a number from "
            f"{parameter.range}; parameters: {exist}"
        )


def _elements(spec: mujoco.MjSpec, setting: Effect, parameter: str) -> list[Any]:
    named = [element for element in getattr(spec, KINDS[setting.kind]) if element.name]
    found = [element for element in named if fnmatchcase(element.name, setting.name)]
    if not found:
        raise SceneError(
            f"parameter '{parameter}' sets {setting.kind} '{setting.name}', which the scene does "
            f"not have; it has: {choices(element.name for element in named)}"
        )
    return found


@dataclass(slots=True)
class _Place:
    """One number of the MJCF and its terms: the sum of offset + factor · value.

    Attributes:
        element: Element of the specification that has the number.
        setting: One of its terms, by which the number is named.
        terms: Terms by parameter.
        default: Sum of the terms with every parameter's default.
        was: Number of the file if another one was set; else None.
    """

    element: Any
    setting: Effect
    terms: dict[str, Effect] = field(default_factory=dict)
    default: float = 0.0
    was: float | None = None

    @property
    def number(self) -> float:
        """The number in the specification, in the unit of the MJCF."""
        values = np.array(getattr(self.element, self.setting.field), dtype=np.float64)
        return float(values[self._index])

    @number.setter
    def number(self, value: float) -> None:
        values = np.array(getattr(self.element, self.setting.field), dtype=np.float64)
        values[self._index] = value
        setattr(self.element, self.setting.field, values if values.ndim else value)

    @property
    def _index(self) -> tuple[()] | int:
        return () if self.setting.index is None else self.setting.index

    def add(self, parameter: Parameter, setting: Effect) -> None:
        """Adds the term of a parameter."""
        if parameter.name in self.terms:
            raise SceneError(f"parameter '{parameter.name}' sets {self._words} twice; set it once")
        self.terms[parameter.name] = setting
        self.default += setting.offset + setting.factor * parameter.default

    def set(self, effective: Mapping[str, float], requested: Mapping[str, float]) -> None:
        """Checks the default against the file, then sets the number if it was requested."""
        try:
            now = self.number
        except (AttributeError, TypeError, ValueError, IndexError):
            raise SceneError(f"{self.subject}, which is not a number of the scene") from None
        if not self._is(now, self.default):
            raise SceneError(
                f"{self.subject} to {self.default:g} by default, where the scene's file has "
                f"{now:g}; make them equal"
            )
        if not requested.keys() & self.terms.keys():
            return
        self.number = result = sum(
            term.offset + term.factor * effective[name] for name, term in self.terms.items()
        )
        self.was = None if self._is(now, result) else now

    @staticmethod
    def _is(number: float, other: float) -> bool:
        return math.isclose(number, other, rel_tol=_AGREEMENT, abs_tol=_ROUNDING)

    @property
    def subject(self) -> str:
        """Subject and verb of a sentence: which parameters set the number."""
        names = " and ".join(map(repr, self.terms))
        start = (
            f"parameter {names} sets"
            if len(self.terms) == 1
            else f"parameters {names} together set"
        )
        return f"{start} {self._words}"

    @property
    def _words(self) -> str:
        index = "" if self.setting.index is None else f"[{self.setting.index}]"
        return f"{self.setting.field}{index} of {self.setting.kind} '{self.element.name}'"
