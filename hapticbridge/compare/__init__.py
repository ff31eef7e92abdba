"""Where two recorded runs part.

Read ``compare`` first; what it finds is a ``comparison``.
"""

from hapticbridge.compare.compare import compare as compare
from hapticbridge.compare.comparison import Comparison as Comparison
from hapticbridge.compare.comparison import Difference as Difference
