"""What a run's coupling feels like, and which damper that takes, in words.

A hand feels K and B. The damper of the coupling's law has B' less than that where the integration
adds damping by itself, and it is B' that the device's condition b >= K T/2 + B' counts.
"""

from __future__ import annotations

from hapticbridge.coupling import Coupling
from hapticbridge.passivity.compensation import felt_damping
from hapticbridge.rendering import Method


def coupling_sentences(
    used: Coupling, method: Method, period: float, substeps: int
) -> tuple[str, ...]:
    """Returns what is felt and what is used, translation first, then rotation if it has a spring.

        B = B' + adds K h,    h = T / substeps        (away from contact, to first order in h)

    Args:
        used: K and B' of the law.
        method: How the tool is rendered; behind no coupling law there is nothing to say.
        period: T in s.
        substeps: MuJoCo steps per tick.
    """
    if not method.has_law:
        return ()
    kinds = [("K", "B", used.stiffness, used.damping, "N/m", "N s/m")]
    if used.rotational_stiffness > 0:
        rotation = used.rotational_stiffness, used.rotational_damping
        kinds.append(("K_r", "B_r", *rotation, "N m/rad", "N m s/rad"))
    return tuple(_sentence(method, period / substeps, substeps, *kind) for kind in kinds)


def _sentence(
    method: Method,
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
    if method.adds is None:
        return f"{start} {damper}' = {damping:.4g} {damper_unit} ({method.name} uses it as asked)"
    felt = felt_damping(stiffness, damping, step, method.adds)
    parts = substeps / method.adds
    added = ("KT" if spring == "K" else f"{spring} T") + (f"/{parts:g}" if parts != 1 else "")
    return (
        f"{start} {felt:.4g} {damper_unit} felt ({method.name} adds {added} to its {damper}' = "
        f"{damping:.4g})"
    )
