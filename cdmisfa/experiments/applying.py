"""What becomes of applied modules: a file a log, and what each module came to there."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.blocks import SourceSpec, stream_name
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.modules import Module
from recorder.log.files import atomic_write, refuse_special, refuse_taken
from replay.export.applied import Applied, AppliedSink, LogSink, TableSink, columns_of

FORMS: Final = ("parquet", "csv", "mcap")
"""What outputs are written as."""


class Tally:
    """What modules came to on the streams of a source.

    Args:
        spec: of the source.
        modules: in their order.

    Attributes:
        frames: of all streams.
        damaged: why the log was not applied to its end; None where it was.
    """

    def __init__(self, spec: SourceSpec, modules: Sequence[Module]) -> None:
        self.frames = 0
        self.damaged: LogDamagedError | None = None
        self._spec, self._modules = spec, list(columns_of(modules))
        self._sums: dict[tuple[int, int], list[float]] = {}

    def add(self, applied: Applied) -> None:
        """Take a block in."""
        block, count = applied.block, len(applied.block)
        self.frames += count
        for i, (_, own) in enumerate(self._modules):
            sums = self._sums.setdefault((block.stream, i), [0.0] * 5)
            sums[0] += count
            sums[1] += count * bool(applied.alive[i])
            sums[2] += count * (float(applied.novelty[i]) < 1)
            slowness = float(applied.slowness[own.start])
            if math.isfinite(slowness):
                sums[3] += count * slowness
                sums[4] += count

    def rows(self) -> list[dict[str, Any]]:
        """A row a stream and module, as JSON values: shares of its frames, mean slowness."""
        return [
            {
                "stream": self._spec.streams[stream],
                "module": self._modules[i][0].index,
                "frames": int(frames),
                "slowness": slowness / counted if counted else None,
                "alive": alive / frames,
                "known": known / frames,
            }
            for (stream, i), (frames, alive, known, slowness, counted) in sorted(self._sums.items())
        ]


def follow(
    applied: Iterable[Applied],
    sinks: Sequence[AppliedSink],
    tally: Tally,
    told: Callable[[], None] = lambda: None,
) -> None:
    """Hand every block to sinks and a tally; damage of the log ends it and is noted."""
    try:
        for one in applied:
            for sink in sinks:
                sink.add(one)
            tally.add(one)
            told()
    except LogDamagedError as error:
        if not tally.frames:
            raise
        tally.damaged = error


@contextlib.contextmanager
def written(
    out: Path, spec: SourceSpec, modules: Sequence[Module], *, force: bool
) -> Iterator[AppliedSink]:
    """A file for what modules give, whole when the body has ended.

    Args:
        out: the file, named as one of `FORMS`.
        spec: of the source.
        modules: in their order.
        force: replace an existing file.

    Raises:
        UsageError: it exists.
        LogWriteError: it cannot be written.
    """
    form = out.suffix.lower().removeprefix(".")
    refuse_special(out)
    refuse_taken(out, force=force)
    if form == "mcap":
        log = LogSink(out, spec, modules, force=force)
        try:
            yield log
        except BaseException:
            log.abandon()
            raise
        log.close()
        return
    with atomic_write(out) as partial:
        table = TableSink(partial, form, spec, modules)
        try:
            yield table
        except BaseException:
            with contextlib.suppress(Exception):  # the first error counts
                table.close()
            raise
        table.close()


def places(
    out: Path | None, form: str | None, logs: Sequence[str], *, force: bool
) -> list[Path | None]:
    """The file of each log that is written: one, or one each in a folder.

    Args:
        out: the file of one log, or the folder.
        form: as asked for; else by the name of the file, Parquet in a folder.
        logs: as named.
        force: replace existing files.

    Raises:
        UsageError: a file for several logs, no form that it could have, no place to write it, or
            it exists.
    """
    if out is None:
        if form is not None:
            raise UsageError(f"--to {form} is written to a file: name it with -o")
        return [None] * len(logs)
    found = _named(out, form, logs)
    for place in found:
        refuse_taken(place, force=force)
    return [*found]


def _named(out: Path, form: str | None, logs: Sequence[str]) -> list[Path]:
    ending = out.suffix.lower().removeprefix(".")
    if ending in FORMS and not out.is_dir():
        if form not in (None, ending):
            raise UsageError(f"{out}: as {form} it is written, name it {out.stem}.{form}")
        if len(logs) > 1:
            raise UsageError(
                f"{len(logs)} logs are a file each: name a folder with -o, without .{ending}"
            )
        return [out]
    form = form or FORMS[0]
    found: list[Path] = []
    for log in logs:
        name = base = stream_name(Path(log.rstrip("/")).name.partition(".mcap")[0])
        number = 1
        while out / f"{name}.{form}" in found:
            number += 1
            name = f"{base}-{number}"
        found.append(out / f"{name}.{form}")
    return found
