"""Treatment of MJCF: what a run changes or refuses in a scene's elements and attributes.

Elements and attributes that are not in ``TREATMENTS`` are kept: the compiled model that a run steps
has the file's values, and MuJoCo computes with them.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from hapticbridge.kernel.restitution import NOTABLE_BOUNCE
from hapticbridge.kernel.rigid_contact import IMPRATIO, MARGIN
from hapticbridge.units import format_si

Act = Literal["changed", "without effect", "refused", "kept, and said"]


class Treatment(NamedTuple):
    """Treatment of one element, or of attributes of it.

    Attributes:
        element: Element of MJCF; several are separated by commas.
        attributes: Attributes of it, separated by commas; empty for the element itself.
        act: Effect of the setting in a run.
        becomes: Replacement of the file's value; empty without one.
        why: Reason, without a subject of its own.
        is_rigid: True if only rigid contacts change it; ``--contact scene`` keeps it.
        stops: True if a scene is refused with ``--as-is`` in place of the change.
    """

    element: str
    attributes: str
    act: Act
    becomes: str
    why: str
    is_rigid: bool = False
    stops: bool = False

    @property
    def settings(self) -> tuple[tuple[str, str], ...]:
        """Pairs of element and attribute; the attribute is empty for the element itself."""
        names = self.attributes.split(", ")
        return tuple((each, name) for each in self.element.split(", ") for name in names)


_CONTACTS = "geom, pair, contact"
_RIGID = f"rigid; a bounce with e >= {NOTABLE_BOUNCE:g} stays, as an impact"
_IN_STEP = "leaves the coupling out of the implicit step"

TREATMENTS: dict[str, Treatment] = {
    "time step": Treatment(
        "option", "timestep", "changed", "the loop's period, in equal substeps",
        "each period of the device has its step",
    ),
    "delays": Treatment(
        "actuator, sensor", "", "changed", "as many samples (`nsample`) as span the same time",
        "a delay keeps its time at another time step",
    ),
    "integrator": Treatment(
        "option", "integrator", "changed", "the method's, for ranges of lengths too",
        "the energy of a step is only then known",
    ),
    "eulerdamp": Treatment(
        "flag", "eulerdamp", "without effect", "",
        "it belongs to an integrator that is replaced",
    ),
    "solver": Treatment(
        "option", "solver", "changed", "Newton; `--as-is` refuses PGS",
        f"PGS {_IN_STEP}, and CG is less exact",
    ),
    "noslip": Treatment(
        "option", "noslip_iterations", "changed", "0", f"this pass {_IN_STEP}", stops=True,
    ),
    "noslip tolerance": Treatment(
        "option", "noslip_tolerance", "without effect", "", "the pass it belongs to is off",
    ),
    "precision": Treatment(
        "option", "iterations, ls_iterations, tolerance, ls_tolerance", "changed",
        "at least MuJoCo's default precision",
        "a solver that stops early leaves the energy of contacts unknown", is_rigid=True,
    ),
    "cone": Treatment(
        "option", "cone", "changed", "elliptic",
        "friction is the same in all directions", is_rigid=True,
    ),
    "impratio": Treatment(
        "option", "impratio", "changed", f"{IMPRATIO:g}",
        "what rests by friction creeps less", is_rigid=True,
    ),
    "override margin": Treatment(
        "option", "o_margin", "changed", "0", "it also says how early contacts are seen",
        is_rigid=True,
    ),
    "override softness": Treatment(
        "option", "o_solref, o_solimp", "changed", _RIGID,
        "the energy of soft contacts is in no account", is_rigid=True,
    ),
    "wind": Treatment(
        "option", "wind", "kept, and said", "", "no port meters its work",
    ),
    "sleep": Treatment(
        "flag", "sleep", "changed", "disable", "the coupling does not wake what sleeps", stops=True,
    ),
    "sleep policy": Treatment(
        "body", "sleep", "without effect", "", "nothing sleeps",
    ),
    "sleep tolerance": Treatment(
        "option", "sleep_tolerance", "without effect", "", "nothing sleeps",
    ),
    "energy": Treatment(
        "flag", "energy", "changed", "enable", "the meter reads it; it moves nothing",
    ),
    "diagonal": Treatment(
        "flag", "diagexact", "changed",
        "enable; dry friction creeps and flexes yield otherwise then",
        "rigid contacts need the exact inertia of each row", is_rigid=True,
    ),
    "autoreset": Treatment(
        "flag", "autoreset", "changed", "disable",
        "a reset in mid-run would move the tool; the run trips instead",
    ),
    "actuation": Treatment(
        "flag", "actuation", "changed", "the scene's actuators off by their groups",
        "the coupling is made of actuators",
    ),
    "ipc": Treatment(
        "flag", "ipc", "refused", "", "its state cannot be saved and simulated again",
    ),
    "length ranges": Treatment(
        "lengthrange", "mode", "changed", "muscleuser in place of all",
        "the coupling has no range of lengths",
    ),
    "memory": Treatment(
        "size", "memory, njmax, nconmax, nstack", "changed",
        "MuJoCo's default if it is less; 134 MB if it is more, or for over 1000 rows",
        "a full memory drops contacts, and an audit has a limit",
    ),
    "margin": Treatment(
        _CONTACTS, "margin", "changed", f"{format_si(MARGIN, 'm')} more, and more with the speed",
        "a contact is seen before it closes; it rests where the file says", is_rigid=True,
    ),
    "adhesion": Treatment(
        "geom, pair", "adhesion", "changed",
        "from as much farther as the gap is wider, also an actuator's; said",
        "contacts are seen ahead, and no port meters the pull",
    ),
    "gap": Treatment(
        _CONTACTS, "gap", "changed", "wider by the method's reach",
        "contacts ahead are seen; without adhesion they give no force",
    ),
    "softness": Treatment(
        _CONTACTS, "solref, solimp", "changed", _RIGID,
        "the energy of soft contacts is in no account", is_rigid=True,
    ),
    "friction's softness": Treatment(
        "pair", "solreffriction", "without effect", "", "friction is rigid", is_rigid=True,
    ),
    "limit's softness": Treatment(
        "joint, spatial, fixed", "solreflimit, solimplimit", "changed", _RIGID,
        "the energy of soft limits is in no account", is_rigid=True,
    ),
    "equality's softness": Treatment(
        "connect, weld, equality/joint, equality/tendon", "solref, solimp", "changed", "rigid",
        "the energy of soft constraints is in no account", is_rigid=True,
    ),
    "joint's force limit": Treatment(
        "joint", "actuatorfrclimited, actuatorfrcrange", "changed",
        "the same limit on its actuators, with their moment arms at the start, of joints that "
        "carry the grip",
        "it would cap the coupling", stops=True,
    ),
    "joint's gravity compensation": Treatment(
        "joint", "actuatorgravcomp", "changed", "given without an actuator, too",
        "the coupling is made of actuators",
    ),
    "edges": Treatment(
        "edge", "stiffness, damping", "changed", "constraints of constant length; no damping",
        "the implicit integrator lacks them", stops=True,
    ),
    "passive contacts": Treatment(
        "flexcomp/contact, flex/contact", "passive", "changed", "constraints",
        "the energy of passive contacts is in no account", stops=True,
    ),
    "mocap weld": Treatment(
        "connect, weld", "active", "changed", "false where a mocap body holds the grip",
        "the hand takes its place", stops=True,
    ),
    "weight": Treatment(
        "body", "gravcomp", "changed", "1 for a tool whose weight is carried",
        "the device or the hand cannot hold it",
    ),
    "nested parts": Treatment(
        "exclude", "", "changed", "added for links that start inside each other",
        "such a contact only jams the joint",
    ),
    "overlap": Treatment(
        "key", "", "changed",
        "overlaps that cannot be moved apart are held, and eased out as far as joints allow",
        "pushing out at once would create energy",
    ),
    "start": Treatment(
        "key", "qpos", "changed", "moved onto limits, equality constraints and contacts",
        "rigid ones would hold the violation, and soft ones release its energy",
    ),
    "only keyframe": Treatment(
        "key", "name", "changed", "the start, if it is the only one, at rest and has no name",
        "the file names no other start",
    ),
    "servos": Treatment(
        "key", "ctrl", "changed", "the pose of the keyframe where position servos have no control",
        "zeros would fling the scene out of its pose",
    ),
}  # fmt: skip
"""Treatments that differ from *kept*, by the name of the subject."""


class SceneChange(NamedTuple):
    """Difference of a running scene from its file.

    Attributes:
        words: The change as ``name: old → new``.
        subject: Key of ``TREATMENTS``.
        reason: Cause in the run, of a change that the scene alone does not determine; else empty.
    """

    words: str
    subject: str
    reason: str = ""

    def __str__(self) -> str:
        kept = " (--contact scene keeps it)" if self.treatment.is_rigid else ""
        return self.words + (f" ({self.reason})" if self.reason else kept)

    @property
    def treatment(self) -> Treatment:
        """The treatment in the table that made this change."""
        return TREATMENTS[self.subject]


def treatment_table() -> str:
    """Returns the table of the treatments in Markdown, as the guide shows it."""
    lines = ["| element | attribute | in a run | because |", "|---|---|---|---|"]
    for each in TREATMENTS.values():
        effect = f"{each.act}: {each.becomes}" if each.becomes else each.act
        effect += " (rigid contacts)" if each.is_rigid else ""
        effect += "; `--as-is` refuses it" if each.stops else ""
        names = (
            ", ".join(f"`{name}`" for name in text.split(", ")) if text else "–"
            for text in (each.element, each.attributes)
        )
        lines.append(f"| {' | '.join(names)} | {effect} | {each.why} |")
    return "\n".join(lines)
