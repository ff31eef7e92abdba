"""Command line: parses options, calls the library, prints results.

Read ``main`` first, the table of commands, then ``run``: one module per job, one dataclass per
command, whose fields are its options. ``terminal`` holds the consoles that all output goes through.
Long texts stand beside their command (``run_words``, ``check_words``, ``judge_many`` …).
"""

from hapticbridge.cli.main import main as main
