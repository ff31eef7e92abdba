"""Types of the scripts' options: argparse ends with a sentence where one is wrong."""

from __future__ import annotations

import argparse
import math
from pathlib import Path


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


def new_file(text: str) -> Path:
    """Returns the path of a file that can be written later.

    Raises:
        argparse.ArgumentTypeError: Its folder is missing, or it is a folder itself.
    """
    path = Path(text)
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r:.60} is no file in an existing folder")
    return path
