"""What a run's coupling feels like, and which damper that takes, in words.

A hand feels K and B. The damper of the coupling's law has B' less than that where the integration
adds damping by itself, and it is B' that the device's condition b >= K T/2 + B' counts.
"""

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
    """Tells whether a lossless coupling will stay implicit, because something never lets go.

    Args:
        model: The compiled scene, with its handle.
        grip: Name of the site on the tool.

    References:
        ``kernel.tree.ToolTree.is_never_free`` says what that may be.
    """
    own = [model.actuator(name).id for name in COUPLING_ACTUATORS]
    return tree_of_tool(model, int(model.site(grip).bodyid[0]), own).is_never_free


def was_always_held(ticks: NDArray[np.void]) -> bool:
    """Tells the same of a run, from its records: no tick was lossless. False without a record."""
    return was_never_lossless(len(ticks), int(np.bitwise_or.reduce(ticks["flags"])))


def was_never_lossless(count: int, flags: int) -> bool:
    """Tells it from how many records there are, and all flags that any of them has."""
    return count > 0 and not flags & int(TickFlag.MIDPOINT)


def coupling_sentences(
    used: Coupling, method: Method, period: float, substeps: int, *, is_always_held: bool = False
) -> tuple[str, ...]:
    """Returns what is felt and what is used, translation first, then rotation if it has a spring.

        B = B' + adds K h,    h = T / substeps        (away from contact, to first order in h)

    Args:
        used: K and B' of the law.
        method: How the tool is rendered; behind no coupling law there is nothing to say.
        period: T in s.
        substeps: MuJoCo steps per tick.
        is_always_held: Whether a tool behind a lossless coupling is never let go: then that is
            implicit all the time, and adds what the implicit form adds. Says nothing of others.
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
