"""Reasons of a guard's stop, in words."""

from __future__ import annotations

from hapticbridge.kernel.codes import BACKWARDS, BAD_SAMPLE, GAVE_ENERGY, JUMPED, STRETCHED, TWISTED

_REASONS = {
    BAD_SAMPLE: "the device's pose is not finite or not a rotation",
    JUMPED: "the device's pose jumped farther than the device can move",
    BACKWARDS: "time ran backwards",
    STRETCHED: "the tool is farther from the handle than the stretch limit",
    TWISTED: "the tool is turned from the handle by more than the angle limit",
    GAVE_ENERGY: "the device was given more energy beyond what the hand put in than the limit",
}
_REMEDIES = {
    JUMPED: "check the motion's unit (m) and its times (s)",
    STRETCHED: "check the motion's unit (m) and speed, and the tool's mass; with another reach in "
    "mind raise --stretch-limit",
    TWISTED: "turn more slowly, or raise --rotational-stiffness if the device bears it",
    GAVE_ENERGY: "lower --stiffness; if the scene's motors are meant to push the hand, raise "
    "--energy-limit",
}
_DIVERGED = (
    "the simulation is no longer finite (force, pose or energy); the scene diverged, so lower the "
    "stiffness or the period"
)


def trip_reason(code: int, tick: int) -> str:
    """Describes why the kernel refused a tick.

    ``code`` is a result of ``before_step`` or ``after_step``, not ``OK``.
    """
    return f"tick {tick}: {_REASONS.get(code, _DIVERGED)}"


def with_remedy(reason: str) -> str:
    """Appends the remedy to a reason, for the message to the user.

    Exception and recording keep the bare reason, because it is compared when the run is repeated. A
    reason that is not from ``trip_reason`` is returned unchanged.
    """
    for code, remedy in _REMEDIES.items():
        if reason.endswith(_REASONS[code]):
            return f"{reason}; {remedy}"
    return reason
