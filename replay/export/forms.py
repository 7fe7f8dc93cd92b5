"""Write a run's signals or a recording's frames for other programs, in one of several forms."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import UsageError, did_you_mean
from recorder.images.options import InputOptions
from recorder.log.files import atomic_write, refuse_named_as_file, refuse_special, refuse_unless
from replay.camera_logs.opening import only_foreign
from replay.export.frames import write_film, write_films, write_images
from replay.export.lerobot import write_dataset
from replay.export.tables import TABLES, export_signals
from replay.inputs import About, Logged, holds_run, open_to_look
from replay.recordings.source import RecordedSource
from replay.recordings.view_file import NoRecordingError
from replay.storage.opening import no_such

_ALIKE: Final = ("streams", "frame_shape", "dtype", "truth", "fps")
"""What recordings have in common that become one dataset."""


RECORDED: Final = ("images", "mp4", "lerobot")
"""Forms of the frames of a recording; the others are of the signals of a run."""

LOSSY: Final = ("mp4", "lerobot")
"""Forms that may change pixels a little."""

FORMS: Final = (*TABLES, *RECORDED)
"""Every form."""

WRITTEN = frozenset({".png", ".mp4", ".parquet", ".json", ".md"})
"""Endings of the files that exports of recordings write; a folder with others is not theirs."""


def export(
    path: Path | Sequence[Path],
    out: Path,
    form: str,
    *,
    force: bool = False,
    lossless: bool = False,
    inputs: InputOptions | None = None,
    task: str | None = None,
    about: About = lambda source: None,
) -> int:
    """Write a run's signals, or recordings' frames, in another form.

    Args:
        path: a run; for a form of recordings a recording, or camera logs; for LeRobot several
            folders of recordings, too.
        out: the file; for those forms the folder, or for one view's video a file *.mp4.
        form: one of `FORMS`.
        force: replace an existing file, or an earlier export in a folder.
        lossless: keep every value of images that become a video.
        inputs: which streams of camera logs; by default all of images.
        task: for LeRobot, what is done, in words.
        about: given a recording or camera logs before they are written, to say what they are.

    Returns:
        The number of iterations, or of images or frames, written.

    Raises:
        UsageError: no such run or form, `out` exists and `force` is not set, or it holds other
            files than exports write.
        LogDamagedError: the run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    if form not in FORMS:
        raise UsageError(f"no form {form!r} for --to: {did_you_mean(form, FORMS)}")
    if lossless and form not in LOSSY:
        raise UsageError(f"{form} loses nothing: --lossless is for {' and '.join(LOSSY)}")
    if out.exists() and not force:
        raise UsageError(f"{out} exists: choose another name or overwrite with --force")
    refuse_special(out)
    paths = [path] if isinstance(path, Path) else list(path)
    if task is not None and form != "lerobot":
        raise UsageError(f"{form} has no word for a task: --task is for lerobot")
    for named in paths:
        if not named.exists():
            raise no_such(named)
    if form in RECORDED:
        if form != "mp4" or out.suffix != ".mp4":
            refuse_named_as_file(out)
        if holds_run(paths[0]):
            raise UsageError(f"{paths[0]} is a run, {form} is for recordings: name the recording")
        if form == "lerobot":
            return _export_dataset(paths, out, inputs, about, lossless=lossless, task=task)
        return _export_images(paths, out, form, inputs, about, lossless=lossless)
    refuse_unless(out, f"{form} is written", f".{form}", "")
    if out.is_dir():
        raise UsageError(f"{out} is a folder: name the file to write")
    if not all(map(holds_run, paths)):
        raise UsageError(
            f"{paths[0]} is no run, {form} is for the signals of one: choose "
            f"{' or '.join(RECORDED)} with --to"
        )
    if len(paths) > 1:
        raise UsageError(f"signals are of one run, {len(paths)} were named")
    return export_signals(paths[0], out, form)


def _export_images(
    paths: list[Path],
    out: Path,
    form: str,
    inputs: InputOptions | None,
    about: About,
    *,
    lossless: bool,
) -> int:
    """Write every view as PNG files or as a video."""
    with contextlib.closing(open_to_look(paths, inputs)) as source:
        if not source.spec.images:
            raise UsageError(f"{paths[0]} holds no images: its frames are values")
        film = form == "mp4" and out.suffix == ".mp4" and not out.is_dir()
        if film and len(source.spec.streams) > 1:
            raise UsageError(f"{paths[0]} has several views: name a folder, not {out.name}")
        _refuse_others(out)
        about(source)
        with atomic_write(out) as place:
            if form == "images":
                return write_images(source, place)
            if not film:
                return write_films(source, place, lossless=lossless)
            write_film(source, 0, place, lossless=lossless)
            return source.frames


def _export_dataset(
    paths: list[Path],
    out: Path,
    inputs: InputOptions | None,
    about: About,
    *,
    lossless: bool,
    task: str | None,
) -> int:
    """Write a LeRobot dataset; several folders of recordings are logs of their own in it."""
    _refuse_others(out)
    logs = [[path] for path in paths] if _are_recordings(paths) else [paths]
    with (
        contextlib.closing(_opened_in_turn(logs, inputs, about)) as opened,
        atomic_write(out) as place,
    ):
        return write_dataset(opened, place, name=out.name, lossless=lossless, task=task)


def _are_recordings(paths: Sequence[Path]) -> bool:
    """Whether these are several folders of recordings, each with episodes of its own."""
    if len(paths) < 2 or not all(path.is_dir() and not only_foreign(path) for path in paths):
        return False
    try:
        for path in paths:
            RecordedSource(path).close()
    except NoRecordingError:
        return False
    return True


def _opened_in_turn(
    logs: Sequence[Sequence[Path]], inputs: InputOptions | None, about: About
) -> Generator[Logged]:
    """Yield each log, open until the next is asked for.

    Raises:
        UsageError: one has other streams, sizes or rates than the first, or as for `open_to_look`.
        LogDamagedError: one is damaged.
    """
    first = None
    for paths in logs:
        with contextlib.closing(open_to_look(paths, inputs)) as source:
            about(source)
            first = first or source.spec
            for what in _ALIKE:
                one, other = getattr(first, what), getattr(source.spec, what)
                if one != other:
                    raise UsageError(
                        f"{paths[0]}: its {what} is {other}, that of {logs[0][0]} {one}: export "
                        "them by themselves, or convert them first"
                    )
            yield source


def _refuse_others(out: Path) -> None:
    """Refuse to replace a folder with other files than exports write."""
    for file in out.rglob("*") if out.is_dir() else ():
        if not file.is_dir() and file.suffix not in WRITTEN:
            other = f"{out} holds other files, such as {file.relative_to(out)}"
            raise UsageError(f"{other}: export into a new folder")
