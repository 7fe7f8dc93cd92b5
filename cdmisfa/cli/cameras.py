"""Options for cameras and other people's logs of them, and what is said of an opened source."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options
from cdmisfa.core.errors import UsageError

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.sources import Configuration
    from recorder.cameras.readers import OnLoss
    from recorder.cameras.words import LiveOptions
    from replay.camera_logs.options import CameraOptions


def _height_and_width(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[int, int] | None:
    if value is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", value)
    if found is None:
        raise click.BadParameter(f"{value!r} is no size: write WIDTHxHEIGHT, as 128x48", ctx, param)
    return int(found[2]), int(found[1])


size_option = click.option(
    "--size",
    callback=_height_and_width,
    metavar="WxH",
    help="Shrink camera images to this size; by default to what has their ratio of the sides "
    "and no more pixels than 128x48.",
)

fit_option = options.one_of(
    "--fit",
    ("crop", "pad", "stretch"),
    "Where images have another ratio of the sides than --size: cut two sides, put black "
    "at them, or change the ratio.",
)

rate_option = click.option(
    "--rate",
    type=click.FloatRange(1e-3, 1e6),
    metavar="HZ",
    help="Frames a second of cameras and logs; by default the first stream's.",
)


def _seconds(ctx: click.Context, param: click.Parameter, value: str | None) -> float | None:
    if value is None:
        return None
    found = re.fullmatch(r"(?:(?:(\d{1,4}):)?(\d{1,4}):)?(\d{1,9}(?:\.\d{1,9})?)", value, re.ASCII)
    if found is None:
        raise click.BadParameter(
            f"{value!r} is no time: write seconds, or MINUTES:SECONDS, as 1:30", ctx, param
        )
    hours, minutes, seconds = (float(part or 0) for part in found.groups())
    return hours * 3600 + minutes * 60 + seconds


def _near_and_far(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, float] | None:
    if value is None:
        return None
    number = r"(-?\d{1,9}(?:\.\d{1,9})?)"
    found = re.fullmatch(f"{number}:{number}", value, re.ASCII)
    if found is None or not float(found[1]) < float(found[2]):
        raise click.BadParameter(
            f"{value!r} is no range: write NEAR:FAR in metres, as 0.3:5, or LOW:HIGH of numbers, "
            "as -3.2:3.2",
            ctx,
            param,
        )
    return float(found[1]), float(found[2])


range_option = click.option(
    "--range",
    "depth",
    callback=_near_and_far,
    metavar="LOW:HIGH",
    help="Show distances of depth cameras, in metres, from black to white, as 0.3:5; keep numbers "
    "within, as -3.2:3.2.",
)

topic_option = click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="TOPIC",
    help="A topic of images in a log, one stream each, or a pattern of topics, such as "
    "'/cam*'; repeatable.",
)

field_option = click.option(
    "--field",
    "fields",
    multiple=True,
    metavar="FIELD",
    help="Take numbers instead of images: a field of a topic's messages, such as "
    "pose.position.x or ranges[0:100], or a column of a table; several are one vector.",
)

number_options = options.together(
    field_option,
    click.option(
        "--time",
        metavar="COLUMN",
        help="The column of a table's times: dates, or seconds; stamp:ns counts in ns, us or ms.",
    ),
)
"""Which numbers of logs and tables are taken."""

look_options = options.together(topic_option, number_options, rate_option, range_option)
"""What of camera logs is shown or exported."""

color_option = click.option(
    "--color",
    is_flag=True,
    help="Show red, green and blue beside one another, as a frame of three times the width.",
)

frame_options = options.together(
    color_option, size_option, fit_option, rate_option, range_option, field_option
)
"""How images of cameras, live or stored, become frames."""

log_options = options.together(
    topic_option,
    number_options,
    size_option,
    fit_option,
    click.option(
        "--align",
        type=click.Choice(["index", "time"]),
        help="Put camera streams that differ on one clock: the i-th image of each, or the "
        "last image at each time. By default they are refused.",
    ),
    rate_option,
    options.one_of(
        "--gaps",
        ("skip", "hold"),
        "Where a camera paused for more than ten of its steps: skip it, so that nothing is "
        "learned across, or hold the last image.",
    ),
    click.option(
        "--from",
        "start",
        callback=_seconds,
        default="0",
        metavar="TIME",
        help="Leave out images before this time of the log, in seconds or as MINUTES:SECONDS.",
    ),
    click.option(
        "--to", "stop", callback=_seconds, metavar="TIME", help="Leave out images from then on."
    ),
    range_option,
    color_option,
    options.one_of(
        "--stamp",
        ("log", "header"),
        "When a message is of: when it was logged, or the time in its header.",
    ),
)
"""What of camera logs becomes frames, and how."""

camera_options = options.together(
    log_options,
    click.option(
        "--dry-run",
        is_flag=True,
        help="Say what would be read from camera logs, and write nothing.",
    ),
)

live_options = options.together(
    options.seconds(
        "--hold",
        0.25,
        "How long a picture of a live stream stands for those that are missing; then it has a gap.",
        least=0,
    ),
    options.one_of(
        "--lost",
        ("reconnect", "wait", "end"),
        "What to do about a live stream that stalls or goes away.",
    ),
    options.seconds("--stall", 5.0, "A live stream without a picture for so long has stalled."),
)


def live_streams(hold: float, lost: OnLoss, stall: float, *, seed: int = 0) -> LiveOptions:
    """What `live_options` and a seed say."""
    from recorder.cameras.words import LiveOptions

    return LiveOptions(hold=hold, on_loss=lost, stall=stall, seed=seed)


def tell(line: str) -> None:
    """Say on stderr what became of a camera."""
    click.echo(line, err=True)


def warn(line: str) -> None:
    """Say on stderr what the user should know of a source."""
    tell(f"warning: {line}")


def say_counts(source: FrameSource) -> None:
    """Say on stderr what became of each live stream's pictures, or messages with numbers."""
    what = "pictures" if source.spec.images else "messages"
    for name, counts in getattr(source, "alignment", {}).items():
        tell(
            f"{name}: {counts['messages']} {what}; {counts['repeated']} frames repeated, "
            f"{counts['missing']} missing; {what}: {counts['dropped']} between frames, "
            f"{counts['late']} late, {counts['disordered']} out of order, {counts['lost']} thrown "
            "away"
        )


def say_about(source: FrameSource) -> None:
    """Say on stderr what the user should know of a source, and how images became frames."""
    for warning in getattr(source, "warnings", ()):
        warn(warning)
    for name, shape in getattr(source, "shapes", {}).items():
        if "," in shape:  # not the image itself
            click.echo(f"{name}: {shape}", err=True)
    what = "images" if source.spec.images else "messages"
    for name, counts in getattr(source, "alignment", {}).items():
        click.echo(
            f"{name}: {counts['messages']} {what}, "
            f"{counts['repeated']} frames repeated, {counts['dropped']} {what} dropped",
            err=True,
        )


def say_changes(source: FrameSource) -> None:
    """Say on stderr what showed while a source was read: changes of size, broken images."""
    changes = getattr(source, "changes", {}).values()  # only logs of others have these
    for line in (*changes, *getattr(source, "salvaged", list)()):
        warn(line)


def print_plan(source: FrameSource, *, as_json: bool) -> None:
    """Print what would be read: streams, sizes, rates, gaps and drops.

    Raises:
        UsageError: it is no camera log.
    """
    from replay.camera_logs.source import ForeignSource

    if not isinstance(source, ForeignSource):
        raise UsageError("--dry-run is for camera logs: cdmisfa info says what is in a recording")
    rows = source.plan()
    warnings = [*source.warnings, *source.changes.values()]
    if as_json:
        size = list(source.spec.frame_shape)
        plan = {"frames": source.frames, "rate": source.spec.fps, "size": size, "streams": rows}
        options.print_json({"schema": options.SCHEMA, **plan, "warnings": warnings})
        return
    what = "images" if source.spec.images else "messages"
    head = ("stream", what, "rate", "size", "missing", "gaps", "repeated", "dropped")
    cells = [
        (row["stream"], row["images"], "-" if row["rate"] is None else f"{row['rate']:.6g}",
         row["shape"], row["missing"], len(row["gaps"]), row["repeated"], row["dropped"])
        for row in rows
    ]  # fmt: skip
    options.print_table(head, cells)
    seconds = source.frames / source.spec.fps
    click.echo(f"{source.frames} frames at {source.spec.fps:g} a second, {seconds:.6g} s")
    unknown = [row["stream"] for row in rows if row["size_changes"] is None]
    if unknown:
        said = "whether images change their size shows when they are read"
        click.echo(f"{said}: {' '.join(unknown)}")
    for warning in warnings:
        warn(warning)


@contextlib.contextmanager
def live_source(
    words: Sequence[str],
    live: LiveOptions,
    cameras: CameraOptions,
    out: Path | None,
    record_to: Path | None,
    *,
    preset: str | None,
    settings: Sequence[str],
    fsync_every: float | None,
    force: bool,
) -> Iterator[tuple[FrameSource, Configuration]]:
    """Live streams to learn from, recorded meanwhile where that is asked for.

    Args:
        words: a stream each.
        live: what `live_options` say, and a seed.
        cameras: what `camera_options` say.
        out: folder of the run; looked at before the cameras are opened.
        record_to: folder of the recording.
        preset: as the option.
        settings: as the option --set.
        fsync_every: as the option.
        force: as the option.
    """
    from cdmisfa.experiments.sources import open_cameras_now
    from recorder.live import RecordedWhileWatched
    from recorder.log.files import refuse_existing

    for folder in (out, record_to):
        if folder is not None:
            refuse_existing(folder, force=force, goes_on=False)
    source, configuration = open_cameras_now(
        words, live, cameras=cameras, preset=preset, settings=settings, say=tell
    )
    with contextlib.closing(source):
        try:
            if record_to is None:
                yield source, configuration
                return
            recorded = RecordedWhileWatched(
                source,
                record_to,
                settings=configuration.record,
                fsync_every=fsync_every,
                force=force,
            )
            with recorded:
                yield recorded, configuration
            tell(f"recording {record_to}")
        finally:
            say_counts(source)
