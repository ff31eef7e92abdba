"""The workers of a dask.distributed cluster, and what to say where its scheduler is not there."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from hapticbridge.errors import StudyError
from hapticbridge.files import import_extra
from hapticbridge.study.workers import IN_FLIGHT, Workers

_PATIENCE = 3.0
"""Seconds for a dask scheduler to answer; a local one takes 0.05 s. Shorter refuses a far one."""

_WORKERS_PATIENCE = 5.0
"""Seconds for a dask scheduler to have a worker: one that was just started takes 2 s."""


class ClusterWorkers(Workers):
    """The workers of a running dask.distributed cluster.

    Raises:
        StudyError: dask is not installed, no scheduler answers, or it has no workers.
    """

    def __init__(self, scheduler: str) -> None:
        distributed = import_extra("distributed", "a scheduler", "cluster", StudyError, "dask")
        try:
            # asked beforehand, because a client that was refused takes 10 s to be given up, and
            # ends in a traceback; in a thread of its own, because this one may run a loop already
            with ThreadPoolExecutor(1) as thread:
                thread.submit(asyncio.run, _identity(distributed, scheduler)).result()
            self._client = distributed.Client(scheduler, timeout=_PATIENCE, set_as_default=False)
        except Exception as error:  # something else may listen there and answer anything
            why = str(error) or f"nothing came within {_PATIENCE:g} s"
            raise StudyError(
                f"no dask scheduler answers at {scheduler!r:.100} ({why:.200}); its address looks "
                "like tcp://host:8786"
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=_WORKERS_PATIENCE)
        except OSError:
            self._client.close()
            raise StudyError(
                f"the dask scheduler at {scheduler} has no workers; start some with: "
                f"dask worker {scheduler}"
            ) from None
        self._death = distributed.scheduler.KilledWorker
        count = sum(self._client.ncores().values())
        # a task may have side effects that the caller counts on: never answered from a cache
        executor = self._client.get_executor(pure=False)
        super().__init__(executor, depth=max(IN_FLIGHT, 2 * count))

    def restart(self) -> None:
        """The scheduler has started fresh workers itself."""

    def is_death(self, error: BaseException) -> bool:
        """See ``Workers.is_death``."""
        return isinstance(error, self._death)

    def close(self) -> None:
        """See ``Workers.close``."""
        self._client.close()


async def _identity(distributed: Any, scheduler: str) -> None:
    """Asks a dask scheduler who it is.

    Raises:
        Exception: It does not answer in time, or not as a scheduler.
    """
    arguments = distributed.Security().get_connection_args("client")
    async with distributed.rpc(scheduler, connection_args=arguments) as asked:
        answer = await asyncio.wait_for(asked.identity(), _PATIENCE)
    if answer["type"] != "Scheduler":
        raise ValueError(f"a {answer['type']} answers there")
