"""What tests of the command line share."""

from __future__ import annotations

from collections.abc import Callable

Called = Callable[..., tuple[int, str, str]]
