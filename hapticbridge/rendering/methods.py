"""Rendering methods of the product, and the registry of all methods."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module

from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.scheme import COUPLED, LOSSLESS
from hapticbridge.passivity.compensation import IMPLICIT_LAG, MIDPOINT_LAG
from hapticbridge.rendering.method import Method

IMPLICIT = Method(
    name="implicit",
    about="the coupling as actuators under MuJoCo's discrete integrator: implicit in position and "
    "velocity, solved together with the contacts, passive behind the coupling",
    hazard="",
    scheme=COUPLED,
    integrator="discrete",
    adds=IMPLICIT_LAG,
)

COMPENSATED = replace(
    IMPLICIT,
    name="compensated",
    about="implicit, with the damping K T that its integration adds taken off the coupling's",
    lag=IMPLICIT_LAG,
)

LOSSLESS_COUPLING = Method(
    name="lossless",
    about="half of the coupling inside MuJoCo's implicit step, half carried over from the last: a "
    "free tool keeps its energy and is followed to second order; near contacts it is 'implicit'",
    hazard="",
    scheme=LOSSLESS,
    integrator="discrete",
    lag=MIDPOINT_LAG,
    adds=MIDPOINT_LAG,
)

METHODS = {method.name: method for method in (IMPLICIT, COMPENSATED, LOSSLESS_COUPLING)}
"""Registered methods by name. ``COMPARISONS`` adds its own when it is imported."""

COMPARISONS = "hapticbridge.lab.methods"
"""Module of the methods that exist only to be compared; it registers them in ``METHODS``."""


def default_method(substeps: int = 1) -> Method:
    """Returns the method that is taken where none is asked for.

    ``lossless`` where a tick is one MuJoCo step: on every shipped scene, in 20 hands each, it is
    strict; away from contact it is ten times and more as accurate as ``implicit``, and in contact
    it is that, with the same B' and so for the same device. It takes no substeps; with them,
    ``implicit``.

    Where a contact creates energy, ``implicit`` with the same B' has burned some on the way there,
    and ``lossless`` has not: tapping on a wall it uses 7.2 % of the slack instead of 7.0 % at most,
    on jamming pegs the same (``scripts/bench_methods --same device``). Near contact it adds K T to
    B', and says K T/2: tapping at 6 Hz it is 54 µm RMS away from what it says is felt, ``implicit``
    26 µm from what that says, B + K T/2, and 116 µm from B (``scripts/bench_front``).
    """
    return LOSSLESS_COUPLING if substeps == 1 else IMPLICIT


def method_names() -> tuple[str, ...]:
    """Returns the names of all methods, those of ``COMPARISONS`` included."""
    import_module(COMPARISONS)
    return tuple(METHODS)


def method_named(name: str) -> Method:
    """Returns a method by its name.

    Raises:
        SceneError: There is no such method; lists those that exist.
    """
    if name not in METHODS and name not in method_names():
        raise SceneError(f"no method is called '{name}'; methods: {choices(METHODS)}")
    return METHODS[name]
