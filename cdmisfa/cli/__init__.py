"""The command line: a thin shell over the library."""

from cdmisfa.cli.app import main, run

__all__ = ["main", "run"]
