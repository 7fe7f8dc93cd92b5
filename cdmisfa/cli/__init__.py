"""The command line: a thin shell over the library."""

from collections.abc import Sequence
from typing import NoReturn


def main() -> NoReturn:
    """Run the command line of this process."""
    from cdmisfa.cli.interrupts import end_at_once

    end_at_once()  # while the rest is imported, too
    from cdmisfa.cli import app

    app.run_process()


def run(args: Sequence[str]) -> int:
    """Run one command and return its exit code; see `app.run`."""
    from cdmisfa.cli import app

    return app.run(args)
