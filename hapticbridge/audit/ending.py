"""Unusual endings of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def how_it_ended(events: Sequence[Mapping[str, Any]]) -> str:
    """Returns a clause that names the event that ended the run; empty for an ordinary end."""
    clauses = []
    for event in events:
        name, reason = event.get("event"), event.get("reason")
        if name == "trip":
            clauses.append(f"the guard tripped at tick {event.get('tick')}: {_shorten(reason)}")
        elif name == "bridge_died":
            clauses.append(f"the bridge died after tick {event.get('tick')}")
        elif name == "recorder_died":
            clauses.append("the recorder died during the run")
        elif name == "suspended":
            clauses.append(f"the machine was asleep for {event.get('seconds', 0):.3g} s")
        elif name == "stop" and event.get("signal"):
            clauses.append(f"stopped by {event['signal']} at tick {event.get('tick')}")
        elif name == "stop" and reason not in ("duration", "signal", "caller", None, ""):
            clauses.append(f"stopped by {_shorten(reason)}")
    has_trip = any(event.get("event") == "trip" for event in events)
    if has_trip:  # its exception is reported as a stop too
        clauses = [clause for clause in clauses if not clause.startswith("stopped by")]
    return "; ".join(clauses)


def _shorten(reason: object) -> str:
    """Returns a reason's text without its leading tick, at most 200 characters."""
    text = str(reason)
    head, mark, rest = text.partition(": ")
    return rest[:200] if mark and head.startswith("tick ") else text[:200]
