"""Sets the parameters of a scene in its specification, before it is compiled.

What there is to set, and what follows from it, stands in the scene's file of parameters; see
``parameter_file``. What is not set stays as the MJCF says, to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
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
"""Relative and absolute difference allowed between the MJCF and the default: a file that gives ten
digits, and the rounding of a sum that should be 0."""


def apply_parameters(
    spec: mujoco.MjSpec, scene: Path, values: Mapping[str, float]
) -> dict[str, float]:
    """Sets parameters in a scene before it is compiled.

    Args:
        spec: The scene as its file says; changed in place.
        scene: The MJCF file.
        values: What to set, by name; what is not named keeps its default.

    Returns:
        Every parameter of the scene with the value that holds.

    Raises:
        SceneError: A name is unknown, a value is not finite or out of range, or the file of
            parameters does not fit the scene.
    """
    known = {parameter.name: parameter for parameter in scene_parameters(scene)}
    for name, value in values.items():
        _check_value(scene.stem, name, value, known)
    owners: dict[tuple[str, str, str, int | None], str] = {}
    for parameter in known.values():
        for setting in parameter.sets:
            for element in _elements(spec, setting, parameter.name):
                place = setting.kind, str(element.name), setting.field, setting.index
                if place in owners:
                    raise SceneError(
                        f"parameters '{owners[place]}' and '{parameter.name}' both set "
                        f"{_words(setting, element)}; one number follows from one parameter, once"
                    )
                owners[place] = parameter.name
                _set(element, setting, parameter, values.get(parameter.name))
    return {name: float(values.get(name, parameter.default)) for name, parameter in known.items()}


def settings_from(words: Iterable[str]) -> dict[str, float]:
    """Returns values by name from words such as ``clearance=0.1e-3``.

    Raises:
        SceneError: A word is not a name and a number, or a name comes twice.
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
        raise SceneError(f"scene '{scene}' has no parameters, so '{name}' cannot be set")
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


def _set(element: Any, setting: Setting, parameter: Parameter, value: float | None) -> None:
    """Checks that the default is what the file says, then sets the value if there is one."""
    where = f"parameter '{parameter.name}' sets {_words(setting, element)}"
    try:
        field = np.array(getattr(element, setting.field), dtype=np.float64)
        now = float(field[() if setting.index is None else setting.index])
    except (AttributeError, TypeError, ValueError, IndexError):
        raise SceneError(f"{where}, which is not a number of the scene") from None
    default = setting.offset + setting.factor * parameter.default
    if not math.isclose(now, default, rel_tol=_AGREEMENT, abs_tol=_ROUNDING):
        raise SceneError(
            f"{where} to {default:g} by default, where the scene's file has {now:g}; make them "
            "equal"
        )
    if value is None:
        return
    result = setting.offset + setting.factor * float(value)
    if setting.index is None:
        setattr(element, setting.field, result)
    else:
        field[setting.index] = result
        setattr(element, setting.field, field)


def _words(setting: Setting, element: Any) -> str:
    index = "" if setting.index is None else f"[{setting.index}]"
    return f"{setting.field}{index} of {setting.kind} '{element.name}'"
