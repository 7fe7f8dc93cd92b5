"""The forms in which a run's signals or a recording's frames can be written for other programs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

from cdmisfa.core.errors import UsageError
from cdmisfa.core.registry import Registry, did_you_mean
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


@dataclass(frozen=True, slots=True)
class Form:
    """A form in which other programs read what was logged.

    Attributes:
        of: what is written so: the signals of a "run", or the frames of a "recording".
        write: writes a run's folder, or an open source of frames, to a path that does not exist,
            as a file or a folder, and returns how many there are of `unit`. It takes the word
            `lossless` where `lossy` is set.
        unit: what is counted.
        lossy: whether it may lose a little of what was logged.
    """

    of: Literal["run", "recording"]
    write: Callable[..., int]
    unit: str
    lossy: bool = False


def _write_lerobot(source: Logged, folder: Path, **how: Any) -> int:
    return write_dataset([source], folder, **how)


def _table(form: str) -> Form:
    return Form("run", partial(export_signals, form=form), "iterations")


FORMS: Registry[Form] = Registry(
    "form",
    {
        **{form: _table(form) for form in TABLES},
        "images": Form("recording", write_images, "images"),
        "mp4": Form("recording", write_films, "frames", lossy=True),
        "lerobot": Form("recording", _write_lerobot, "frames", lossy=True),
    },
)
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
        form: one of `FORMS`; see `export_signals`.
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
    described = FORMS[form]
    if lossless and not described.lossy:
        lossy = " and ".join(name for name, other in FORMS.items() if other.lossy)
        raise UsageError(f"{form} loses nothing: --lossless is for {lossy}")
    if out.exists() and not force:
        raise UsageError(f"{out} exists: choose another name or overwrite with --force")
    refuse_special(out)
    paths = [path] if isinstance(path, Path) else list(path)
    if task is not None and form != "lerobot":
        raise UsageError(f"{form} has no word for a task: --task is for lerobot")
    for named in paths:
        if not named.exists():
            raise no_such(named)
    if form in TABLES:
        refuse_unless(out, f"{form} is written", f".{form}", "")
    elif form in ("images", "lerobot") or (form == "mp4" and out.suffix != ".mp4"):
        refuse_named_as_file(out)
    if described.of == "recording":
        words: dict[str, Any] = {"lossless": lossless} if described.lossy else {}
        if form == "lerobot":
            words |= {"name": out.name, "task": task}
        if form != "lerobot" or not _are_recordings(paths):
            return _export_recording(paths, out, form, words, inputs, about)
        _refuse_others(out)
        with (
            contextlib.closing(_opened_in_turn(paths, inputs, about)) as opened,
            atomic_write(out) as place,
        ):
            return write_dataset(opened, place, **words)
    if out.is_dir():
        raise UsageError(f"{out} is a folder: name the file to write")
    if not all(map(holds_run, paths)):
        frames = " or ".join(name for name, other in FORMS.items() if other.of == "recording")
        raise UsageError(
            f"{paths[0]} is no run, {form} is for the signals of one: choose {frames} with --to"
        )
    if len(paths) > 1:
        raise UsageError(f"signals are of one run, {len(paths)} were named")
    if form in TABLES:  # one of them is two files
        return described.write(paths[0], out, force=force)
    with atomic_write(out) as place:
        return described.write(paths[0], place)


def _export_recording(
    paths: list[Path],
    out: Path,
    form: str,
    words: Mapping[str, Any],
    inputs: InputOptions | None,
    about: About,
) -> int:
    path = paths[0]
    if holds_run(path):
        raise UsageError(f"{path} is a run, {form} is for recordings: name the recording")
    with contextlib.closing(open_to_look(paths, inputs)) as source:
        if form in ("images", "mp4") and not source.spec.images:
            raise UsageError(f"{path} holds no images: its frames are values")
        if form == "mp4" and out.suffix == ".mp4" and not out.is_dir():
            if len(source.spec.streams) > 1:
                raise UsageError(f"{path} has several views: name a folder, not {out.name}")
            about(source)
            with atomic_write(out) as film:
                write_film(source, 0, film, **words)
            return source.frames
        _refuse_others(out)
        about(source)
        with atomic_write(out) as place:
            return FORMS[form].write(source, place, **words)


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
    paths: Sequence[Path], inputs: InputOptions | None, about: About
) -> Generator[Logged]:
    """Yield each recording, open until the next is asked for.

    Raises:
        UsageError: one has other streams, sizes or rates than the first, or as for `open_to_look`.
        LogDamagedError: one is damaged.
    """
    first = None
    for path in paths:
        with contextlib.closing(open_to_look([path], inputs)) as source:
            about(source)
            first = first or source.spec
            for what in _ALIKE:
                one, other = getattr(first, what), getattr(source.spec, what)
                if one != other:
                    raise UsageError(
                        f"{path}: its {what} is {other}, that of {paths[0]} {one}: export "
                        "them by themselves, or convert them first"
                    )
            yield source


def _refuse_others(out: Path) -> None:
    """Refuse to replace a folder with other files than exports write."""
    for file in out.rglob("*") if out.is_dir() else ():
        if not file.is_dir() and file.suffix not in WRITTEN:
            other = f"{out} holds other files, such as {file.relative_to(out)}"
            raise UsageError(f"{other}: export into a new folder")
