"""The command line: it parses words, calls the library, and prints results."""

from collections.abc import Sequence
from typing import NoReturn


def main() -> NoReturn:
    """Run the command line of this process."""
    from cdmisfa.core.interrupts import exit_on_signals

    exit_on_signals()  # imports take long enough for a Ctrl-C
    from cdmisfa.cli import app

    app.run_process()


def run(args: Sequence[str]) -> int:
    """Run one command and return its exit code; see `app.run`."""
    from cdmisfa.cli import app

    return app.run(args)
