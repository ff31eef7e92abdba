"""Energy that a run gave to a hand, and what paid for it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hapticbridge.units import format_energy

INSTANT = 1e-3
"""Energy in J that delays may give to the hand: 1 N over 1 mm, less than a key of a keyboard takes,
and a fortieth of the guard's usual energy limit. A smaller value fails runs for one late force; a
larger one can be felt."""

RELEASE = 0.04
"""Energy in J from the scene's storage that a summary names: the guard's usual energy limit, which
leaves this energy out. A tool of 1 kg that sinks by 4 mm gives as much."""

_BOUND = (
    "only --energy-limit bounds what they give the hand, and what bodies lose beside the tool "
    "comes on top"
)


def work_words(work: float) -> str:
    """Returns a work in J of a scene's port as a verb with its object."""
    return f"took {format_energy(-work)}" if work < 0 else f"did {format_energy(work)} of work"


@dataclass(frozen=True, slots=True)
class HandEnergy:
    """Energy to a hand beyond what it put in, and the stores and ports that may have paid for it.

    With E the work of the wrench on the device less what the device's damping burned, every hand
    behind a coupling law and a device that bears it gets

        E <= q (V_0 − W_c) + W_u

    W_c is the coupling's work on the scene, V_0 the energy of the coupling's springs at the start
    and after each reset, W_u the work of axes without a motor; q = force_scale / scale: energy in
    the scene counts q times at the hand, whether the hand puts it in or gets it. What the scene
    gave through the coupling, −W_c, came from its storage, its motors, its inputs (other
    hands included), or from nowhere: Σ E_k. What E exceeds the right-hand side by without the
    latter is unpaid, but no more than E.

    Up to ``INSTANT`` may be unpaid in a certified run, because late samples may give that much.
    Nothing else needs an allowance. The inequality holds for the positions that were read, of which
    the law made the forces: encoder steps and delays within the device cannot exceed it.

    The storage in R is that of all bodies together. What bodies lose beside the tool, as a load
    that is let down, may therefore pass from motors to the hand on top of the energy limit. So a
    port counts as pushing by its own work and by ``gross``, which does not depend on R.

    Attributes:
        net: Largest E − H − q R in J with R of ``passivity_controller.observe_release``; the
            guard's energy limit bounds it. E counts here with the least dissipation that the
            positions show.
        hidden: H in J, to which E is known behind steps of an encoder; 0 for exact positions and
            for an unknown resolution (``passivity_controller.observe_energy``). ``net`` leaves H
            out, so that the hand may have got 2 H more.
        unpaid: Largest unpaid energy in J.
        springs: V_0 in J.
        scene: R, energy in J that the scene's storage has given through the coupling.
        motors: Work in J that the scene's motors had done when it was largest in size; negative if
            they had taken energy then.
        inputs: Work in J of the scene's inputs, taken in the same way: applied forces and moved
            mocap bodies. Gravity compensation and resets are not counted.
        gross: Largest E − W_u in J.
        ratio: q. ``springs``, ``scene``, ``motors`` and ``inputs`` are energies in the scene, the
            others at the hand.

    References:
        Brown & Colgate 1997, eq. (6), as an identity over time.
    """

    net: float = 0.0
    hidden: float = 0.0
    unpaid: float = 0.0
    springs: float = 0.0
    scene: float = 0.0
    motors: float = 0.0
    inputs: float = 0.0
    gross: float = 0.0
    ratio: float = 1.0

    @property
    def times(self) -> str:
        """The ratio q in words, as ``5 times`` before an energy; empty if it is 1."""
        return "" if math.isclose(self.ratio, 1.0) else f"{self.ratio:.4g} times"

    @property
    def scales(self) -> str:
        """Clause on a hand at which energy counts otherwise than in the scene; else empty."""
        if not self.times:
            return ""
        return f"energy of the scene counts {self.times} at the hand: force_scale / scale"

    @property
    def _pushing(self) -> tuple[str, ...]:
        """Names of the scene's ports that did work, if they may have paid for over ``INSTANT``."""
        ports = {"motors": self.ratio * abs(self.motors), "inputs": self.ratio * abs(self.inputs)}
        paid = self.ratio * self.springs + max(self.unpaid, 0.0)
        if max(self.gross, self.net) - paid <= INSTANT:
            return ()
        least = INSTANT
        if self.net - paid > INSTANT:  # no storage explains it
            least = min(INSTANT, 0.5 * max(ports.values()))
        return tuple(name for name, work in ports.items() if work > least)

    @property
    def limit(self) -> str:
        """Limit of a certificate, which covers no energy from motors and inputs; or empty."""
        if not self._pushing:
            return ""
        return f"{' and '.join(self._pushing)} of the scene pushed: {_BOUND}"

    @property
    def fault(self) -> str:
        """Clause on unpaid energy, for which no device is certified; or empty."""
        if self.unpaid <= INSTANT:
            return ""
        return (
            f"the hand got {format_energy(self.unpaid)} beyond what it put in, what the device's "
            f"damping burned, and what was released: by the scene {format_energy(self.scene)}, by "
            f"the coupling's springs {format_energy(self.springs)}, by motors "
            f"{format_energy(self.motors)}, by inputs {format_energy(self.inputs)}{self._counted}"
        )

    @property
    def _counted(self) -> str:
        return f", which count {self.times}" if self.times else ""

    @property
    def blur(self) -> str:
        """Energy that no meter of stepped positions sees, as a clause; empty without steps."""
        return (
            f"may hide {format_energy(2.0 * self.hidden)} that the hand got" if self.hidden else ""
        )

    @property
    def release(self) -> str:
        """Clause on the energy from the scene's storage; empty below ``RELEASE``."""
        if self.ratio * self.scene <= RELEASE:
            return ""
        given = format_energy(self.ratio * self.scene)
        if self.times:
            released = format_energy(self.scene)
            given = f"up to {given}, {self.times} the {released} that it released"
        return (
            f"gave the hand {given}, as weights that sink, springs and bodies that slow down do; "
            "the energy limit leaves it out"
        )

    @property
    def sentence(self) -> str:
        """Net energy and its origin, as far as it is known."""
        beyond = ["what it put in"]
        if self.ratio * self.scene > INSTANT:
            released = f"what the scene released ({format_energy(self.scene)} at the end)"
            beyond.append(f"{self.times} {released}" if self.times else released)
        works = {"motors": abs(self.motors), "inputs": abs(self.inputs)}  # of another instant
        origins = [
            f"the scene's {name} gave or took up to {format_energy(works[name])}"
            for name in self._pushing
        ]
        if origins:
            origins[-1] += f", and {_BOUND}"
        if self.ratio * self.springs > INSTANT:
            springs = format_energy(self.springs)
            held = f"the coupling's springs held {springs} at the start or after resets"
            others = [
                f", and the scene's {name}, which may have loaded them, gave or took up to "
                f"{format_energy(work)}"
                for name, work in works.items()
                if name not in self._pushing and self.ratio * work > INSTANT
            ]
            origins.append(held + "".join(others))
        if self.fault and self.unpaid > self.hidden:
            origins.append(f"nothing paid for {format_energy(self.unpaid)} of it")
        if not origins:
            beyond.append("what the device's damping burned")
        *first, last = beyond
        listed = f"{', '.join(first)} and {last}" if first else last
        text = f"{format_energy(self.net)} at most, beyond {listed}"
        return f"{text}: {'; '.join(origins)}" if origins else text
