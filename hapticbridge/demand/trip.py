"""Guard's stop of a run: its facts, and the sentences made of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from hapticbridge.demand.guard import USUAL_ENERGY
from hapticbridge.errors import RecordingError
from hapticbridge.kernel import codes
from hapticbridge.kernel.hand_energy import INSTANT, HandEnergy, work_words
from hapticbridge.units import format_energy

BY_TRIP = "trip"
"""Origin of a run's end, in its summary and its event ``stop``, where it was a trip."""


class TripCode(StrEnum):
    """Reason for which a run was stopped."""

    BAD_SAMPLE = "bad sample"
    JUMPED = "jumped"
    BACKWARDS = "backwards"
    STRETCHED = "stretched"
    TWISTED = "twisted"
    GAVE_ENERGY = "gave energy"
    CONTACTS_FULL = "contacts full"
    CONSTRAINTS_FULL = "constraints full"
    DIVERGED = "diverged"
    SIMULATION = "simulation"
    DEVICE = "device"
    ZERO_FORCE = "zero force"


_OF_RESULT = {
    getattr(codes, name): TripCode[name]
    for name in (
        *("BAD_SAMPLE", "JUMPED", "BACKWARDS", "STRETCHED", "TWISTED", "GAVE_ENERGY"),
        *("CONTACTS_FULL", "CONSTRAINTS_FULL"),
    )
}

_WORDS = {
    TripCode.BAD_SAMPLE: "the device's pose is not finite or not a rotation",
    TripCode.JUMPED: "the device's pose jumped farther than the device can move",
    TripCode.BACKWARDS: "time ran backwards",
    TripCode.STRETCHED: "the tool is farther from the handle than the stretch limit",
    TripCode.TWISTED: "the tool is turned from the handle by more than the angle limit",
    TripCode.GAVE_ENERGY: (
        "the hand would get more than it put in and the scene released, by more than the energy "
        "limit"
    ),
    TripCode.CONTACTS_FULL: codes.WARNINGS[codes.CONTACTS_FULL],
    TripCode.CONSTRAINTS_FULL: codes.WARNINGS[codes.CONSTRAINTS_FULL],
    TripCode.DIVERGED: (
        "the scene diverged: the simulation is no longer finite (force, pose or energy)"
    ),
    TripCode.SIMULATION: "MuJoCo stopped: {}",
    TripCode.DEVICE: "{}",
    TripCode.ZERO_FORCE: "zero force could not be sent: {}",
}

_REMEDIES = {
    TripCode.BAD_SAMPLE: (
        "its last sample holds NaN or infinity, or a quaternion (w, x, y, z) whose length is not "
        "1; check the driver's read()"
    ),
    TripCode.JUMPED: (
        "check the unit (m) and the times (s) of what it reports, and that no sample is late"
    ),
    TripCode.STRETCHED: (
        "check the motion's unit (m) and speed, the weight of the tool (--no-tool-weight carries a "
        "tool that falls or tips over) and of what hangs or lies on it, and springs, motors or "
        "inputs of the scene that push it beyond the force limit; with another reach in mind raise "
        "--stretch-limit"
    ),
    TripCode.TWISTED: (
        "check how fast the hand turns, and springs, motors or inputs of the scene that turn the "
        "tool beyond the torque limit; raise --rotational-stiffness if the device bears it, or let "
        "the handle slip on instead: --angle-limit inf"
    ),
    TripCode.GAVE_ENERGY: "lower --stiffness",
    TripCode.DIVERGED: (
        "'hapticbridge check SCENE' looks for what makes it diverge; if it finds nothing, lower "
        "the stiffness or the period"
    ),
    TripCode.CONTACTS_FULL: codes.WARNING_REMEDIES[codes.CONTACTS_FULL],
    TripCode.CONSTRAINTS_FULL: codes.WARNING_REMEDIES[codes.CONSTRAINTS_FULL],
}

_LIMIT_MOTORS = (
    "the scene's motors {} until then{}: limit their force (a smaller forcerange), or start a "
    "motor at ctrl 0 and a servo at its target (keyframe 'home'); 'hapticbridge check SCENE' names "
    "those that push at the start; if they are meant to push the hand, --energy-limit is what it "
    "may get"
)
_INPUTS = "inputs (applied forces, moved mocap bodies, belts)"
_LIMIT_INPUTS = (
    f"the scene's {_INPUTS} {{}} until then: make them smaller or slower; if they are meant to "
    "push the hand, --energy-limit is what it may get"
)
_EASE_SPRINGS = (
    "the coupling's springs held {} at the start or after resets, by what the tool bears: "
    '--no-tool-weight carries its own weight, gravcomp="1" that of bodies on it, a start without '
    "other loads leaves them slack, and --energy-limit is what the hand may get"
)
_FIND_PUMP = (
    "the scene itself created {} until then: 'hapticbridge check SCENE' looks for what pumps, and "
    "'hapticbridge audit RECORDING' names the likely cause"
)


@dataclass(frozen=True, slots=True)
class Trip:
    """Stop of a run by the guard, or by a device or simulation that failed.

    Attributes:
        code: Reason.
        tick: Tick that was refused.
        hand: Grip of the hand that it is about, if several hold the scene; else empty.
        detail: Message of the device or of MuJoCo, where one failed; else empty.
    """

    code: TripCode
    tick: int
    hand: str = ""
    detail: str = ""

    @classmethod
    def of_result(cls, result: int, tick: int, hand: str = "") -> Trip:
        """Returns the trip for a result of a function of ``kernel.tick`` that is not ``OK``."""
        is_warning = result in codes.WARNINGS  # of the scene, which all hands share
        code = _OF_RESULT.get(result, TripCode.DIVERGED)
        return cls(code, tick, "" if is_warning else hand)

    @classmethod
    def among(cls, events: Iterable[Mapping[str, Any]]) -> Trip | None:
        """Returns the first trip of a recording's events; None without one.

        Raises:
            RecordingError: Its event is damaged.
        """
        event = next((each for each in events if each.get("event") == "trip"), None)
        if event is None:
            return None
        tick, texts = event.get("tick"), [event.get(name) for name in ("hand", "detail")]
        code = {each.value: each for each in TripCode}.get(str(event.get("code")))
        if code is None or type(tick) is not int or not all(isinstance(e, str) for e in texts):
            raise RecordingError("the event 'trip' is damaged: it has no valid code, tick and hand")
        trip = cls(code, tick, *map(str, texts))
        if event.get("reason") != trip.sentence:
            raise RecordingError("the reason of the event 'trip' differs from its code")
        return trip

    def details(self) -> dict[str, str]:
        """Returns the details of the event ``trip``: the facts, and the sentence for readers."""
        own = {"code": self.code.value, "hand": self.hand, "detail": self.detail}
        return own | {"reason": self.sentence}

    @property
    def words(self) -> str:
        """Reason in a clause, without the tick."""
        hand = f"hand at '{self.hand}': " if self.hand else ""
        return f"{hand}{_WORDS[self.code].format(self.detail)}"

    @property
    def sentence(self) -> str:
        """Tick and reason."""
        return f"tick {self.tick}: {self.words}"

    def __str__(self) -> str:
        return self.sentence

    @property
    def is_unsound(self) -> bool:
        """True if the simulation itself is in doubt; such a run is never passive.

        MuJoCo dropped contacts or constraints, stopped, or its numbers were bad.
        """
        return self.code in (
            *(TripCode.CONTACTS_FULL, TripCode.CONSTRAINTS_FULL),
            *(TripCode.DIVERGED, TripCode.SIMULATION),
        )

    @property
    def may_be_pumped(self) -> bool:
        """True if a part of the scene can cause it by pushing what moves."""
        return self.code in (
            *(TripCode.DIVERGED, TripCode.STRETCHED, TripCode.TWISTED, TripCode.GAVE_ENERGY),
        )

    def remedy(self, energy: HandEnergy, created: float = 0.0, strongest: str = "") -> str:
        """Returns the remedy for the message to the user; empty if none is known.

        Args:
            energy: Energy of the hand until then, with the works of the scene's motors and inputs.
            created: Energy in J that the scene had created until then, which may be the cause.
            strongest: Name of the actuator that pushes most, or empty.
        """
        least = max(0.5 * energy.net, INSTANT)
        has_motors = energy.ratio * abs(energy.motors) > least
        has_inputs = energy.ratio * abs(energy.inputs) > least
        most = f" ('{strongest}' pushes most)" if strongest else ""
        if self.code in (TripCode.STRETCHED, TripCode.TWISTED):
            remedy = _REMEDIES[self.code]
            if has_motors:
                remedy += f"; the scene's motors {work_words(energy.motors)} until then{most}"
            if has_inputs:
                remedy += f"; the scene's {_INPUTS} {work_words(energy.inputs)} until then"
            return remedy
        if self.code == TripCode.GAVE_ENERGY:
            if created > USUAL_ENERGY:
                return _FIND_PUMP.format(format_energy(created))
            if has_motors:
                return _LIMIT_MOTORS.format(work_words(energy.motors), most)
            if has_inputs:
                return _LIMIT_INPUTS.format(work_words(energy.inputs))
            if (
                energy.ratio * energy.springs > least
            ):  # a softer spring under the same load holds more
                return _EASE_SPRINGS.format(format_energy(energy.springs))
        return _REMEDIES.get(self.code, "")
