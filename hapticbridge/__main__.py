"""``python -m hapticbridge``, the same as the command ``hapticbridge``."""

import sys

from hapticbridge.cli import main

sys.exit(main())
