"""Help pages: the layout of a command's help, and the texts that several commands share."""

from __future__ import annotations

import inspect
import re
from typing import Any

import click
from click.formatting import wrap_text

# Kinds of inputs, by their names in braces in the docstrings of commands.
KINDS = {
    "scene": ("icub, oscillatory", "a simulated scene: a robot at a table, or numbers"),
    "recording": ("recordings/kitchen", "a recording: a folder that record or convert wrote"),
    "logs": (
        "left.mcap right.mcap",
        "logs: MCAP, ROS bag, video, folder of images, NumPy, CSV, Parquet or LeRobot; "
        "'logs/*.mcap' names several",
    ),
    "url": ("s3://lab/left.mcap", "a log at an s3://, http:// or https:// address"),
    "index": ("logs", "a folder that cdmisfa index has indexed: all its logs, one by one"),
    "live": (
        "camera:/dev/video0",
        "live streams; also rtsp://HOST/PATH, foxglove://HOST:PORT/TOPIC, gym:TASK, and "
        "av:ADDRESS for anything that FFmpeg opens",
    ),
    "run": ("runs/kitchen", "a run: a folder that learn or fork wrote"),
    "runs": ("runs", "a folder with several runs"),
    "log of run": ("s3://lab/run.mcap", "the log of a run, also at an http:// or https:// address"),
    "view": ("kitchen.rrd", "a view that view --save or compare --save wrote"),
}

# Columns of help pages, without the two of the outer indentation.
WIDTH = 76

# Width of the names of the inputs.
NAMES = 22

# Headings in the docstrings of commands.
OPTIONS, EXAMPLES = "\n\nOptions:\n", "\n\nExamples:\n"


class Command(click.Command):
    """A command whose docstring is its help page: purpose, inputs, options and examples.

    Attributes:
        examples: the example commands.
    """

    def __init__(self, name: str | None, *, help: str | None, **settings: Any) -> None:
        # python -OO removes docstrings: help is None then, and the page has only names
        text, _, examples = inspect.cleandoc(help or "").partition(EXAMPLES)
        text, _, entries = text.partition(OPTIONS)
        for spec, about in re.findall(r"^ {4}(--\S+).*?: (.*(?:\n {8}.*)*)", entries, re.MULTILINE):
            option = next(param for param in settings["params"] if spec in param.opts)
            option.help = " ".join(about.split())
        self.examples = [line.strip() for line in examples.splitlines()]
        super().__init__(name, help=laid_out(text), **settings)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples below a heading like that of the options."""
        with formatter.section("Examples"):
            for line in self.examples:
                formatter.write(f"{'':{formatter.current_indent}}{line}\n")


def laid_out(text: str) -> str:
    """Return a docstring as click prints it: `{kind}` replaced, and lists with their line ends."""
    text = text.replace("\n    ", "\n  ")
    text = re.sub(r"^  \{([\w ]+)\}$", _described, text, flags=re.MULTILINE)
    return "\n\n".join(f"\b\n{p}" if "\n  " in p else p for p in text.split("\n\n"))


def _described(match: re.Match[str]) -> str:
    """Return the lines of an entry of `KINDS`."""
    name, description = KINDS[match[1]]
    return wrap_text(
        f"{name:{NAMES}}{description}",
        WIDTH,
        initial_indent="  ",
        subsequent_indent=" " * (NAMES + 2),
    )
