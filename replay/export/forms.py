"""The forms in which a run's signals or a recording's frames can be written for other programs."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

from cdmisfa.core.errors import UsageError
from recorder.log.whole import refuse_special, whole
from replay.export.images import write_images
from replay.export.lerobot import write_lerobot
from replay.export.tables import TABLES, export_signals
from replay.export.videos import write_film, write_films
from replay.inputs.opening import holds_run, open_to_look

RECORDINGS = ("images", "mp4", "lerobot")
"""What a recording can be written as."""

FORMS = (*TABLES, *RECORDINGS)
"""What can be written."""

WRITTEN = frozenset({".png", ".mp4", ".parquet", ".json", ".md"})
"""Endings of the files that exports of recordings write; a folder with others is not theirs."""


def export(
    path: Path | Sequence[Path],
    out: Path,
    form: str,
    *,
    force: bool = False,
    lossless: bool = False,
    rate: float | None = None,
) -> int:
    """Write a run's signals, or a recording's frames, in another form.

    Args:
        path: a run; for a form of `RECORDINGS` a recording, or camera logs.
        out: the file; for those forms the folder, or for one view's video a file *.mp4.
        form: one of `FORMS`; see `export_signals`.
        force: replace an existing file, or an earlier export in a folder.
        lossless: keep every value of images that become a video.
        rate: frames a second of camera logs; by default the first stream's.

    Returns:
        The number of iterations, or of images or frames, written.

    Raises:
        UsageError: no such run or form, `out` exists and `force` is not set, or it holds other
            files than exports write.
        LogDamagedError: the run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    if form not in FORMS:
        raise UsageError(f"no form {form!r}: choose one of {', '.join(FORMS)} with --to")
    if lossless and form not in ("mp4", "lerobot"):
        raise UsageError(f"{form} loses nothing: --lossless is for mp4 and lerobot")
    if out.exists() and not force:
        raise UsageError(f"{out} exists: choose another name or overwrite with --force")
    refuse_special(out)
    paths = [path] if isinstance(path, Path) else list(path)
    if form in RECORDINGS:
        return _export_recording(paths, out, form, lossless, rate)
    if out.is_dir():
        raise UsageError(f"{out} is a folder: name the file to write")
    if len(paths) > 1:
        raise UsageError(f"signals are of one run, {len(paths)} were named")
    return export_signals(paths[0], out, form, force=force)


def _export_recording(
    paths: list[Path], out: Path, form: str, lossless: bool, rate: float | None
) -> int:
    path = paths[0]
    if holds_run(path):
        raise UsageError(f"{path} is a run, {form} is for recordings: name the recording")
    with contextlib.closing(open_to_look(paths, rate)) as source:
        if form != "lerobot" and not source.spec.images:
            raise UsageError(f"{path} holds no images: its frames are values")
        if form == "mp4" and out.suffix == ".mp4" and not out.is_dir():
            if len(source.spec.streams) > 1:
                raise UsageError(f"{path} has several views: name a folder, not {out.name}")
            with whole(out) as film:
                write_film(source, 0, film, lossless=lossless)
            return source.frames
        _refuse_others(out)
        with whole(out) as folder:
            folder.mkdir()
            if form == "lerobot":
                return write_lerobot(source, folder, name=out.name, lossless=lossless)
            if form == "mp4":
                return write_films(source, folder, lossless=lossless)
            return write_images(source, folder)


def _refuse_others(out: Path) -> None:
    """Refuse to replace a folder with other files than exports write."""
    for file in out.rglob("*") if out.is_dir() else ():
        if not file.is_dir() and file.suffix not in WRITTEN:
            other = f"{out} holds other files, such as {file.relative_to(out)}"
            raise UsageError(f"{other}: export into a new folder")
