"""Who does a sweep's tasks: any executor, seen by how much it takes and how its workers die."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import Any

from hapticbridge.errors import StudyError

IN_FLIGHT = 64
"""Tasks in flight where the number of workers is not known: more workers than that would idle."""


def cores() -> int:
    """Returns how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class InThisProcess(Executor):
    """Works while it submits: for few tasks, where a process would take longer to start."""

    def submit(self, task: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Does the task; what it raises is the future's."""
        future: Future[Any] = Future()
        try:
            future.set_result(task(*arguments, **named))
        except Exception as error:
            future.set_exception(error)
        return future


class Workers:
    """An executor that somebody else owns.

    Attributes:
        depth: How many tasks to keep in flight.
    """

    def __init__(self, executor: Executor, depth: int = IN_FLIGHT) -> None:
        self.executor = executor
        self.depth = depth

    def submit(self, task: Callable[..., Any], *arguments: object) -> Future[Any]:
        """Hands one task over.

        Raises:
            BrokenExecutor: A worker died; ``restart`` is next.
            StudyError: The executor takes no more tasks.
        """
        try:
            return self.executor.submit(task, *arguments)
        except BrokenExecutor:
            raise
        except RuntimeError as error:
            raise StudyError(f"the executor takes no tasks: {error}") from None

    def restart(self) -> None:
        """Puts fresh workers in the place of dead ones.

        Raises:
            StudyError: That cannot be done.
        """
        raise StudyError(
            "a worker of the executor died and it takes no more tasks; sweep again with a fresh "
            "one, and a folder to keep what is done"
        )

    def is_death(self, error: BaseException) -> bool:
        """Tells whether a task's error means that its worker died, not that the task is wrong."""
        return isinstance(error, BrokenExecutor)

    def stop(self) -> None:
        """Waits for tasks that cannot be cancelled, where these workers are the sweep's own."""

    def close(self) -> None:
        """Gives back what was opened."""
