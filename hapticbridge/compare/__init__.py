"""Where two recorded runs part."""

from hapticbridge.compare.compare import compare as compare
from hapticbridge.compare.comparison import Comparison as Comparison
from hapticbridge.compare.comparison import Difference as Difference
