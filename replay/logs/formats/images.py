"""Folders of PNG or JPEG files, in the order of their names, numbers by value."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Final

from cdmisfa.core.untrusted import check_regular, read_regular
from recorder.images.compressed import check_png, compressed_image
from recorder.images.options import InputOptions
from recorder.images.pixels import MalformedImage
from recorder.mcap.records import Problem
from replay.logs.formats.messages import check_topics
from replay.logs.stream import LogStream
from replay.storage.paths import natural_order

ENDINGS: Final = (".jpeg", ".jpg", ".png")

# Largest file that is read as an image.
MAX_IMAGE: Final = 64 * 1024 * 1024


def streams(
    path: Path, options: InputOptions, opened: ExitStack, *, skip_damaged: bool = False
) -> list[LogStream]:
    """Open the images of a folder as one stream, at any even rate."""
    topic = path.resolve().name
    check_topics(path, topic, options.topics)
    files = image_files(path)
    endings = {file.suffix.lower()[1:] for file in files}

    remark = f"{path}: JPEG has no checksums, so damaged pixels may be undetected"
    stream = LogStream(
        path=path,
        topic=topic,
        count=len(files),
        fetch=lambda row: read_regular(files[row], MAX_IMAGE),
        decode=partial(compressed_image, color=options.color is True),
        compressed=bytes,
        where=lambda row: str(files[row]),
        encoding=" ".join(sorted(endings)),
        remarks=[] if endings == {"png"} else [remark],
    )
    return [stream]


def image_files(path: Path) -> list[Path]:
    """List the images of a folder, each a regular file; others are refused."""
    files = [file for file in path.iterdir() if file.suffix.lower() in ENDINGS]
    for file in files:
        check_regular(file, MAX_IMAGE)
    return sorted(files, key=natural_order)


def broken_images(files: Sequence[Path], most: int) -> list[Problem] | None:
    """Check the checksums of PNG files, without decoding any.

    Args:
        files: the images.
        most: most bytes that are read.

    Returns:
        The broken ones; None if there are images without checksums, or more bytes.

    Raises:
        LogDamagedError: the disk does not give a file.
    """
    if sum(file.stat().st_size for file in files) > most:
        return None
    problems = []
    for file in files:
        try:
            if file.suffix.lower() != ".png" or not check_png(read_regular(file, MAX_IMAGE)):
                return None
        except MalformedImage as error:
            problems.append(Problem(str(file), str(error)))
    return problems
