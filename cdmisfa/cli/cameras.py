"""Options for other people's camera logs, and what is said of a source that was opened."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options
from cdmisfa.core.errors import UsageError

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource


def _height_and_width(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[int, int] | None:
    if value is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", value)
    if found is None:
        raise click.BadParameter(f"{value!r} is no size: write WIDTHxHEIGHT, as 128x48", ctx, param)
    return int(found[2]), int(found[1])


rate_option = click.option(
    "--rate",
    type=click.FloatRange(1e-3, 1e6),
    metavar="HZ",
    help="Frames a second of camera logs; by default the first stream's.",
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
    found = re.fullmatch(r"(\d{1,6}(?:\.\d{1,6})?):(\d{1,6}(?:\.\d{1,6})?)", value, re.ASCII)
    if found is None or not float(found[1]) < float(found[2]):
        raise click.BadParameter(
            f"{value!r} is no range: write NEAR:FAR in metres, as 0.3:5", ctx, param
        )
    return float(found[1]), float(found[2])


camera_options = options.together(
    click.option(
        "--topic",
        "topics",
        multiple=True,
        metavar="TOPIC",
        help="A topic of images in a log, one stream each, or a pattern of topics, such as "
        "'/cam*'; repeatable.",
    ),
    click.option(
        "--size",
        callback=_height_and_width,
        metavar="WxH",
        help="Shrink camera images to this size; by default to what has their ratio of the sides "
        "and no more pixels than 128x48.",
    ),
    click.option(
        "--fit",
        type=click.Choice(["crop", "pad", "stretch"]),
        default="crop",
        show_default=True,
        help="Where images have another ratio of the sides than --size: cut two sides, put black "
        "at them, or change the ratio.",
    ),
    click.option(
        "--align",
        type=click.Choice(["index", "time"]),
        help="Put camera streams that differ on one clock: the i-th image of each, or the "
        "last image at each time. By default they are refused.",
    ),
    rate_option,
    click.option(
        "--gaps",
        type=click.Choice(["skip", "hold"]),
        default="skip",
        show_default=True,
        help="Where a camera paused for more than ten of its steps: skip it, so that nothing is "
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
    click.option(
        "--range",
        "depth",
        callback=_near_and_far,
        metavar="NEAR:FAR",
        help="Show distances of depth cameras, in metres, from black to white.",
    ),
    click.option(
        "--dry-run",
        is_flag=True,
        help="Say what would be read from camera logs, and write nothing.",
    ),
)


def say_about(source: FrameSource) -> None:
    """Say on stderr what the user should know of a source, and how images became frames."""
    for warning in getattr(source, "warnings", ()):
        click.echo(f"warning: {warning}", err=True)
    for name, shape in getattr(source, "shapes", {}).items():
        if "," in shape:  # not the image itself
            click.echo(f"{name}: {shape}", err=True)
    for name, counts in getattr(source, "alignment", {}).items():
        click.echo(
            f"{name}: {counts['messages']} images, "
            f"{counts['repeated']} frames repeated, {counts['dropped']} images dropped",
            err=True,
        )


def say_changes(source: FrameSource) -> None:
    """Say on stderr which streams changed the size of their images while they were read."""
    for line in getattr(source, "changes", {}).values():
        click.echo(f"warning: {line}", err=True)


def print_plan(source: FrameSource, *, as_json: bool) -> None:
    """Print what would be read: streams, sizes, rates, gaps and drops.

    Raises:
        UsageError: it is no camera log.
    """
    from replay.camera_logs.source import ForeignSource

    if not isinstance(source, ForeignSource):
        raise UsageError("--dry-run is for camera logs: cdmisfa info says what is in a recording")
    rows = source.plan()
    if as_json:
        size = list(source.spec.frame_shape)
        plan = {"frames": source.frames, "rate": source.spec.fps, "size": size, "streams": rows}
        options.print_json({"schema": options.SCHEMA, **plan, "warnings": source.warnings})
        return
    head = ("stream", "images", "rate", "size", "missing", "gaps", "repeated", "dropped")
    cells = [
        (row["stream"], row["images"], "-" if row["rate"] is None else f"{row['rate']:.6g}",
         row["shape"], row["missing"], len(row["gaps"]), row["repeated"], row["dropped"])
        for row in rows
    ]  # fmt: skip
    options.print_table(head, cells)
    seconds = source.frames / source.spec.fps
    click.echo(f"{source.frames} frames at {source.spec.fps:g} a second, {seconds:.6g} s")
    for warning in source.warnings:
        click.echo(f"warning: {warning}", err=True)
