"""Sentences on the effective coupling and its law."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.kernel.names import COUPLING_ACTUATORS
from hapticbridge.kernel.scheme import LOSSLESS
from hapticbridge.kernel.tree import tree_of_tool
from hapticbridge.passivity.compensation import IMPLICIT_LAG, felt_damping
from hapticbridge.rendering import Method
from hapticbridge.tick import TickFlag


def is_always_held(model: mujoco.MjModel, grip: str) -> bool:
    """Returns True if a lossless coupling stays implicit because the tool is never free.

    References:
        ``kernel.tree.ToolTree.is_never_free`` lists the causes.
    """
    own = [model.actuator(name).id for name in COUPLING_ACTUATORS]
    return tree_of_tool(model, int(model.site(grip).bodyid[0]), own).is_never_free


def was_always_held(ticks: NDArray[np.void]) -> bool:
    """Returns True if no record of a run was lossless; False without records."""
    return was_never_lossless(len(ticks), int(np.bitwise_or.reduce(ticks["flags"])))


def was_never_lossless(count: int, flags: int) -> bool:
    """Returns True if no record was lossless, by the number of records and their combined flags."""
    return count > 0 and not flags & int(TickFlag.MIDPOINT)


def coupling_sentences(
    used: Coupling, method: Method, period: float, substeps: int, *, is_always_held: bool = False
) -> tuple[str, ...]:
    """Describes effective and law coupling: translation, then rotation if it has a spring.

        B = B' + adds K h,    h = T / substeps        (away from contact, to first order in h)

    A hand feels K and B. The law uses a smaller B' if the integration adds damping by itself, and
    the device condition b >= K T/2 + B' counts B'.

    Args:
        used: K and B' of the law.
        method: The rendering method; without a coupling law there are no sentences.
        period: T in s.
        substeps: MuJoCo steps per tick.
        is_always_held: True if the tool of a lossless coupling is never free. The coupling is then
            always implicit and adds the implicit form's damping. No effect on other methods.
    """
    if not method.has_law:
        return ()
    kinds = [("K", "B", used.stiffness, used.damping, "N/m", "N s/m")]
    if used.rotational_stiffness > 0:
        rotation = used.rotational_stiffness, used.rotational_damping
        kinds.append(("K_r", "B_r", *rotation, "N m/rad", "N m s/rad"))
    name, adds = method.name, method.adds
    if is_always_held and method.scheme == LOSSLESS:
        name, adds = f"{name}, here always implicit,", IMPLICIT_LAG
    return tuple(_sentence(name, adds, period / substeps, substeps, *kind) for kind in kinds)


def _sentence(
    name: str,
    adds: float | None,
    step: float,
    substeps: int,
    spring: str,
    damper: str,
    stiffness: float,
    damping: float,
    spring_unit: str,
    damper_unit: str,
) -> str:
    start = f"{spring} = {stiffness:.4g} {spring_unit}, {damper} ="
    if adds is None:
        return f"{start} {damper}' = {damping:.4g} {damper_unit} ({name} uses it as asked)"
    felt = felt_damping(stiffness, damping, step, adds)
    parts = substeps / adds
    added = ("KT" if spring == "K" else f"{spring} T") + (f"/{parts:g}" if parts != 1 else "")
    return (
        f"{start} {felt:.4g} {damper_unit} felt ({name} adds {added} to its {damper}' = "
        f"{damping:.4g})"
    )
