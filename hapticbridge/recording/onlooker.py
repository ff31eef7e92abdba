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

        A reader must free nothing of the ring. ``snapshot`` names the shared memory with the
        scene's positions. Metadata and attachments are those of a recording.
        """

    def event(self, event: Mapping[str, object]) -> None:
        """Receives an event; must neither block nor raise."""

    def close(self) -> None:
        """Stops reading; must not raise."""
