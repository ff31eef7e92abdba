"""Parameter file of a scene."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from numbers import Real
from pathlib import Path

from hapticbridge.errors import SceneError, choices

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

TAKEN = ("path_or_name", "grip")
"""Arguments of ``load_scene`` that are not parameters."""


@dataclass(frozen=True, slots=True)
class Setting:
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
    sets: tuple[Setting, ...]

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
    except (OSError, ValueError) as error:
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


def _setting(entry: object, where: str) -> Setting:
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
    return Setting(entry["kind"], entry["name"], entry["field"], index, *map(float, numbers))
