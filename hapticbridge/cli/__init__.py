"""The command line: parses, calls, prints."""

from hapticbridge.cli.main import main as main
