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
    """Returns the default method: ``lossless`` with one MuJoCo step per tick, else ``implicit``.

    ``lossless`` takes no substeps. It is strict on every shipped scene, in 20 hands each. Away from
    contact it is at least ten times as accurate as ``implicit``; in contact it equals ``implicit``
    with the same B', and so suits the same device.

    ``implicit`` dissipates some energy on the way to a contact and ``lossless`` does not, so energy
    created by contacts uses more slack: at most 7.2 % instead of 7.0 % when tapping on a wall, and
    equal shares with jamming pegs (``scripts/bench_methods --same device``). Near contact
    ``lossless`` adds K T to B', but reports K T/2. When tapping at 6 Hz it is 54 µm RMS off its
    reported effective coupling. ``implicit`` is 26 µm off its own report, B + K T/2, and 116 µm off
    B (``scripts/bench_front``).
    """
    return LOSSLESS_COUPLING if substeps == 1 else IMPLICIT


def method_names() -> tuple[str, ...]:
    """Returns the names of all methods, those of ``COMPARISONS`` included."""
    import_module(COMPARISONS)
    return tuple(METHODS)


def method_named(name: str) -> Method:
    """Returns a method by its name.

    Raises:
        SceneError: The name is unknown; the message lists the methods.
    """
    if name not in METHODS and name not in method_names():
        raise SceneError(f"no method is called '{name}'; methods: {choices(METHODS)}")
    return METHODS[name]
