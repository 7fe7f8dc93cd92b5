"""`cdmisfa reproduce`: the experiments of the paper."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.making import option
from cdmisfa.cli.printing import SCHEMA, print_json
from cdmisfa.cli.progress import bar

if TYPE_CHECKING:
    from cdmisfa.studies.paper.experiment import Request


@click.command("reproduce")
@click.argument("name", required=False)
@options.out("Folder of the results [default: reproduction].")
@option(
    "--trials", type=click.IntRange(1), help="Trials per condition, instead of the paper's number."
)
@options.jobs
@options.engine
@option("--recording", type=click.Path(path_type=Path), help="Recording of the iCub scene.")
@option("--quick", is_flag=True, help="Few trials, enough to test the claim.")
@option("--page", type=options.OUT, help="Write this Markdown page of all results.")
@option("--force", is_flag=True, help="Replace results of more or other trials.")
@options.as_json
def reproduce_command(
    name: str | None,
    out: Path | None,
    trials: int | None,
    jobs: int,
    engine: str,
    scheduler: str | None,
    recording: Path | None,
    quick: bool,
    page: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Reproduce an experiment of the paper: numbers, tables and figures.

    NAME is oscillatory, five, stability, costs, nonstationary, icub, difficulty or all.
    Finished trials are kept and not run again; results of more or other trials than are asked
    for now are not replaced without --force. Exit code 4 says that a claim of the paper did
    not come out. Without NAME, --page makes the page from the results that are there.
    """
    from cdmisfa.core.errors import UsageError
    from cdmisfa.studies.paper.experiment import Request
    from cdmisfa.studies.paper.reproduce import EXPERIMENTS, check_claims, write_paper_page

    root = out or Path("reproduction")
    if name is None and page is None:
        raise UsageError(f"say which experiment: {', '.join(EXPERIMENTS)} or all")
    names = tuple(EXPERIMENTS) if name == "all" else (name,) if name else ()
    documents: list[dict[str, Any]] = []
    for each in names:
        if each == "icub" and recording is None:
            click.echo(f"icub: records the scene into {root}/icub-recording first", err=True)
        request = Request(trials, quick, recording, root / each, jobs, force)
        documents.append(_reproduce(each, request, engine=engine, scheduler=scheduler))
    if page is not None:
        write_paper_page(root, page)
        click.echo(f"page {page}", err=True)
    if as_json:
        print_json({"schema": SCHEMA, "experiments": documents})
    else:
        sys.stdout.write(_words(documents))
    for document in documents:
        check_claims(document)


def _reproduce(
    name: str, request: Request, *, engine: str, scheduler: str | None
) -> dict[str, Any]:
    """Reproduce an experiment, and say on stderr how it went."""
    from cdmisfa.studies.paper.reproduce import reproduce

    started, finished = time.monotonic(), list[int]()
    with bar(name, "trials") as shown:

        def progress(done: int, total: int) -> None:
            finished.append(done)
            shown.update(done, total)

        document = reproduce(name, request, engine=engine, scheduler=scheduler, progress=progress)
    seconds, ran = time.monotonic() - started, finished[-1] - finished[0]
    click.echo(
        f"{name}: {document['trials']} trials, {ran} of them now, {seconds:.1f} s, "
        f"{ran / seconds:.1f} trials/s, "
        f"{'reproduced' if document['reproduced'] else 'NOT reproduced'}",
        err=True,
    )
    return document


def _words(documents: list[dict[str, Any]]) -> str:
    from cdmisfa.studies.paper.reproduce import markdown_table

    parts = []
    for document in documents:
        claims = [
            f"{'yes' if c['holds'] else 'NO '}  {c['claim']}: {c['detail']}"
            for c in document["claims"]
        ]
        parts += [document["title"], "", markdown_table(document["table"]), *claims, ""]
    return "\n".join(parts)
