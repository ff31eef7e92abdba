"""Faults of a scene's options that the bridge overrides."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco

from hapticbridge.check.case import Case
from hapticbridge.check.faults import Fault
from hapticbridge.errors import choices
from hapticbridge.scene.checks import check_model
from hapticbridge.scene.start import START_KEYFRAME

_SAME_STEP = 1e-9  # relative: 0.001 as 1/1000


def option_faults(case: Case) -> Iterator[Fault]:
    """Yields options that the bridge replaces, and concerns from loading the scene.

    The scene runs, but not as it did in a viewer; the remedy writes down the options that it runs
    with.
    """
    option, places = case.source.spec.option, case.places
    if option.integrator != mujoco.mjtIntegrator.mjINT_DISCRETE:
        name = str(mujoco.mjtIntegrator(option.integrator).name).removeprefix("mjINT_")
        yield Fault(
            "integrator",
            places.option("integrator"),
            f"the scene has integrator {name}, under which a coupling is not passive; it runs "
            "under 'discrete'",
            places.option_change("integrator", "discrete"),
        )
    if option.solver != mujoco.mjtSolver.mjSOL_NEWTON:
        name = str(mujoco.mjtSolver(option.solver).name).removeprefix("mjSOL_")
        yield Fault(
            "solver",
            places.option("solver"),
            f"the scene has solver {name}; it runs with Newton's",
            places.option_change("solver", "Newton"),
        )
    if not option.enableflags & mujoco.mjtEnableBit.mjENBL_DIAGEXACT:
        yield Fault(
            "diagexact",
            places.flag(),
            "flag diagexact is not set; it runs with it, because contacts that share a body "
            "create energy without",
            'diagexact="enable"'
            if places.flag().element == "<flag>"
            else '<flag diagexact="enable"/> in <option>',
        )
    step = float(option.timestep)
    if not case.is_rate_given and abs(step - case.period) > _SAME_STEP * case.period:
        yield Fault(
            "time step",
            places.option("timestep"),
            f"the scene has a time step of {1e3 * step:g} ms; it runs at {1e3 * case.period:g} ms, "
            f"one step per tick at {1 / case.period:g} Hz, and its contacts change with it",
            f"{places.option_change('timestep', f'{case.period:g}')}, or check with --rate "
            f"{1 / step:g}",
        )
    concerns = [*case.source.concerns, *check_model(case.model, case.scene.grip)]
    for concern in concerns:
        if "integrator" not in concern:
            attribute = "wind" if concern.startswith("wind") else "surfacevel"
            place = places.with_attribute(attribute) or places.option(attribute)
            yield Fault("unmetered work", place, concern, f"remove {attribute}")


def keyframe_faults(case: Case) -> Iterator[Fault]:
    """Yields a fault if the scene has keyframes but no start among them."""
    names = [str(key.name) for key in case.source.spec.keys]
    if names and START_KEYFRAME not in names:
        listed = choices(name for name in names if name)
        yield Fault(
            "keyframe",
            case.places.named("key", names[0]),
            f"the scene has keyframes ({listed}), but none is called '{START_KEYFRAME}': it starts "
            "from the joints' zeros instead",
            f'name="{START_KEYFRAME}"',
        )
