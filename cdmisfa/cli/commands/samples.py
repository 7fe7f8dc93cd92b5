"""`cdmisfa samples`: logs to try everything with."""

from __future__ import annotations

from pathlib import Path

import click

from cdmisfa.cli import options
from cdmisfa.cli.making import word
from cdmisfa.cli.printing import print_document, print_table
from cdmisfa.cli.progress import bar


@click.command("samples")
@options.out("Folder to write all samples to; by default they are listed.")
@word("--url", "ADDRESS", "Where the attachments of the release are, if not where it says.")
@options.server_limits
@options.as_json
def samples_command(out: Path | None, url: str | None, as_json: bool) -> None:
    """Say where the sample logs are, or write them to a folder.

    The oscillatory streams come with every installation. The iCub's pictures are fetched from the
    attachments of the release, and checked by their SHA-256.
    """
    from cdmisfa.studies.samples import gather, logs, samples_here

    if out is not None:
        with bar("samples", "logs") as shown:
            gather(out, url, shown.update)
    folder, known = out or samples_here(), logs()
    names = list(dict.fromkeys(name.partition("/")[0] for name in known))
    there = {name: (folder / name).is_dir() for name in names}
    sizes = {n: sum(log.size for at, log in known.items() if at.startswith(f"{n}/")) for n in names}
    if as_json:
        paths = [folder / n if there[n] else None for n in names]
        told = zip(names, paths, strict=True)
        print_document(samples=[{"name": n, "bytes": sizes[n], "path": path} for n, path in told])
        return
    missing = "not here: cdmisfa samples -o sample_logs"
    rows = [(n, f"{sizes[n]:,}", folder / n if there[n] else missing) for n in names]
    print_table(("sample", "bytes", "where"), rows)
