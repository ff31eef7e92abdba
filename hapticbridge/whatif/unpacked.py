"""Scene files of a recording."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from hapticbridge.errors import RecordingError
from hapticbridge.provenance import SOURCE_PREFIX
from hapticbridge.recording import Recording


def unpack_scene(recording: Recording, folder: Path) -> Path:
    """Writes a recording's scene files to a folder; returns the main file.

    The folder is created if missing; nothing is written outside it.

    Raises:
        RecordingError: The recording carries no scene, or files that cannot be written there.
    """
    main: Path | None = None
    for name, data in recording.attachments.items():
        if not name.startswith(SOURCE_PREFIX):
            continue
        inner = PurePosixPath(name.removeprefix(SOURCE_PREFIX))
        # a foreign recording must not write outside the folder
        if inner.is_absolute() or ".." in inner.parts or "\\" in name or ":" in name:
            raise RecordingError(
                f"the attachment {name!r:.80} would lie outside the scene's folder"
            )
        path = folder / inner
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except (OSError, ValueError) as error:
            raise RecordingError(
                f"the attachment {name!r:.80} cannot be unpacked: {error}"
            ) from None
        main = main or path
    if main is None:
        raise RecordingError(f"{recording.path} carries no scene, so it cannot be simulated again")
    return main
