"""Recordings: the file, the recorder process, and the shared ring.

Read ``format`` first. Records leave the loop through ``ring`` (``ring_memory``), events through a
pipe. ``stream`` is the loop's end of both; ``recorder`` and ``recorder_process`` are the other end,
and an ``onlooker`` is an optional second reader. ``writer`` writes a file on top of ``output`` and
``chunk_index``. ``reader`` reads one, whole or damaged, through ``file_bytes``, ``container``,
``fields`` and ``contents``. ``recovery`` and ``salvage`` repair cut files; ``run_time`` computes
due times.
"""

from hapticbridge.recording.format import Attachment as Attachment
from hapticbridge.recording.format import Timeline as Timeline
from hapticbridge.recording.format import due_times as due_times
from hapticbridge.recording.reader import Recording as Recording
from hapticbridge.recording.reader import RecordingFile as RecordingFile
from hapticbridge.recording.reader import open_recording as open_recording
from hapticbridge.recording.reader import read_recording as read_recording
from hapticbridge.recording.recorder import Recorder as Recorder
from hapticbridge.recording.repair import repair as repair
from hapticbridge.recording.ring import HEAD as HEAD
from hapticbridge.recording.ring import TAIL as TAIL
from hapticbridge.recording.ring import Ring as Ring
from hapticbridge.recording.writer import RecordingWriter as RecordingWriter
