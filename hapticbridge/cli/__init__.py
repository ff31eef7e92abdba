"""The command line: parses, calls, prints.

Read ``main`` first, which is in charge before anything heavy is imported, then ``dispatch``, then
``run``: a module per command, a dataclass whose fields are its flags.
``terminal`` is the one way to print; what a command says at length stands beside it (``run_words``,
``check_words``, ``judge_many`` …).
"""

from hapticbridge.cli.main import main as main
