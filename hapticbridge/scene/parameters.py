"""Parameters of a scene, set in its specification."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hapticbridge.errors import SceneError, choices
from hapticbridge.scene.parameter_file import (
    KINDS,
    TAKEN,
    Parameter,
    Setting,
    is_finite_number,
    scene_parameters,
)

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
    return effective


def settings_from(words: Iterable[str]) -> dict[str, float]:
    """Returns values by name from words such as ``clearance=0.1e-3``.

    Raises:
        SceneError: A word is not a name and a number, or a name occurs twice.
    """
    values: dict[str, float] = {}
    for word in words:
        name, sign, number = word.partition("=")
        try:
            value = float(number)
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


def _elements(spec: mujoco.MjSpec, setting: Setting, parameter: str) -> list[Any]:
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
    """One number of the MJCF and its terms: the sum of offset + factor · value."""

    element: Any
    setting: Setting
    terms: dict[str, Setting] = field(default_factory=dict)
    default: float = 0.0

    def add(self, parameter: Parameter, setting: Setting) -> None:
        """Adds the term of a parameter."""
        if parameter.name in self.terms:
            raise SceneError(f"parameter '{parameter.name}' sets {self._words} twice; set it once")
        self.terms[parameter.name] = setting
        self.default += setting.offset + setting.factor * parameter.default

    def set(self, effective: Mapping[str, float], requested: Mapping[str, float]) -> None:
        """Checks the default against the file, then sets the number if it was requested."""
        names, index = " and ".join(map(repr, self.terms)), self.setting.index
        is_one = len(self.terms) == 1
        subject = f"parameter {names} sets" if is_one else f"parameters {names} together set"
        where = f"{subject} {self._words}"
        try:
            values = np.array(getattr(self.element, self.setting.field), dtype=np.float64)
            now = float(values[() if index is None else index])
        except (AttributeError, TypeError, ValueError, IndexError):
            raise SceneError(f"{where}, which is not a number of the scene") from None
        if not math.isclose(now, self.default, rel_tol=_AGREEMENT, abs_tol=_ROUNDING):
            raise SceneError(
                f"{where} to {self.default:g} by default, where the scene's file has {now:g}; make "
                "them equal"
            )
        if not requested.keys() & self.terms.keys():
            return
        result = sum(
            term.offset + term.factor * effective[name] for name, term in self.terms.items()
        )
        values[() if index is None else index] = result
        setattr(self.element, self.setting.field, result if index is None else values)

    @property
    def _words(self) -> str:
        index = "" if self.setting.index is None else f"[{self.setting.index}]"
        return f"{self.setting.field}{index} of {self.setting.kind} '{self.element.name}'"
