"""What plugs an emulated device into something that takes it for a real one."""

from __future__ import annotations

import abc


class FrontEnd(abc.ABC):
    """Joins a device model and a system; served by one thread (``emulator_process``)."""

    @abc.abstractmethod
    def files(self) -> list[int]:
        """Returns the files at which the system's next question may arrive."""

    @abc.abstractmethod
    def serve(self, file: int, now: float) -> None:
        """Answers the question that has arrived at a file."""

    @abc.abstractmethod
    def settle(self, now: float) -> float | None:
        """Hands over what the device has to say.

        Returns:
            When to call again at the latest, in s; None: only after the next question.
        """

    @abc.abstractmethod
    def unplug(self) -> None:
        """Pulls the device out; ``files`` then names only those whose clients must be told so."""
