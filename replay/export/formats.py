"""Export of a run's signals, or of the frames of logs, in one of several formats."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import UsageError, did_you_mean
from recorder.images.options import Align, InputOptions
from recorder.log.files import atomic_write, refuse_existing, refuse_taken
from replay.export.frames import write_images, write_video, write_videos
from replay.export.lerobot import DatasetOptions, write_dataset
from replay.export.numbers import log_topics
from replay.export.tables import NUMBERS, TABLES, topics_of, write_streams
from replay.logs.formats.views import SeveralRecordingsError
from replay.logs.open_logs import ALL, image_logs, log_format
from replay.logs.source import LoggedSource
from replay.open_sources import Announce, holds_run, is_recording, open_for_viewing

# Formats of the signals of a run, and formats of frames.
FORMS: Final = (*TABLES, "images", "mp4", "lerobot")

# Endings of exported files: `force` replaces a folder only if it holds no others.
WRITTEN: Final = frozenset({".png", ".mp4", ".parquet", ".csv", ".json", ".md"})


def export(
    path: Path | Sequence[Path],
    out: Path,
    form: str,
    *,
    force: bool = False,
    lossless: bool = False,
    inputs: InputOptions | None = None,
    task: str | None = None,
    state: Sequence[str] = (),
    action: Sequence[str] = (),
    color: bool = True,
    about: Announce = lambda source: None,
    warn: Callable[[str], None] = lambda line: None,
) -> int:
    """Write a run's signals, or the frames or numbers of logs, in another form.

    Args:
        path: a run, or logs of numbers, for a table; a recording or logs for the other forms.
            Several recordings, or logs that share topics, become episodes of one LeRobot dataset.
        out: file of a table or of the video of one stream, *.mp4; folder of the other forms, and
            for the tables or videos of several streams.
        form: one of `FORMS`.
        force: replace an existing file, or an earlier export in a folder.
        lossless: keep every value of images in a video.
        inputs: options of logs; by default all streams of images.
        task: description of the task of a LeRobot dataset; by default that of the log.
        state: numbers that become `observation.state` of a LeRobot dataset; see `DatasetOptions`.
        action: numbers that become its `action`.
        color: keep the colors of images.
        about: called with the opened recording or logs, of images or for a LeRobot dataset.
        warn: called with each warning that `about` does not state.

    Returns:
        The number of iterations, messages, images or frames written.

    Raises:
        UsageError: there is no such run, log or form; `out` exists and `force` is not set, or it
            holds files that no export wrote.
        LogDamagedError: the input cannot be read.
        CdmisfaError: `out` cannot be written.
    """
    paths = [path] if isinstance(path, Path) else list(path)
    if form not in FORMS:
        raise UsageError(f"--to {form!r} is not a format: {did_you_mean(form, FORMS)}")
    is_of_run = form in TABLES and holds_run(paths[0])
    if form in TABLES and (len(paths) > 1 if is_of_run else form not in NUMBERS):
        raise UsageError(
            f"{form} is a format for the signals of one run: give one run, or use --to parquet for "
            "numbers of logs, and --to images, --to mp4 or --to lerobot for frames"
        )
    single = is_of_run or (form in ("mp4", *NUMBERS) and out.suffix == f".{form}")
    if single:
        refuse_taken(out, force=force)
    else:
        refuse_existing(out, force=force, resumable=False)
        for file in out.rglob("*"):
            if not file.is_dir() and file.suffix not in WRITTEN:
                other = f"{out} has files that no export wrote, as {file.relative_to(out)}"
                raise UsageError(f"{other}: choose a new folder")
    if is_of_run:
        with atomic_write(out) as place:
            return TABLES[form](paths[0], place)
    inputs = inputs or InputOptions()
    if form in NUMBERS:  # each row keeps its time
        inputs = replace(inputs, align="time")
    else:
        align: Align | None = "nearest" if form == "lerobot" else None
        inputs = replace(inputs, align=align, native=True, color=color)
    logs = _opened(paths, form, inputs, about, warn, single=single)
    with contextlib.closing(logs), atomic_write(out) as place:
        if form == "lerobot":
            options = DatasetOptions(state, action, task, lossless, inputs)
            return write_dataset(logs, place, options, warn)
        _, source = next(logs)
        if form == "images":
            return write_images(source, place)
        if form in NUMBERS:
            return write_streams(source, place, form, single=single)
        if single:
            return write_video(source, 0, place, lossless=lossless)
        return write_videos(source, place, lossless=lossless)


def _episode_logs(paths: list[Path]) -> list[list[Path]]:
    """Return the logs that are episodes of their own: recordings, and logs that share topics."""
    if all(path.is_dir() and is_recording([str(path)]) for path in paths):
        return [[path] for path in paths]
    logs = image_logs(paths)
    topics = [log_topics(log).keys() for log in logs]
    with contextlib.suppress(SeveralRecordingsError):
        if len(logs) == 1 or is_recording([str(path) for path in paths]):
            return [paths]
    share = all(topics[0] & each for each in topics)
    return [[log] for log in logs] if share else [paths]


def _opened(
    paths: list[Path],
    form: str,
    inputs: InputOptions,
    about: Announce,
    warn: Callable[[str], None],
    *,
    single: bool,
) -> Generator[tuple[Sequence[Path], LoggedSource]]:
    """Yield the paths of each log and its source, open until the next one.

    Raises:
        UsageError: its frames do not fit the form or differ from the first log, or as for
            `open_for_viewing`.
        LogDamagedError: one is damaged.
    """
    first = None
    for log in _episode_logs(paths) if form == "lerobot" else [paths]:
        # Numbers of tables beside images are put at the times of the images.
        images = [path for path in log if log_format(path) != "table"] if form == "lerobot" else log
        if (inputs.rate or inputs.size) and is_recording([str(path) for path in log]):
            inputs = replace(inputs, topics=inputs.topics or ALL)  # not frame by frame
        with contextlib.closing(open_for_viewing(images or log, inputs)) as source:
            spec, why, count = source.spec, "", len(source.spec.streams)
            first = first or spec
            if form not in ("lerobot", *NUMBERS) and any(
                len(shape) < 2 for shape, _ in spec.every_kind
            ):
                topics = topics_of(source, images=True)
                how = f"choose images with {topics}, or use" if topics else "use --to parquet or"
                why = f"has streams of numbers: {how} --to lerobot"
            elif single and count > 1:
                why = f"has {count} streams: choose a folder instead of one .{form} file"
            for name in ("streams", "frame_shape", "dtype", "kinds", "truth", "fps"):
                if (a := getattr(first, name)) != (b := getattr(spec, name)):
                    why = f"has {name} {b}, but {paths[0]} has {a}: export them separately"
            if why:
                raise UsageError(f"{log[0]} {why}")
            if form in NUMBERS:
                for line in dict.fromkeys(w for stream in source.streams for w in stream.warnings):
                    warn(line)
            else:
                about(source)
            try:
                yield log, source
            finally:
                for line in (*source.changes.values(), *source.skipped_damage()):
                    warn(line)
