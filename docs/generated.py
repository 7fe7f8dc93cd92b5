"""Tables and help texts of the reference pages, made from the code while the site is built.

A line `{{ name argument }}` of a page is replaced by what the function `name` of `TABLES` returns.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import click

from cdmisfa.cli.app import HEADINGS, cli
from cdmisfa.core import errors, interrupts
from cdmisfa.core.signals import SIGNALS
from cdmisfa.experiments.documents import markdown

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"

# Columns of a help text, so that it fits beside the sidebars.
WIDTH = 90

# Commands that have an option with the same help, from which the option is described once.
SHARED = 4


def replaced(text: str) -> str:
    """Return a page with its lines `{{ name argument }}` replaced."""
    return re.sub(
        r"^\{\{ (\w+) ?(.*) \}\}$",
        lambda match: TABLES[match[1]](*match[2].split()),
        text,
        flags=re.MULTILINE,
    )


def keys(name: str) -> str:
    """Return the keys of a section: the fields of its dataclass, their defaults and meanings."""
    module, _, of = name.rpartition(".")
    section = getattr(importlib.import_module(module), of)
    return markdown(["key", "default", "meaning"], list(_keys("", section())))


def _keys(prefix: str, section: Any) -> Iterator[list[str]]:
    texts = "\n".join(inspect.getdoc(each) or "" for each in reversed(type(section).__mro__))
    for field in dataclasses.fields(section):
        value, key = getattr(section, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            yield from _keys(f"{key}.", value)
            continue
        meaning = re.findall(rf"^    {field.name}: (.*(?:\n {{8}}.*)*)", texts, re.MULTILINE)[-1]
        default = "auto" if value is None else json.dumps(value).strip('"')
        yield [f"`{key}`", f"`{default}`", " ".join(meaning.split())]


def exit_codes() -> str:
    """Return the table of exit codes: success, the errors of the library, and signals."""
    kinds = [errors.CdmisfaError, *errors.CdmisfaError.__subclasses__()]
    kinds = [kind for kind in kinds if kind.__module__ == errors.__name__]
    rows = [("0", "Success.")]
    rows += sorted((str(e.exit_code), (e.__doc__ or "").partition("\n")[0]) for e in kinds)
    rows += [(str(128 + s), f"Ended by the signal {s.name}.") for s in interrupts.SIGNALS]
    return markdown(["code", "meaning"], rows)


def signals() -> str:
    """Return the table of the signals that every run records."""
    columns = ("name", "about", "symbol", "unit", "dims", "equation")
    rows = [[getattr(signal, column) for column in columns] for signal in SIGNALS.values()]
    return markdown(columns, [[f"`{name}`", *cells] for name, *cells in rows])


def constants() -> str:
    """Return the table of the learner's constants, with the results at half and twice the value."""
    document = json.loads((RESULTS / "constants.json").read_text("utf-8"))
    rows = []
    for name, value, about, origin, *results in document["tables"][0]["rows"]:
        short = f"`{name.rpartition('.')[2]}`" if value else name
        meaning = f"{about}; {origin}" if about else ""
        rows.append([short, value, meaning, *(result.replace(": ", ":<br>") for result in results)])
    return markdown(["constant", "value", "meaning; origin", "half", "twice"], rows)


def commands() -> str:
    """Return the help of every command below its heading, shared options once at the top."""
    root = click.Context(cli, info_name="cdmisfa")
    contexts = {
        name: click.Context(command, parent=root, info_name=name)
        for name in cli.list_commands(root)
        if (command := cli.get_command(root, name))
    }
    records = [record for context in contexts.values() for record in _options(context)]
    shared = {record for record, count in Counter(records).items() if count >= SHARED}
    first = sorted(shared, key=records.index)
    formatter = click.HelpFormatter(width=WIDTH)
    formatter.write_dl(first)
    parts = ["## Options of several commands", _console(formatter)]
    for heading, names in HEADINGS.items():
        parts.append(f"## {heading}")
        for name in names.split():
            parts += [f"### cdmisfa {name}", _console(_help(contexts[name], shared))]
    return "\n\n".join(parts)


def _options(context: click.Context) -> list[tuple[str, str]]:
    """Return names and help of the options of a command."""
    parameters = context.command.get_params(context)
    return [r for p in parameters if (r := p.get_help_record(context)) and r[0].startswith("-")]


def _help(context: click.Context, shared: set[tuple[str, str]]) -> click.HelpFormatter:
    """Return the help of a command, with the names alone of options that are shared."""
    formatter = click.HelpFormatter(width=WIDTH)
    context.command.format_usage(context, formatter)
    context.command.format_help_text(context, formatter)
    options = _options(context)
    if own := [record for record in options if record not in shared]:
        with formatter.section("Options"):
            formatter.write_dl(own)
    names = [re.findall(r"--[\w-]+", record[0])[0] for record in options if record in shared]
    formatter.write_paragraph()
    with formatter.indentation():
        formatter.write_text(f"Also: {', '.join(names)}")
    return formatter


def _console(formatter: click.HelpFormatter) -> str:
    return f"```text\n{formatter.getvalue().rstrip()}\n```"


TABLES: dict[str, Callable[..., str]] = {
    "keys": keys,
    "exit_codes": exit_codes,
    "signals": signals,
    "constants": constants,
    "commands": cache(commands),
}
