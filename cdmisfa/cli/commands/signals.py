"""`cdmisfa signals`: the table of everything a run records."""

from __future__ import annotations

import dataclasses
from typing import Any

import click

from cdmisfa.cli import options


@click.command("signals")
@click.option("--markdown", is_flag=True, help="Print the page docs/signals.md.")
@options.as_json
def signals_command(markdown: bool, as_json: bool) -> None:
    """List every signal that a run records."""
    from cdmisfa.core.signals import SCHEMA_VERSION, SIGNALS

    signals = [dataclasses.asdict(signal) for signal in SIGNALS.values()]
    if as_json:
        options.print_json(
            {"schema": options.SCHEMA, "signals_version": SCHEMA_VERSION, "signals": signals}
        )
        return
    columns = ("name", "symbol", "equation", "unit", "dims", "dtype", "show", "since", "about")
    rows = [[signal[column] for column in columns] for signal in signals]
    if markdown:
        click.echo(_page(SCHEMA_VERSION, columns, rows))
    else:
        options.print_table(columns, rows)


def _page(version: int, columns: tuple[str, ...], rows: list[list[Any]]) -> str:
    def line(cells: list[Any]) -> str:
        return "| " + " | ".join(str(cell).replace("|", r"\|") for cell in cells) + " |"

    return "\n".join(
        [
            "# Signals",
            "",
            "Made by `cdmisfa signals --markdown`; a test fails when page and code differ.",
            f"Version {version} of the record. One record is one iteration, that is one block of",
            "T = `learner.tau` frames. A signal that does not exist in an iteration is NaN.",
            "",
            "Letters of `dims`: T frames of the block, J outputs of an abstraction, M frozen",
            "modules, S streams, A actions (stay, switch); nothing is a scalar. `equation` is the",
            "paper's number. `show` is how the viewer shows it. `since` is the first version of",
            "the record with it: in a run of an older one it is NaN.",
            "",
            line(list(columns)),
            line(["---"] * len(columns)),
            *(line([f"`{row[0]}`", *row[1:]]) for row in rows),
        ]
    )
