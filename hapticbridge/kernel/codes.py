"""Names and numbers that the kernel shares with scenes, methods and records."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.record import TickFlag

State: TypeAlias = Any
"""The kernel's whole state (``state.STATE_DTYPE``) as one record. Compiled functions get it by
reference."""

Part: TypeAlias = Any
"""One sub-record of the state, such as ``energy``, by reference. Only one module writes to it."""

PREFIX = "hapticbridge/"
"""Start of every name that the bridge adds to a scene, so that no name of the scene is taken."""

HANDLE = f"{PREFIX}handle"
"""Name of the mocap body, and of its site, that the bridge adds to a scene."""

WELD_NAME = f"{PREFIX}handle_weld"
"""Name of the equality constraint that joins grip and handle for the method ``weld``."""

COUPLING_ACTUATORS = tuple(
    f"{PREFIX}coupling_{kind}_{axis}" for kind in ("force", "torque") for axis in ("x", "y", "z")
)
"""Names of the six actuators that couple the grip to the handle, in the order of a wrench."""


def added_id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    """Returns the id of something that the bridge added, or -1.

    The models in earlier recordings have the names without ``PREFIX``.
    """
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, HANDLE) < 0:
        name = name.removeprefix(PREFIX)
    return int(mujoco.mj_name2id(model, kind, name))


@dataclass(frozen=True, slots=True)
class Grip:
    """Site, body, point of a body, or joint that a hand holds.

    Attributes:
        name: Name of the site, body or joint.
        kind: ``site`` (or a body's), or ``joint``, a hinge or slide that moves along its one axis.
    """

    name: str
    kind: Literal["site", "joint"] = "site"

    @classmethod
    def from_text(cls, text: str) -> Grip:
        """Returns the grip of its text: ``SITE``, ``BODY``, ``BODY@x,y,z`` or ``joint:NAME``."""
        kind, is_kind, name = text.partition(":")
        return cls(name, "joint") if is_kind and kind == "joint" else cls(text)

    def __str__(self) -> str:
        return f"joint:{self.name}" if self.is_joint else self.name

    @property
    def is_joint(self) -> bool:
        """True for a joint, which has no handle in the scene."""
        return self.kind == "joint"


def held_joint(model: mujoco.MjModel, grip: str) -> int:
    """Returns the id of the joint that a grip names, or -1 if it names a site."""
    held = Grip.from_text(grip)
    return int(model.joint(held.name).id) if held.is_joint else -1


def held_body(model: mujoco.MjModel, grip: str) -> int:
    """Returns the id of the body that a grip moves, that of its site or of its joint."""
    joint = held_joint(model, grip)
    return int(model.site_bodyid[model.site(grip).id] if joint < 0 else model.jnt_bodyid[joint])


def moving_geoms(model: mujoco.MjModel, site: int) -> NDArray[np.bool_]:
    """Returns a mask of the geoms that move with a site, on it or on joints, shape (ngeom,)."""
    root = model.body_rootid[model.site_bodyid[site]]
    return np.asarray(model.body_rootid[model.geom_bodyid] == root, dtype=bool)


def name_of_hand(name: str, hand: int) -> str:
    """Returns the name that a hand has, from hand 0: the name itself, then ``…_2``, ``…_3``."""
    return name if hand == 0 else f"{name}_{hand + 1}"


def coupling_ids(model: mujoco.MjModel, hand: int = 0) -> tuple[int, ...]:
    """Returns the ids of the six actuators of a hand's coupling, in the order of a wrench.

    The coupling to a joint has the first one alone.
    """
    kind = mujoco.mjtObj.mjOBJ_ACTUATOR
    found = (added_id(model, kind, name_of_hand(name, hand)) for name in COUPLING_ACTUATORS)
    return tuple(each for each in found if each >= 0)


def hand_count(model: mujoco.MjModel) -> int:
    """Returns the number of hands that a scene has couplings for; 0 without a handle."""
    if added_id(model, mujoco.mjtObj.mjOBJ_BODY, HANDLE) < 0:
        return 0
    count = 1
    while coupling_ids(model, count):
        count += 1
    return count


def handle_ids(model: mujoco.MjModel) -> dict[int, int]:
    """Returns the body id of each hand's handle; a hand that holds a joint has none."""
    kind, hands = mujoco.mjtObj.mjOBJ_BODY, range(hand_count(model))
    found = {hand: added_id(model, kind, name_of_hand(HANDLE, hand)) for hand in hands}
    return {hand: body for hand, body in found.items() if body >= 0}


def added_actuators(model: mujoco.MjModel) -> tuple[int, ...]:
    """Returns the ids of the actuators of all couplings, hand by hand."""
    return tuple(i for hand in range(hand_count(model)) for i in coupling_ids(model, hand))


class Scheme(IntEnum):
    """Path by which the coupling's wrench reaches the tool.

    Attributes:
        IMPLICIT: Six actuators compute it while MuJoCo steps, which solves them implicitly.
        ZERO_ORDER_HOLD: Six actuators apply the wrench of the previous tick, held constant.
        WELD: An equality constraint of MuJoCo applies it; there is no coupling law.
        MASSLESS: The tool has no mass and is placed at the handle; there is no coupling.
        MIDPOINT: The actuators apply half of it implicitly, and the other half is carried over
            from the previous step (``kernel.lossless``).
        SHOWN: The tool is shown at a pose that comes from a slower loop (``kernel.shown_tool``).
    """

    IMPLICIT = 0
    ZERO_ORDER_HOLD = 1
    WELD = 2
    MASSLESS = 3
    MIDPOINT = 4
    SHOWN = 5

    @property
    def properties(self) -> SchemeProperties:
        """Properties of the path that other code reads; its steps stand in the kernel."""
        return _PROPERTIES[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class SchemeProperties:
    """Properties of a path of the wrench to the tool.

    Attributes:
        has_law: True if the coupling law gives the wrench.
        has_tool_mass: True if MuJoCo moves the tool; False if the tool is placed at the handle.
        holds_wrench: True if the wrench is applied as a force during the next tick. The law is then
            evaluated once per tick, else once per MuJoCo step.
        may_split: True if MuJoCo's position stage may run ahead of the sample.
        allows_hands: True if several hands may hold one scene.
        one_substep: Reason for which a tick has one MuJoCo step; empty if it may have several.
    """

    has_law: bool = True
    has_tool_mass: bool = True
    holds_wrench: bool = False
    may_split: bool = True
    allows_hands: bool = False
    one_substep: str = ""

    def law_evaluations(self, substeps: int) -> int:
        """Returns the evaluations of the tool's wrench per tick."""
        return 1 if self.holds_wrench else substeps


_PROPERTIES = {
    Scheme.IMPLICIT: SchemeProperties(allows_hands=True),
    Scheme.ZERO_ORDER_HOLD: SchemeProperties(holds_wrench=True),
    Scheme.WELD: SchemeProperties(has_law=False, may_split=False),
    Scheme.MASSLESS: SchemeProperties(
        has_law=False,
        has_tool_mass=False,
        may_split=False,
        one_substep="a tool without mass has no motion to divide",
    ),
    Scheme.MIDPOINT: SchemeProperties(
        one_substep="a lossless coupling carries half of a tick's wrench over to the next"
    ),
    Scheme.SHOWN: SchemeProperties(
        may_split=False, one_substep="the scene steps in a loop of its own"
    ),
}


OK, BAD_SAMPLE, BAD_RESULT, HALF_DONE, RING_FULL = 0, 1, 2, 3, 4
"""Results of the tick's stages: success; a sample that is not a pose; a simulation result that is
not finite or of which MuJoCo warned; success with only the second half of MuJoCo's step left to do;
no room in the ring."""

JUMPED, BACKWARDS, STRETCHED, TWISTED, GAVE_ENERGY = 11, 12, 13, 14, 15
"""Reasons of the guard to refuse a tick: the device's pose jumped; time ran backwards; the coupling
is too long; it is turned too far; the device received too much energy."""

CONTACTS_FULL, CONSTRAINTS_FULL = 16, 17
"""Warnings of MuJoCo that refuse a tick: contacts or constraint rows were dropped, because they do
not fit into its memory."""

WARNINGS = {
    CONTACTS_FULL: "MuJoCo's memory holds no more contacts, so bodies would pass each other",
    CONSTRAINTS_FULL: "MuJoCo's memory holds no more constraints, so nothing would be held",
}
"""Reasons in words, by result."""

_MORE_MEMORY = 'give MuJoCo more memory in the scene, such as <size memory="100M"/>'
WARNING_REMEDIES = {
    CONTACTS_FULL: _MORE_MEMORY,
    CONSTRAINTS_FULL: _MORE_MEMORY,
}
"""Remedies by result, for ``WARNINGS``."""


def warning_words(code: int) -> str:
    """Returns reason and remedy of a result in ``WARNINGS``, as a sentence."""
    return f"{WARNINGS[code]}; {WARNING_REMEDIES[code]}"


HAND_CODES = 100
"""Factor of a hand's number in the result of a tick that was refused for one of several hands."""

FORCE_LIMITED = int(TickFlag.FORCE_LIMITED)
RAMPING = int(TickFlag.RAMPING)
CONTROLLER_ACTIVE = int(TickFlag.CONTROLLER_ACTIVE)
CONTACT = int(TickFlag.CONTACT)
CLUTCH = int(TickFlag.CLUTCH)
STALE_SAMPLE = int(TickFlag.STALE_SAMPLE)
TRIP = int(TickFlag.TRIP)
REANCHORED = int(TickFlag.REANCHORED)
LOSSLESS_TICK = int(TickFlag.MIDPOINT)
SWINGING = int(TickFlag.SWINGING)
RUNS_AWAY = int(TickFlag.RUNS_AWAY)
PROBED = int(TickFlag.PROBED)
"""Bits of ``TickFlag`` as integers, because numba cannot compile an ``IntFlag``."""

FORCE_OFF, CLUTCHED = 1 << 40, 1 << 41
"""Bits of commands in force, above the device's own buttons: the force is switched off; the handle
stays as if a clutch button were held. Both let the hand go."""

EQUALITY, LIMIT_JOINT, LIMIT_TENDON, CONTACT_PYRAMIDAL = 0, 3, 4, 6
"""Kinds of constraint rows, numbered as in MuJoCo's ``mjtConstraint``."""

MAX_CONTROL = 1e10
"""Largest control in N and N m, MuJoCo's mjMAXVAL. MuJoCo ignores a larger one; a run that reaches
it has diverged."""
