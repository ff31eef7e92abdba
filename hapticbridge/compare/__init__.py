"""Comparison of two recorded runs.

Read ``compare`` first; its result is a ``comparison``.
"""

from hapticbridge.compare.compare import compare as compare
from hapticbridge.compare.comparison import Comparison as Comparison
from hapticbridge.compare.comparison import Difference as Difference
