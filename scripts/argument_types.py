"""Types of the scripts' options: argparse ends with a sentence where a number is out of range."""

from __future__ import annotations

import argparse
import math


def whole(text: str) -> int:
    """Returns a whole number >= 1.

    Raises:
        argparse.ArgumentTypeError: The text is none.
    """
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r:.60} is no whole number of 1 or more")
    return int(text)


def positive(text: str) -> float:
    """Returns a finite number > 0.

    Raises:
        argparse.ArgumentTypeError: The text is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r:.60} is no number above 0")
    return value
