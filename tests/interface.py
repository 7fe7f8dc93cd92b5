"""What others rely on, as one document: `python tests/interface.py` writes it anew.

docs/reference/stability.md says what may change, and how.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
from sources import PRODUCT

SNAPSHOT = Path(__file__).parent / "data" / "interface.json"

SHORT = ("--max-iterations", 3, "--no-rerun")

EASY = ("tau=40", "eta_dot_window=8", "warm_up=3", "delta=1", "min_variance=1e-6", "novel_share=0")
SOON = ("--no-rerun", *(word for key in EASY for word in ("--set", f"learner.{key}")))
"""A module is learned at once."""

SHOWN: Mapping[str, tuple[object, ...]] = {
    "record": ("oscillatory", "-o", "rec", "--frames", 600),
    "learn": ("rec", "--algorithm", "2.0", *SOON, "-o", "run"),
    "learn --algorithm progress": ("rec", "--algorithm", "progress", *SHORT, "-o", "progress"),
    "info": ("rec",),
    "verify": ("rec",),
    "recover": ("rec/x1.mcap", "-o", "saved.mcap"),
    "convert": ("sample_logs/icub", "-o", "converted"),
    "export": ("run", "-o", "signals.csv"),
    "compare": ("run", "run"),
    "inspect": ("run", "--iteration", 2),
    "check": ("run",),
    "fork": ("run", "--iteration", 2, *SHORT, "-o", "fork"),
    "apply": ("run", "rec", "-o", "applied.csv"),
    "report": ("run",),
    "signals": (),
    "sweep": ("oscillatory", "--seeds", "0:1", "--max-iterations", 2, "-o", "sweep"),
    "sweep --summary": ("sweep", "--summary"),
    "index": ("corpus",),
    "episodes": ("sample_logs/icub", "-o", "episodes"),
    "doctor": (),
}
"""Commands whose documents are looked at, with what they are given."""


def keys(value: Any, name: str = "") -> Iterator[str]:
    """The keys of a document, and those of the rows of its lists."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield f"{name}{key}"
            if isinstance(inner, list):
                yield from keys(inner, f"{name}{key}[].")
    elif isinstance(value, list) and name.count("[]") < 3:
        for each in value:
            yield from keys(each, name)


def documents() -> dict[str, list[str]]:
    """The keys of what commands print with --json, in a folder of their own."""
    from cdmisfa.cli import run

    result = {}
    logs = Path(__file__).parents[1] / "sample_logs"
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        Path("sample_logs").symlink_to(logs)
        for name, words in SHOWN.items():
            if name == "index":
                Path("corpus").mkdir()
                Path("rec").rename("corpus/rec")
            out = io.StringIO()
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()) as said:
                code = run([name.partition(" ")[0], *map(str, words), "--json"])
            if code:
                raise AssertionError(f"{name}: {said.getvalue()}")
            result[name] = sorted(set(keys(json.loads(out.getvalue()))))
    return result


def command_of(name: str) -> click.Command:
    """Return a command of the program."""
    from cdmisfa.cli.app import cli

    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    return command


def commands() -> dict[str, list[str]]:
    """Arguments and options of each command."""
    from cdmisfa.cli.app import COMMANDS

    result = {}
    for name in COMMANDS:
        command = command_of(name)
        result[name] = [
            p.human_readable_name for p in command.params if isinstance(p, click.Argument)
        ]
        options = [p for p in command.params if isinstance(p, click.Option)]
        result[name] += sorted(word for p in options for word in (*p.opts, *p.secondary_opts))
    return result


def names() -> dict[str, list[str]]:
    """What `cdmisfa` has: members of classes, arguments of functions."""
    import cdmisfa

    result = {}
    for name in dir(cdmisfa):
        if name.startswith("__"):
            continue
        thing = getattr(cdmisfa, name)
        if inspect.isclass(thing):
            ours = [kind for kind in thing.__mro__ if kind.__module__.split(".")[0] in PRODUCT]
            members = {member for kind in ours for member in vars(kind)}
            members |= {member for kind in ours for member in getattr(kind, "__annotations__", ())}
            result[name] = sorted(
                member for member in members if not member.startswith(("_", "set_"))
            )
        elif callable(thing):
            result[name] = list(inspect.signature(thing).parameters)
        else:
            result[name] = []
    return result


def configuration() -> list[str]:
    """The keys of `--set` and of presets."""
    from cdmisfa.agents.learners import LEARNERS
    from recorder.config import RecordConfig
    from recorder.world.scenes import SCENES

    sections = {("record", RecordConfig)}
    sections |= {("learner", entry.configuration) for entry in LEARNERS.values()}
    sections |= {("scene", entry.config) for entry in SCENES.values()}
    return sorted({f"{name}.{field.name}" for name, kind in sections for field in fields(kind)})


def formats() -> dict[str, int]:
    """Versions of what is on disk and printed."""
    from cdmisfa.cli import printing
    from cdmisfa.core import signals
    from cdmisfa.kernels import ARITHMETIC
    from recorder.log import messages
    from replay.corpus import index_rows
    from replay.integrity import report

    return {
        "arithmetic": ARITHMETIC,
        "index of logs": index_rows.VERSION,
        "JSON documents": printing.SCHEMA,
        "JSON of info, verify and recover": report.SCHEMA,
        "recordings": messages.SCHEMA_VERSION,
        "signals": signals.SCHEMA_VERSION,
    }


def codes() -> dict[str, int]:
    """The exit codes of errors."""
    from cdmisfa.core import errors

    kinds = vars(errors).values()
    result = [k for k in kinds if inspect.isclass(k) and issubclass(k, errors.CdmisfaError)]
    return {kind.__name__: kind.exit_code for kind in result}


def interface() -> dict[str, Any]:
    """All of it."""
    from cdmisfa.core.signals import SIGNALS

    return {
        "commands": commands(),
        "keys of --json": documents(),
        "exit codes": codes(),
        "formats": formats(),
        "configuration": configuration(),
        "signals": list(SIGNALS),
        "names of cdmisfa": names(),
    }


if __name__ == "__main__":
    SNAPSHOT.write_text(json.dumps(interface(), indent=1) + "\n", encoding="utf-8")
