"""Sweeps: a function applied to many points on any executor, resumed from a folder of results."""

from hapticbridge.sweep.points import grid as grid
from hapticbridge.sweep.results import Interrupted as Interrupted
from hapticbridge.sweep.results import Table as Table
from hapticbridge.sweep.sweep import sweep as sweep
