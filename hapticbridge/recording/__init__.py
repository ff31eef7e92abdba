"""Recordings: the file, the process that writes it, and the ring before it."""

from hapticbridge.recording.format import Attachment as Attachment
from hapticbridge.recording.reader import Recording as Recording
from hapticbridge.recording.reader import RecordingFile as RecordingFile
from hapticbridge.recording.reader import open_recording as open_recording
from hapticbridge.recording.reader import read_recording as read_recording
from hapticbridge.recording.recorder import Recorder as Recorder
from hapticbridge.recording.recovery import repair as repair
from hapticbridge.recording.ring import HEAD as HEAD
from hapticbridge.recording.ring import TAIL as TAIL
from hapticbridge.recording.ring import Ring as Ring
from hapticbridge.recording.writer import RecordingWriter as RecordingWriter
