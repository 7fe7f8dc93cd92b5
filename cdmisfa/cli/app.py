"""The `cdmisfa` command group: its table of commands, its help page, and its exit codes.

Each command imports the library inside its function, so that no help page waits for numpy, PyBullet
or Rerun.
"""

from __future__ import annotations

import contextlib
import difflib
import gc
import importlib
import io
import os
import sys
import traceback
from collections.abc import Sequence
from typing import NoReturn

import click

from cdmisfa.cli.options import quiet
from cdmisfa.cli.printing import Stderr, line
from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.interrupts import exit_on_signals, ignore_signals_at_exit, interruptible

# Commands by their heading on the help page.
HEADINGS = {
    "Learn": "record learn apply fork sweep demo reproduce",
    "Look at runs and check them": "view report compare check inspect signals",
    "Logs and this machine": "info convert verify recover export index episodes doctor",
}

# Commands by their module in `cdmisfa.cli.commands`.
MODULES = {
    "apply": "apply",
    "doctor": "doctor",
    "episodes": "episodes",
    "export": "export",
    "learn": "learn fork",
    "logs": "info verify recover index",
    "record": "record convert",
    "runs": "compare check inspect signals",
    "trials": "sweep demo reproduce",
    "view": "view report",
}

COMMANDS = " ".join(HEADINGS.values()).split()


class LazyGroup(click.Group):
    """A group that imports the module of a command when the command runs."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the help page."""
        return COMMANDS

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command."""
        if cmd_name not in COMMANDS:
            return None
        name = next(name for name, names in MODULES.items() if cmd_name in names.split())
        module = importlib.import_module(f"cdmisfa.cli.commands.{name}")
        command: click.Command = getattr(module, f"{cmd_name}_command")
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the arguments name, or suggest a similar name."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            from cdmisfa.core.errors import did_you_mean

            ctx.fail(f"no command {args[0]!r}: {did_you_mean(args[0], COMMANDS)}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands below their headings."""
        width = max(map(len, COMMANDS))  # so that the columns of all headings align
        for heading, names in HEADINGS.items():
            with formatter.section(heading):
                commands = filter(None, (self.get_command(ctx, name) for name in names.split()))
                rows = [(f"{c.name:{width}}", (c.help or "").partition("\n")[0]) for c in commands]
                formatter.write_dl(rows)


@click.group(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 success, 1 failure, 2 wrong usage, 3 damaged log, 4 differs.",
)
@quiet
@click.version_option(package_name="cdmisfa", message="cdmisfa %(version)s")
def cli() -> None:
    """Learn slow features from cameras and robot logs, without labels.

    Slow features are the functions of the input that change most slowly, such as where an object
    is, how a joint is turned, or how bright the room is.
    """


def run_process() -> NoReturn:
    """Run the command line of this process."""
    # Imports create many objects and free none. With Python's threshold of 700, collecting garbage
    # took a seventh of the time of a short command.
    gc.set_threshold(10_000)
    _open_standard_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may lack Greek letters
        sys.stdout.reconfigure(errors="replace")
    ignore_signals_at_exit()
    code = run(sys.argv[1:])
    exit_on_signals(code)
    # CPython remembers an interrupt during an exec, as in imports, until the next exec. Without
    # this one, `python -m cdmisfa` would end by SIGINT, whatever the code.
    exec("")
    sys.exit(code)


def _open_standard_streams() -> None:
    """Open closed standard streams on /dev/null, or the next file would get their number."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            # the lowest free descriptor is this one, so it is opened again under its own number
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


def run(args: Sequence[str]) -> int:
    """Run one command and return its exit code; raise nothing."""
    Stderr.quiet = False
    with interruptible() as stop:
        try:
            try:
                # without standalone mode, Context.exit(code) comes back as the value
                code = cli.main(args=list(args), prog_name="cdmisfa", standalone_mode=False)
                sys.stdout.flush()
            finally:
                stop.ended = True
        except (click.Abort, KeyboardInterrupt) as error:
            remedy = str(error.__cause__ or error)  # click puts an Abort around an interrupt
            return _fail(f"interrupted{': ' if remedy else ''}{remedy}", stop.exit_code)
        except BrokenPipeError:
            # keeps the interpreter from flushing into the closed pipe when it ends
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except SystemExit as end:
            return end.code if isinstance(end.code, int) else 1
        except Exception as error:
            if _was_interrupt(error):
                return _fail("interrupted", stop.exit_code)
            return _explain(error)
    return code if isinstance(code, int) else 0


def _was_interrupt(error: BaseException | None) -> bool:
    """Return whether an interrupt caused an error; Python 3.11 wraps one in `__set_name__`."""
    if isinstance(error, CdmisfaError | OSError):  # errors of cleaning up are reported
        return False
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _explain(error: Exception) -> int:
    """Print an error in one line and return the exit code."""
    match error:
        case CdmisfaError():
            return _fail(str(error), error.exit_code)
        case click.exceptions.NoArgsIsHelpError():
            click.echo(error.format_message(), err=True)
            return error.exit_code
        case click.UsageError():
            if isinstance(error, click.NoSuchOption):  # click suggests options that differ a lot
                name, names = error.option_name, error.possibilities or ()
                near = difflib.get_close_matches(name, names, 1, 0.8)
                error = click.NoSuchOption(name, possibilities=near, ctx=error.ctx)
            command = error.ctx.command_path if error.ctx else "cdmisfa"
            message = error.format_message().rstrip(".")
            message = message[:1].lower() + message[1:]
            return _fail(f"{message} (see {command} --help)", error.exit_code)
        case OSError():
            where = f"{error.filename}: " if error.filename else ""
            return _fail(f"{where}{error.strerror or error}", 1)
        case ImportError():  # of a damaged installation
            return _fail(f"needs the package {error.name} (pip install {error.name})", 2)
        case MemoryError():
            return _fail("out of memory", 1)
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{os.path.basename(frame.filename)}:{frame.lineno}"
    return _fail(f"unexpected {type(error).__name__} at {place}: {error} (please report it)", 1)


def _fail(message: str, code: int) -> int:
    line(f"cdmisfa: {' '.join(message.split())}", err=True)
    return code
