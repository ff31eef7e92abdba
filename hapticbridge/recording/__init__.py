"""Recordings: the file, the recorder process, and the shared ring.

Read ``format`` first, the definition of a recording. Records leave the loop through ``ring``,
events through a pipe. ``recorder`` is the loop's end of both, ``recorder_process`` the other;
``ring`` also holds the scene's newest positions for a viewer. ``writer`` writes a file, and a file
that was cut anew. ``reader`` reads one, whole or damaged, through ``container``.
"""

from typing import TYPE_CHECKING

from hapticbridge.lazy import lazy_exports

if TYPE_CHECKING:
    from hapticbridge.recording.format import Attachment as Attachment
    from hapticbridge.recording.reader import Recording as Recording
    from hapticbridge.recording.reader import RecordingFile as RecordingFile
    from hapticbridge.recording.reader import open_recording as open_recording
    from hapticbridge.recording.reader import read_recording as read_recording
    from hapticbridge.recording.recorder import Recorder as Recorder
    from hapticbridge.recording.ring import HEAD as HEAD
    from hapticbridge.recording.ring import TAIL as TAIL
    from hapticbridge.recording.ring import Ring as Ring
    from hapticbridge.recording.writer import RecordingWriter as RecordingWriter
    from hapticbridge.recording.writer import repair as repair
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
