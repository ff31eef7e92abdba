"""Studies: theory and runs, swept, drawn and written down."""

from hapticbridge.study.points import grid as grid
from hapticbridge.study.sweep import sweep as sweep
from hapticbridge.study.table import Table as Table
