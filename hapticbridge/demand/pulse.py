"""Pulse of a blow: its presets, and the largest one that a device can answer a tap with."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hapticbridge.arguments import number_from, shown
from hapticbridge.errors import HapticBridgeError, choices
from hapticbridge.kernel.impact_pulse import largest_pulse
from hapticbridge.kernel.jit import source_of
from hapticbridge.kernel.parameters import LONGEST_DECAY, SHORTEST_DECAY, RunParameters
from hapticbridge.kernel.record import TickFlag
from hapticbridge.units import format_energy, format_si

PULSES = {"steel": (300.0, 0.011), "wood": (100.0, 0.0125), "rubber": (30.0, 0.0167)}
"""Frequency in Hz and time constant in s of the pulse of a blow on a material. A tap on a real
material shakes a stylus in a decaying sinusoid, and users rated other numbers than the measured
ones as real (Okamura, Cutkosky & Dennerlein 2001). These are our choice, of the order that is known
for aluminium, wood and rubber; no table of theirs was at hand to check them. Other numbers feel
like another material."""

USUAL_PULSE = "wood"
"""Pulse of a scene that names none."""


def pulse_of(text: str, rate: float, source: str = "") -> tuple[float, float]:
    """Returns frequency in Hz and time constant in s of a name of ``PULSES`` or of ``HZ,MS``.

    Args:
        text: The name or the two numbers.
        rate: Ticks per second.
        source: What has the text if no option does, for a refusal.

    Raises:
        HapticBridgeError: It is neither, out of range, or too fast for the rate.
    """
    most = 0.5 * rate
    try:
        frequency, decay = (number_from(part) for part in text.split(","))
    except ValueError:
        frequency = decay = math.nan
    frequency, decay = PULSES.get(text, (frequency, 1e-3 * decay))
    if not (0.0 <= frequency <= most and SHORTEST_DECAY <= decay <= LONGEST_DECAY):
        of = f" of {frequency:g} Hz" if text in PULSES else ""
        slow = [name for name, (own, _) in PULSES.items() if own <= most]
        named = f"one of {choices(slow)}, or " if slow else ""
        raise HapticBridgeError(
            f"{source or 'pulse'} is {shown(text)}{of}; it must be {named}HZ,MS with at most "
            f"{most:g} Hz, half the rate, and {1e3 * SHORTEST_DECAY:g} to "
            f"{1e3 * LONGEST_DECAY:g} ms{source and '; --pulse replaces it'}"
        )
    return frequency, decay


FORCE_FLOOR = 0.03
"""Smallest noticeable force in N: 29 to 44 mN at the fingers (King, Donlin & Hannaford 2010), 21 mN
with a pen (Lee & Hannaford 2003). It keeps a share of a very small force from counting."""

TAP_SPEED = 0.2
"""Speed in m/s of a tap, as a hand taps on a table. Its pulse grows in proportion to it."""


@dataclass(frozen=True, slots=True)
class Tap:
    """Tap of the tool on what does not give, and the largest pulse that may answer it.

    The blow burns at most W = ½ m v², less where it bounces, and its pulse p is at most the force
    limit, and

        (d + 1) T max_u (p − b_s u) u <= q σ W exp(−T/τ),    0 <= u <= v_max

    with the symbols of ``kernel.impact_pulse``: its account forgets for a tick before the pulse.

    Attributes:
        speed: v in m/s.
        burned: W in J.
        spare: b_s in N s/m, the device's damping beyond what the coupling needs.
        pulse: p in N.
    """

    speed: float
    burned: float
    spare: float
    pulse: float

    @classmethod
    def of(cls, run: RunParameters, mass: float) -> Tap:
        """Returns the tap in a run with pulses; ``mass`` m in kg is what the contact meets."""
        burned = 0.5 * mass * TAP_SPEED**2
        kept = run.impact_pulses * math.exp(-run.period / run.pulse_decay)
        energy = run.force_scale / run.scale * kept * burned
        power = energy / ((run.pulse_ticks + 1) * run.period)
        pulse = source_of(largest_pulse)(power, run.pulse_damping, run.pulse_speed)
        return cls(TAP_SPEED, burned, run.pulse_damping, min(pulse, run.force_limit))


def tap_words(tap: Tap | None) -> str:
    """Returns what a device can answer a tap with, as a clause; None strikes nothing."""
    if tap is None:
        return "no blow pays for a pulse: no geom that moves with the grip collides"
    spare = f"{tap.spare:.2g} N s/m more damping than the coupling needs" if tap.spare else ""
    weak = "" if tap.pulse >= FORCE_FLOOR else ", too weak to be felt"
    return (
        f"a tap at {tap.speed:g} m/s takes up to {format_energy(tap.burned)} from the tool, which "
        f"pays for a pulse of up to {format_si(tap.pulse, 'N')} on the hand{weak}; the device has "
        f"{spare or 'no damping to spare'}"
    )


_ENDS = {
    TickFlag.STALE_SAMPLE: "a missing sample",
    TickFlag.CONTROLLER_ACTIVE: "the passivity controller",
    TickFlag.SWINGING: "the watch, because the device swung",
    TickFlag.RUNS_AWAY: "the watch, because the device went the wrong way",
    TickFlag.PROBED: "the watch, which tried the device",
    TickFlag.RAMPING: "the guard, which held the force back",
}
"""Causes that end a pulse early, by the flag of ``ENDS``."""


def end_words(ended_by: int) -> str:
    """Returns the causes that ended pulses early, of their flags; empty without one."""
    return ", ".join(words for flag, words in _ENDS.items() if ended_by & flag)


def balance_words(paid: float, work: float, ended_by: int) -> str:
    """Returns the energy in J at the hand of blows and pulses, and what ended pulses early."""
    hand = f"the hand gave them {format_energy(-work)}"
    if work >= 0.0:
        hand = f"they gave the hand {format_energy(work)}"
    ended = f"; cut short by {end_words(ended_by)}" if ended_by else ""
    return f"the tool's blows gave them {format_energy(paid)}, {hand}{ended}"
