"""What a worker does: applies a function to the points of one task and reports on each."""

from __future__ import annotations

import functools
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hapticbridge.errors import StudyError
from hapticbridge.study.points import RESERVED, Point, Value, plain
from hapticbridge.study.table import Outcome

_LONGEST_ERROR = 1000
"""Letters of an error that are kept."""

WORKER_DIED = "WorkerDied: the worker process ended while it computed this point, twice"


def run_task(function: Callable[[Any], Any], batched: bool, points: list[Point]) -> list[Outcome]:
    """Applies a function to points, in a worker.

    Where a batch fails as a whole, its points are computed one at a time, so that only those
    that fail alone are recorded as failed.

    Args:
        function: Takes one point, or a list of them where ``batched``.
        batched: See ``function``.
        points: The points of this task.

    Returns:
        What became of each point. Nothing that the function raises gets out, KeyboardInterrupt
        excepted.
    """
    if not batched:
        return [_alone(function, point) for point in points]
    try:
        answers = _batch(function, points)
    except (Exception, SystemExit) as error:
        if len(points) == 1:
            return [_failure(error)]
        return [done for point in points for done in run_task(function, True, [point])]
    return [_checked(answer, point) for answer, point in zip(answers, points, strict=True)]


def qualified_name(function: Callable[[Any], Any]) -> str:
    """Returns a name by which a function is known again, in another process and on another day.

    A ``functools.partial`` is named by its function and the ``repr`` of its arguments.

    Raises:
        StudyError: The function does not stand at the top level of a module, or cannot be sent to
            another process.
    """
    if isinstance(function, functools.partial):
        with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
            settings = [repr(value) for value in function.args]
            settings += [f"{name}={value!r}" for name, value in sorted(function.keywords.items())]
        name = f"{qualified_name(function.func)}({', '.join(settings)})"
    else:
        inner = getattr(function, "__qualname__", type(function).__name__)
        module = getattr(function, "__module__", None) or "?"
        if "<" in inner or not hasattr(function, "__qualname__"):
            raise StudyError(
                f"{inner} of {module} cannot be swept: workers import the function, so it must be "
                "defined at the top level of a module (or be a functools.partial of such a one)"
            )
        if module == "__main__":
            module = Path(getattr(sys.modules[module], "__file__", None) or "__main__").stem
        name = f"{module}.{inner}"
    try:
        pickle.dumps(function)
    except Exception as error:
        raise StudyError(f"{name:.200} cannot be sent to a worker: {error}") from None
    return name


def _batch(function: Callable[[Any], Any], points: Sequence[Point]) -> list[object]:
    answers = list(function([dict(point) for point in points]))
    if len(answers) != len(points):
        raise ValueError(f"the function returned {len(answers)} results for {len(points)} points")
    return answers


def _alone(function: Callable[[Any], Any], point: Point) -> Outcome:
    try:
        answer = function(dict(point))
    except (Exception, SystemExit) as error:  # whatever it is, it is recorded
        return _failure(error)
    return _checked(answer, point)


def _checked(answer: object, point: Point) -> Outcome:
    try:
        return Outcome(_results(answer, point))
    except ValueError as error:
        return _failure(error)


def _results(answer: object, point: Point) -> dict[str, Value]:
    """Returns what a function gave back with plain values.

    Raises:
        ValueError: It is no mapping of names to numbers, flags or text, or a name is taken.
    """
    if not isinstance(answer, Mapping):
        raise ValueError(f"the function returned {answer!r:.60}, not a mapping of results")  # noqa: TRY004
    found: dict[str, Value] = {}
    for name, value in answer.items():
        if not isinstance(name, str) or not name or not name.isprintable():
            raise ValueError(f"result {name!r:.60} has no name; it must be printable text")
        if name in RESERVED or name in point:
            raise ValueError(f"result '{name}' has the name of another column")
        try:
            found[name] = plain(value)
        except ValueError as error:
            raise ValueError(f"result '{name}': {error}") from None
    return found


def _failure(error: BaseException) -> Outcome:
    """Returns what is recorded of a point that failed: the error's type and message."""
    try:
        text = f"{type(error).__name__}: {error}"
    except Exception:
        text = type(error).__name__
    # a lone surrogate has no bytes and could not be written down
    return Outcome({}, text[:_LONGEST_ERROR].encode(errors="backslashreplace").decode())
