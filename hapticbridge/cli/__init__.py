"""Command line: parses options, calls the library, prints results.

Read ``main`` first, the table of commands, then ``run``. Each command is one module and one
dataclass whose fields are its options. ``terminal`` holds the consoles for all output.
"""

from hapticbridge.cli.main import main as main
