"""Export of a recording as a table: Parquet, CSV or HDF5.

Read ``export`` first; it writes a recording into a ``sink``: ``parquet``, ``csv_file`` or ``hdf5``.
"""

from hapticbridge.export.export import FORMATS as FORMATS
from hapticbridge.export.export import Exported as Exported
from hapticbridge.export.export import export as export
from hapticbridge.export.export import target_for as target_for
from hapticbridge.export.export import time_of as time_of
