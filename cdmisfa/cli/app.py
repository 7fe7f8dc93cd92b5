"""The group of commands, and how every way out of them becomes an exit code.

A command's module is imported only when that command runs, and imports the library inside the
command, so that `--help` never waits for numpy, PyBullet or Rerun.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import importlib
import io
import os
import sys
import traceback
from collections.abc import Mapping, Sequence
from typing import NoReturn

import click

from cdmisfa.cli.interrupts import end_at_once, ignore_at_the_end, interruptible
from cdmisfa.cli.options import quiet
from cdmisfa.cli.printing import Stderr
from cdmisfa.core.errors import CdmisfaError, UsageError, did_you_mean
from cdmisfa.core.untrusted import printable
from replay.storage.location import with_urls

GROUPS: Mapping[str, Mapping[str, str]] = {
    "Record": {"record": "record", "convert": "record"},
    "Learn": {"learn": "learn", "fork": "moments", "sweep": "trials", "apply": "apply"},
    "Look": {
        "view": "view",
        "report": "report",
        "info": "info",
        "results": "trials",
        "signals": "logs",
    },
    "Compare and check": {"compare": "logs", "check": "moments", "at": "moments"},
    "Keep": {"verify": "logs", "recover": "logs", "export": "logs"},
    "Many logs": {"index": "corpus"},
    "Studies": {"reproduce": "trials", "demo": "trials"},
    "This machine": {"doctor": "doctor"},
}
"""Each command by its heading of --help, with its module in this package."""

COMMANDS = {name: module for group in GROUPS.values() for name, module in group.items()}
"""The same without headings."""

LONGEST_NAME = 255
"""Bytes of a file's name that file systems take."""

CREATED = 10_000
"""Objects after which Python collects garbage: imports create many and leave none, and with the
default of 700 collecting took a seventh of a short command's time."""


class LazyGroup(click.Group):
    """A group that imports a command's module only when the command is wanted."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order in which a user meets them."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the command."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"cdmisfa.cli.commands.{COMMANDS[cmd_name]}")
        command: click.Command = getattr(module, f"{cmd_name}_command")
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command, or name the nearest one."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            ctx.fail(f"no command {args[0]!r}: {did_you_mean(args[0], COMMANDS)}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands below their headings."""
        width = max(map(len, COMMANDS))  # one for all groups
        for heading, names in GROUPS.items():
            commands = {name: self.get_command(ctx, name) for name in names}
            with formatter.section(heading):
                formatter.write_dl(
                    [
                        (name.ljust(width), (command.help or "").partition("\n")[0])
                        for name, command in commands.items()
                        if command is not None
                    ]
                )


@click.group(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@quiet
@click.version_option(package_name="cdmisfa", message="cdmisfa %(version)s")
def cli() -> None:
    """Record what a curious robot sees, learn from it live or from the log, and look.

    cdmisfa COMMAND --help explains a command. Each that prints takes --json: one document on
    stdout, nothing else. An error is one line on stderr, with --json too. With -q it is all that
    is said there.

    Exit codes: 0 ok, 1 failed, 2 wrong usage, 3 log damaged or only partly recovered, 4 not
    reproduced or not the same, 130 interrupted (143 by SIGTERM, 129 when its terminal is closed).
    """


def main() -> NoReturn:
    """Run the command line of this process."""
    gc.set_threshold(CREATED)
    _open_standard_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may not know Greek letters
        sys.stdout.reconfigure(errors="replace")
    ignore_at_the_end()
    code = run(sys.argv[1:])
    end_at_once(code)
    # An interrupt inside of an exec, as imports have them, is remembered until the next one:
    # `python -m` would end by SIGINT, whatever the code.
    exec("")
    sys.exit(code)


def _open_standard_streams() -> None:
    """Open closed standard streams on /dev/null, or the next file would get their number."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            # the lowest free descriptor is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


def run(args: Sequence[str]) -> int:
    """Run one command and return its exit code; no exception but SystemExit's comes out."""
    Stderr.quiet = False
    with interruptible() as stop:
        try:
            try:
                _refuse_odd_names(args)
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
    """Whether an interrupt became this error; Python 3.11 makes one in `__set_name__` another."""
    if isinstance(error, CdmisfaError | OSError):  # what failed on the way out is said
        return False
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _refuse_odd_names(args: Sequence[str]) -> None:
    """Refuse arguments that are not UTF-8, before any work is done."""
    for arg in args:
        try:
            arg.encode()
        except UnicodeEncodeError:
            shown = os.fsencode(arg).decode(errors="backslashreplace")
            raise UsageError(f"{shown} is not UTF-8: give it another name") from None


def _explain(error: Exception) -> int:
    match error:
        case CdmisfaError():
            return _fail(str(error), error.exit_code)
        case click.exceptions.NoArgsIsHelpError():
            click.echo(error.format_message(), err=True)
            return error.exit_code
        case click.UsageError():
            command = error.ctx.command_path if error.ctx else "cdmisfa"
            message = error.format_message().rstrip(".")
            return _fail(f"{message} (see {command} --help)", error.exit_code)
        case click.ClickException():
            return _fail(error.format_message(), error.exit_code)
        case OSError(errno=errno.ENAMETOOLONG):
            path = os.fspath(error.filename)
            name = max(path.split(os.sep), key=len)
            what = "name" if len(os.fsencode(name)) > LONGEST_NAME else "path"
            long = name if what == "name" else path
            return _fail(f"{long[:20]}... has {len(long)} letters: choose a shorter {what}", 2)
        case OSError():
            where = f"{error.filename}: " if error.filename else ""
            return _fail(f"{where}{error.strerror or error}", 1)
        case MemoryError():
            return _fail("out of memory", 1)
        case _:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{os.path.basename(frame.filename)}:{frame.lineno}"
            return _fail(
                f"unexpected {type(error).__name__} at {place}: {error} (please report it)", 1
            )


def _fail(message: str, code: int) -> int:
    click.echo(printable(with_urls(f"cdmisfa: {' '.join(message.split())}")), err=True)
    return code
