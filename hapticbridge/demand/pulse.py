"""Pulse of a blow: its presets, and the largest one that a device can answer a tap with."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hapticbridge.arguments import shown
from hapticbridge.errors import HapticBridgeError, choices
from hapticbridge.kernel.impact_pulse import largest_pulse
from hapticbridge.kernel.jit import source_of
from hapticbridge.kernel.parameters import LONGEST_DECAY, SHORTEST_DECAY, RunParameters
from hapticbridge.units import format_energy, format_si

PULSES = {"steel": (300.0, 0.011), "wood": (100.0, 0.0125), "rubber": (30.0, 0.0167)}
"""Frequency in Hz and time constant in s of the pulse of a blow on a material. A tap on a real
material shakes a stylus in a decaying sinusoid, and users rated other numbers than the measured
ones as real (Okamura, Cutkosky & Dennerlein 2001). These are of the order that is known for
aluminium, wood and rubber; no table of theirs was at hand to check them. Others feel like another
material, and pulses of the same kind that were tuned by hand made taps on wood more real
(Kuchenbecker, Fiene & Niemeyer 2006)."""

USUAL_PULSE = "wood"
"""Pulse of a scene that names none."""


def pulse_of(text: str, subject: str = "pulse") -> tuple[float, float]:
    """Returns frequency in Hz and time constant in s of a name of ``PULSES`` or of ``HZ,MS``.

    ``subject`` is what has the text, for a refusal.

    Raises:
        HapticBridgeError: It is neither, or out of range.
    """
    if text in PULSES:
        return PULSES[text]
    try:
        frequency, decay = (float(part) for part in text.split(","))
    except ValueError:
        frequency = decay = math.nan
    if not (0.0 <= frequency < math.inf and SHORTEST_DECAY <= 1e-3 * decay <= LONGEST_DECAY):
        raise HapticBridgeError(
            f"{subject} is {shown(text)}; it must be one of {choices(PULSES)}, or HZ,MS such as "
            f"250,8 with {1e3 * SHORTEST_DECAY:g} to {1e3 * LONGEST_DECAY:g} ms"
        )
    return frequency, 1e-3 * decay


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
        return "none is given: no geom that collides is rigid with the grip"
    spare = f"{tap.spare:.2g} N s/m more damping than the coupling needs" if tap.spare else ""
    weak = "" if tap.pulse >= FORCE_FLOOR else ", too weak to be felt"
    return (
        f"a tap at {tap.speed:g} m/s burns up to {format_energy(tap.burned)}, for a pulse of up to "
        f"{format_si(tap.pulse, 'N')}{weak}; the device has {spare or 'no damping to spare'}"
    )
