"""Description of a run in its recording, for audit and re-simulation.

``start`` captures the run's start, ``versions`` the software. ``description`` writes both into
metadata and attachments, and reads the run parameters back through ``metadata``.
"""

from hapticbridge.provenance.description import MODEL_ATTACHMENT as MODEL_ATTACHMENT
from hapticbridge.provenance.description import SOURCE_PREFIX as SOURCE_PREFIX
from hapticbridge.provenance.description import attachments as attachments
from hapticbridge.provenance.description import describe_run as describe_run
from hapticbridge.provenance.description import parameters_of as parameters_of
from hapticbridge.provenance.metadata import meta_float as meta_float
from hapticbridge.provenance.metadata import meta_start as meta_start
from hapticbridge.provenance.start import STARTS as STARTS
from hapticbridge.provenance.start import STATE_ATTACHMENT as STATE_ATTACHMENT
from hapticbridge.provenance.start import compiled_model as compiled_model
from hapticbridge.provenance.start import restore_state as restore_state
from hapticbridge.provenance.start import start_of as start_of
from hapticbridge.provenance.start import start_state as start_state
from hapticbridge.provenance.versions import processor as processor
from hapticbridge.provenance.versions import versions as versions
