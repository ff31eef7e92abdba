"""Causes of energy created in the environment."""

from __future__ import annotations

import numpy as np

from hapticbridge.audit import AuditReport
from hapticbridge.audit.differences import turn_between
from hapticbridge.report.cause import MOST, SAFE_METHOD, WINDOW, Cause
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.touched import Pairs, touched_pairs
from hapticbridge.scene.contact_check import check_contacts, geom_name

FAST_TURN = 0.02
"""Rotation of the tool in rad per tick above which its gyroscopic torque is suspected. At 1 kHz, 50
rad/s created 0.05 J in a second under a coupling of translation alone (measured). A smaller value
suspects hands, which turn at 10 rad/s; a larger one misses such cases."""

_SOFTER = "lower the stiffness, raise the rate, or make the contacts softer"


def cause_in_environment(evidence: Evidence, report: AuditReport, window: slice) -> Cause:
    """Returns the likely cause of energy created in the environment."""
    method = evidence.method
    gained = np.diff(evidence.created, prepend=0.0)[window].clip(min=0.0)
    touches = (evidence.ticks["contacts"] > 0)[window]
    share = float(gained[touches].sum() / gained.sum()) if gained.sum() > 0 else 0.0
    where = f"{share:.0%} of the energy created until then came in ticks with contact"
    pairs = touched_pairs(evidence, report, window, gained) if share >= MOST else None
    if pairs:
        where += _pair_words(evidence, pairs)
    if (moved := _moved_bodies(evidence, window)) and _can_push(evidence, pairs, share):
        return Cause(
            "inputs",
            f"mocap bodies were moved {moved} times in the {WINDOW:g} s before; {where}; MuJoCo "
            "damps their contacts and welds against rest, so a fast move creates energy",
            "move them slower",
        )
    if share < MOST:
        return _cause_without_contact(evidence, window, where)
    if concerns := _concerns(evidence, pairs):
        concern, _, remedy = concerns[0].rpartition("; write ")
        return Cause("contact setting", f"{where}; {concern}", f"write {remedy}")
    if method.hazard:
        return Cause(
            "method",
            f"{where}, whose setting is as recommended; method '{method.name}': {method.hazard}",
            SAFE_METHOD,
        )
    hard = "a light tool on a stiff coupling is the hard case"
    return Cause("contact setting", f"{where}; {hard}", _SOFTER)


def _cause_without_contact(evidence: Evidence, window: slice, where: str) -> Cause:
    method, turned = evidence.method, _largest_turn(evidence, window)
    if method.hazard:
        return Cause("method", f"{where}; method '{method.name}': {method.hazard}", SAFE_METHOD)
    if turned > FAST_TURN:
        return Cause(
            "rate",
            f"{where}; the tool turned by up to {turned:.2g} rad a tick "
            f"({turned / evidence.parameters.period:.3g} rad/s), and MuJoCo takes the gyroscopic "
            "torque from the start of a step",
            "raise the rate, or turn the tool slower",
        )
    return Cause(
        "unknown",
        f"{where}; method '{method.name}' is not known to create energy without contact",
        "try a higher rate with 'hapticbridge audit FILE --what-if rate=…'",
    )


def _largest_turn(evidence: Evidence, window: slice) -> float:
    """Returns the tool's largest rotation in one tick, in rad."""
    quaternion = evidence.ticks["tool_quaternion"][max(window.start - 1, 0) : window.stop + 1]
    return float(
        np.linalg.norm(turn_between(quaternion[:-1], quaternion[1:]), axis=1).max(initial=0.0)
    )


def _pair_words(evidence: Evidence, pairs: Pairs) -> str:
    pair, share = next(iter(pairs.items()))
    if evidence.model is None:
        return ""
    touching = " touched ".join(geom_name(evidence.model, geom) for geom in sorted(pair))
    more = f" ({len(pairs) - 1} other pairs touched, too)" if len(pairs) > 1 else ""
    return f", {share:.0%} while {touching}{more}"


def _concerns(evidence: Evidence, pairs: Pairs | None) -> list[str]:
    """Returns concerns about the contacts that touched; about all contacts if unknown."""
    if evidence.model is None:
        return []
    only = None if pairs is None else list(pairs)
    return check_contacts(evidence.model, evidence.parameters.grip, only=only)


def _can_push(evidence: Evidence, pairs: Pairs | None, share: float) -> bool:
    """Returns True if a mocap body held or touched anything while the energy was created."""
    model = evidence.model
    if model is None:
        return True
    if model.neq and share < MOST:  # a weld pulls without contact
        return True
    if share < MOST or pairs is None:
        return share >= MOST
    is_driven = model.body_mocapid[model.body_rootid[model.geom_bodyid]] >= 0
    return any(is_driven[geom] for pair in pairs for geom in pair)


def _moved_bodies(evidence: Evidence, window: slice) -> int:
    return sum(
        event.get("event") == "input"
        and isinstance(event.get("tick"), int)
        and window.start <= event["tick"] < window.stop
        and "mocap_"
        in str(event.get("writes"))  # as text, because a damaged event may have any shape
        for event in evidence.events
    )
