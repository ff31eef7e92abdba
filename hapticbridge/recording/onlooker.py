"""Second reader of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from hapticbridge.recording.format import Attachment


class Onlooker(Protocol):
    """Optional second reader of the ring from another process, such as the live view.

    The loop never waits for it.
    """

    def start(
        self,
        ring: str,
        snapshot: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
    ) -> None:
        """Starts reading.

        Args:
            ring: Name of the ring for ``Ring.attach``; a reader must free nothing.
            snapshot: Name of the shared memory with the scene's positions.
            metadata: Metadata of the run, as in a recording.
            attachments: Attachments of the run, as in a recording.
        """

    def event(self, event: Mapping[str, object]) -> None:
        """Receives an event; must neither block nor raise."""

    def close(self) -> None:
        """Stops reading; must not raise."""
