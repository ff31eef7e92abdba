"""The entry point: in charge before the rest is imported, which takes seconds."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from hapticbridge.signals import leaving_on_interrupt

USAGE_ERROR, INTERRUPTED = 2, 130

_RENDERERS = {
    "linux": "'egl', 'osmesa', 'glfw', 'glx'",
    "darwin": "'cgl', 'glfw'",
    "win32": "'wgl', 'glfw'",
}
"""What MuJoCo takes as ``MUJOCO_GL`` per system, beside 'disable'."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs ``hapticbridge``; returns the exit code.

    0 done, 1 done with a negative verdict, 2 bad input or usage, 3 safety trip, 130 interrupted.
    """
    try:
        try:
            with leaving_on_interrupt(INTERRUPTED):
                from hapticbridge.cli.dispatch import dispatch  # noqa: PLC0415 - takes seconds
        except RuntimeError as error:
            if "MUJOCO_GL" not in str(error):
                raise
            asked, valid = os.environ.get("MUJOCO_GL"), _RENDERERS.get(sys.platform, "'glfw'")
            print(
                f"error: the environment variable MUJOCO_GL is {asked!r}, which MuJoCo does not "
                f"know; unset it, or set it to {valid} or 'disable'",
                file=sys.stderr,
            )
            return USAGE_ERROR
        return dispatch(arguments)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
