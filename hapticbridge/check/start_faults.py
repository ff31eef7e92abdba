"""Faults of contacts at the start, and of contact margins."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from hapticbridge.check.case import Case
from hapticbridge.check.contact_faults import pair_names
from hapticbridge.check.faults import Fault, length
from hapticbridge.scene.checks import MAXIMUM_START_PENETRATION
from hapticbridge.scene.contact_check import settings_among
from hapticbridge.scene.start import START_KEYFRAME


def margin_faults(case: Case) -> Iterator[Fault]:
    """Yields geoms and pairs whose contacts push before they touch."""
    model, places = case.model, case.places
    meeting = {geom for first, second, _ in settings_among(model) for geom in (first, second)}
    found = [(places.geom(geom), float(model.geom_margin[geom])) for geom in sorted(meeting)]
    found += [(places.pair(p), float(model.pair_margin[p])) for p in range(model.npair)]
    for place, margin in found:
        if margin > 0:
            yield Fault(
                "margin",
                place,
                f"{place.element} has a margin of {1e3 * margin:g} mm: it pushes that far before "
                "it is touched, and the force jumps where it begins",
                'margin="0"',
            )


def start_faults(case: Case) -> Iterator[Fault]:
    """Yields starts that are not finite, and overlapping geoms, whose energy is not metered."""
    case.scene.reset()
    model, data = case.model, case.scene.data
    beyond = [
        name
        for name in ("qpos", "qvel", "qacc")
        if not np.all(np.abs(getattr(data, name)) <= mujoco.mjMAXVAL)
    ]
    if beyond:
        yield Fault(
            "start not finite",
            case.places.named("key", START_KEYFRAME),
            f"at the start {' and '.join(beyond)} are not finite or beyond {mujoco.mjMAXVAL:g}",
            "numbers of this scene's size",
        )
    seen = set()
    for contact in data.contact:
        first, second = (int(geom) for geom in contact.geom)
        if (
            first < 0
            or second < 0
            or (first, second) in seen
            or contact.dist >= -MAXIMUM_START_PENETRATION
        ):
            continue
        seen.add((first, second))
        mover = second if model.body_treeid[model.geom_bodyid[second]] >= 0 else first
        body = int(model.geom_bodyid[mover])
        out = -contact.dist * contact.frame[:3] * (1 if mover == second else -1)
        yield Fault(
            "starts in contact",
            case.places.geom(mover),
            f"{pair_names(case, [(first, second)])} overlap by {length(-contact.dist)} at the "
            f"start; more than {length(MAXIMUM_START_PENETRATION)} release energy that is not "
            "metered",
            _moved_out(case, body, out),
        )


def _moved_out(case: Case, body: int, out: np.ndarray) -> str:
    model = case.model
    by = " ".join(f"{value:.4g}" for value in 1e3 * out)
    has_home = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, START_KEYFRAME) >= 0
    name = model.body(body).name or body
    if has_home or model.body_parentid[body] != 0:
        start = "keyframe 'home'" if has_home else "its pos"
        return f"move body '{name}' in {start} by {by} mm"
    position = " ".join(f"{value:.6g}" for value in model.body_pos[body] + 1.01 * out)
    return f"pos=\"{position}\" in body '{name}' (moved by {by} mm)"
