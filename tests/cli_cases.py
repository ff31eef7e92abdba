"""Values that tests of the command line share."""

from __future__ import annotations

from collections.abc import Callable

Called = Callable[..., tuple[int, str, str]]
"""The fixture ``call``: it runs a command; returns exit code, stdout and stderr."""


def one_sentence(err: str) -> str:
    """Returns the error's line, after holding it against what an error may look like."""
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, err
    return lines[0]
