"""Who may look at a run beside its recorder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from hapticbridge.recording.format import Attachment


class Onlooker(Protocol):
    """Looks at a run from another process; the loop neither waits for it nor asks it anything."""

    def start(
        self,
        ring: str,
        snapshot: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment],
    ) -> None:
        """Starts looking.

        Args:
            ring: Name of the ring, as ``Ring.attach`` takes it; what attaches must free nothing.
            snapshot: Name of the scene's newest positions, as ``Snapshot.attach`` takes it.
            metadata: Of the run, as a recording has them.
            attachments: Likewise.
        """

    def event(self, event: Mapping[str, object]) -> None:
        """Takes an event; must neither wait nor raise."""

    def close(self) -> None:
        """Ends looking; must not raise."""
