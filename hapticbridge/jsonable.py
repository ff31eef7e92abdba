"""JSON without NaN and infinity, and JSON from other programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any


def jsonable(value: Any) -> Any:
    """Replaces every number that is not finite by None.

    Mappings, lists and tuples may be nested; tuples become lists.
    """
    if isinstance(value, Mapping):
        return {key: jsonable(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(text: str | bytes) -> Any:
    """Parses JSON from a file, a device or a browser.

    Raises:
        ValueError: The text is not JSON, or is nested too deeply for the interpreter.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
