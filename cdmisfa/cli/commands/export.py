"""`cdmisfa export`: signals, numbers, images and datasets for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options, printing

if TYPE_CHECKING:
    from replay.logs.source import LoggedSource


@options.command("export")
@options.log_argument("path")
@options.option("--to FORMAT", name="form")
@options.output("File or folder to write.", required=True)
@options.option("--lossless")
@options.option("--task TEXT")
@options.option("--state TOPIC[:FIELD]", multiple=True)
@options.option("--action TOPIC[:FIELD]", multiple=True)
@options.option("--color", type=click.Choice(["on", "off"]), default="on", show_default=True)
@options.inputs("topics", "fields", "rate", "size", "settings")
@options.force
@options.as_json
def export_command(
    path: tuple[Path, ...],
    form: str | None,
    output: Path,
    lossless: bool,
    color: str,
    as_json: bool,
    **arguments: Any,
) -> None:
    """Export signals or numbers as tables, or images and videos.

    The signals of a run (the values that the learner computed) go to one Parquet, CSV or NumPy
    file; CSV leaves out the outputs of single frames (y, y_frozen). The numbers of logs (--field)
    go to one Parquet or CSV file for each stream, with a row for each message: log_time (ns) and
    the fields. Recordings and logs go to a folder of PNG files, to one MP4 file for each stream,
    or to a LeRobot dataset v3.0, in which each log is an episode.

    PATH is one of:
        {run}
        {recording}
        {logs}
        {url}

    Options:
        --topic TOPIC: Read this topic of a log, or all that match a pattern such as '/cam*'; each
            becomes a stream. Repeatable. [default: all with images]
        --size WxH: Shrink images to this size. [default: their own]
        --color: Keep the colors of images, or write gray ones.
        --state TOPIC[:FIELD]: Numbers that become observation.state of a LeRobot dataset, from the
            message nearest to each frame. Repeatable. [default: JointState messages; other
            numbers become observation.TOPIC]
        --action TOPIC[:FIELD]: The same for action. [default: JointState messages on topics named
            action, command, target or similar]
        --to FORMAT: Format to write: parquet, csv, npz, images, mp4 or lerobot. [default: the
            ending of -o]
        --lossless: Encode videos without changing any pixel; they become larger.
        --task TEXT: Task that a LeRobot dataset names for its episodes. [default: as the log
            states]

    Examples:
        cdmisfa export runs/kitchen -o signals.parquet
        cdmisfa export monday.mcap tuesday.mcap --to lerobot --rate 30 -o dataset
        cdmisfa export take.mcap --to lerobot --state /joints --action /cmd:data -o d
    """
    from replay.export.formats import export
    from replay.export.tables import CSV_LEAVES_OUT, TABLES
    from replay.open_sources import holds_run

    form = form or output.suffix.removeprefix(".")
    warnings: list[str] = []

    def warn(text: str) -> None:
        if text not in warnings:  # several logs
            printing.warning(text)
            warnings.append(text)

    def about(source: LoggedSource) -> None:
        printing.source(source)
        warnings.extend(source.warnings)

    rows = export(
        path,
        output,
        form,
        lossless=lossless,
        about=about,
        warn=warn,
        color=color == "on",
        **arguments,
    )
    of_run = form in TABLES and holds_run(path[0])
    if form == "csv" and of_run:
        printing.status(f"CSV leaves out {' and '.join(CSV_LEAVES_OUT)}: Parquet and npz have them")
    videos = output.is_file() or next(output.rglob("*.mp4"), None) is not None
    if form in ("mp4", "lerobot") and videos and not lossless:
        printing.status("H.264 changes pixels a little: --lossless keeps every pixel")
    if as_json:
        printing.document(
            path=" ".join(map(str, path)), file=str(output), rows=rows, warnings=warnings
        )
        return
    unit = "iterations" if of_run else "messages" if form in TABLES else "frames"
    unit = "images" if form == "images" else unit
    printing.line(f"{rows} {unit} written to {output}")
