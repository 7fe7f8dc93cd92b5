"""Options for other people's camera logs, and what is said of a source that was opened."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options

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
)


def say_about(source: FrameSource) -> None:
    """Say on stderr what the user should know of a source, and how images became frames."""
    for warning in getattr(source, "warnings", ()):
        click.echo(f"warning: {warning}", err=True)
    for name, shape in getattr(source, "shapes", {}).items():
        click.echo(f"{name}: {shape}", err=True)
    for name, counts in getattr(source, "alignment", {}).items():
        click.echo(
            f"{name}: {counts['messages']} images, "
            f"{counts['repeated']} frames repeated, {counts['dropped']} images dropped",
            err=True,
        )
