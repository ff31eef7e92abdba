"""Values that tests of the command line share."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

Called = Callable[..., tuple[int, str, str]]
"""The fixture ``call``: it runs a command; returns exit code, stdout and stderr."""


def facts_of(call: Called, *words: object) -> tuple[int, Any]:
    """Returns the exit code of a command, and what it printed: JSON without inf and nan."""
    code, out, _ = call(*words, "--json")
    return code, json.loads(out, parse_constant=pytest.fail)


def one_sentence(err: str) -> str:
    """Returns the error's line, after holding it against what an error may look like."""
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, err
    return lines[0]
