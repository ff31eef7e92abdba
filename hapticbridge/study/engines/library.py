"""The engines by name; each is imported when it is asked for, and may be missing."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import NamedTuple

from hapticbridge.errors import StudyError, choices
from hapticbridge.study.engines.base import Engine

_PACKAGE = "hapticbridge.study.engines"

_MODULES = {
    "mujoco": "mujoco_engine",
    "ode": "ode_engine",
    "ode_spring": "ode_spring",
    "physx": "sapien_engine",
    "physx_spring": "sapien_engine",
    "pybullet": "pybullet_engine",
    "pybullet_dantzig": "pybullet_engine",
    "drake_point": "drake_engine",
    "drake_hydroelastic": "drake_engine",
}
"""In which module an engine is: each has ``engines()``, and cannot be imported, or raises
StudyError there, where its library is not installed."""


class Engines(NamedTuple):
    """The engines of this installation.

    Attributes:
        available: By name.
        missing: By name, a sentence that says what is not installed and how to get it.
    """

    available: Mapping[str, Engine]
    missing: Mapping[str, str]


def engine_names() -> tuple[str, ...]:
    """Returns the names of all engines, installed or not."""
    return tuple(_MODULES)


def available_engines() -> Engines:
    """Imports every engine and says which are there."""
    available: dict[str, Engine] = {}
    missing: dict[str, str] = {}
    for name in _MODULES:
        try:
            available[name] = open_engine(name)
        except StudyError as error:
            missing[name] = str(error)
    return Engines(available, missing)


def open_engine(name: str) -> Engine:
    """Imports one engine.

    Raises:
        StudyError: There is none of that name, or its library is not installed; says how to get it.
    """
    if name not in _MODULES:
        raise StudyError(f"no engine '{name}'; engines: {choices(_MODULES)}")
    try:
        module = import_module(f"{_PACKAGE}.{_MODULES[name]}")
    except ImportError as error:
        # what a library needs of the system (as libGL) may be missing where it is installed
        raise StudyError(
            f"engine '{name}' is not installed ({error}): pip install hapticbridge[peers]"
        ) from None
    found: tuple[Engine, ...] = module.engines()
    return next(engine for engine in found if engine.name == name)
