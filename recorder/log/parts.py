"""One view's log as a file, or as parts of limited size or duration."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.blocks import Block, HeadPose
from cdmisfa.core.errors import LogWriteError, UsageError
from recorder.config import RecordConfig
from recorder.log.viewlog import (
    FramesHeld,
    Identity,
    ViewLog,
    check_identity,
    earlier_logs,
    frames_held,
    keep,
    kept_path,
)

_BYTES: Final = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_SECONDS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True, slots=True)
class Split:
    """Where a new part begins; one of the two is set.

    Attributes:
        size: bytes of a part, exceeded by a chunk and the index at most.
        seconds: of log time in a part.
    """

    size: int | None = None
    seconds: float | None = None

    @classmethod
    def parse(cls, text: str) -> Split:
        """Read "512MB" or "10min".

        Raises:
            UsageError: it is neither.
        """
        found = re.fullmatch(r"(\d{1,9}(?:\.\d{1,6})?) ?([A-Za-z]+)", text.strip())
        number, unit = (float(found[1]), found[2]) if found else (0.0, "")
        if number > 0 and unit in _BYTES:
            return cls(size=max(round(number * _BYTES[unit]), 1))
        if number > 0 and unit in _SECONDS:
            return cls(seconds=number * _SECONDS[unit])
        raise UsageError(
            f"--split is {text!r}: give a size ({', '.join(_BYTES)}) or a duration "
            f"({', '.join(_SECONDS)}), as 512MB or 10min"
        )

    def __str__(self) -> str:
        """The limit as `parse` reads it, in the largest unit that it is a multiple of."""
        units: dict[str, Any] = _SECONDS if self.size is None else _BYTES
        limit = (self.seconds or 0.0) if self.size is None else self.size
        least = next(iter(units))
        unit = max(
            (u for u in units if limit % units[u] == 0), key=units.__getitem__, default=least
        )
        return f"{limit / units[unit]:.6f}".rstrip("0").rstrip(".") + unit

    def frames(self, fps: float) -> int | None:
        """Frames of a part, where a duration is given."""
        return None if self.seconds is None else max(round(self.seconds * fps), 1)


class ViewParts:
    """Writes one view: VIEW.mcap, or VIEW-000.mcap, VIEW-001.mcap, ... where it is split.

    Where a part ends depends on its frames only, not on the blocks they came in.

    Args:
        folder: of the recording.
        view: name of the view.
        identity: what is recorded.
        settings: how it is written.
        split: where parts end; None for a single file.
        pose: of the head in this view, where there is a head.
        resume: go on after the frames that an earlier attempt left, up to this many;
            None to begin anew.
        earlier: what the view's files hold, as far as that is known.

    Raises:
        UsageError: what is there is something else, or split in another way.
        LogWriteError: the disk does not take it.

    Attributes:
        view: name of the view.
        stream: its index.
        parts: for each part that is done its file and number of frames.
    """

    def __init__(
        self,
        folder: Path,
        view: str,
        identity: Identity,
        settings: RecordConfig,
        *,
        split: Split | None = None,
        pose: HeadPose | None = None,
        resume: int | None = None,
        earlier: Mapping[Path, FramesHeld] | None = None,
    ) -> None:
        self.view = view
        self.stream = identity.spec.streams.index(view)
        self.parts: list[tuple[Path, int]] = []
        self._folder = folder
        self._identity = identity
        self._settings = settings
        self._split = split
        self._length = split.frames(identity.spec.fps) if split else None
        self._pose = pose
        self._first = self._t = 0
        self._resume = resume
        self._held = dict(earlier or {})
        self._earlier: tuple[Path, int] | None = None
        if resume is not None:
            self._earlier = self._to_continue(resume)
            self._refuse_later_parts()
        self._log: ViewLog | None = None

    @property
    def complete(self) -> bool:
        """Whether an earlier attempt finished the view, which is left as it is."""
        return self._earlier == (self._path(), self._resume)

    def open(self) -> None:
        """Open the part to be written, with what an earlier attempt left of it.

        Raises:
            LogWriteError: the disk does not take it.
        """
        if self._earlier is not None and self.complete:
            self._t = self._earlier[1]
            self.parts.append((self._path(), self._t - self._first))
            kept_path(self._earlier[0]).unlink(missing_ok=True)
            return
        try:
            for begun in self._later_parts():
                begun.unlink()
            if self._earlier is None or self._resume is None:
                self._log = self._new()
                return
            kept = keep(self._path(), self._earlier[0])
        except OSError as error:
            raise LogWriteError(f"{self._path()} cannot be continued: {error.strerror}") from error
        self._log = self._new()
        self._log.copy(kept, min(self._earlier[1], self._resume))

    @property
    def t(self) -> int:
        """The next frame to be written."""
        return self._t if self._log is None else self._log.t

    def write(self, block: Block) -> None:
        """Write the frames of a block, which must start at `t`.

        Raises:
            ValueError: the block is of another stream or time.
            LogWriteError: the disk does not take it.
        """
        for piece in self._pieces(block):
            if self._is_full():
                self._begin_next()
            self._writing.write(piece)

    def finish(self) -> None:
        """Give the last part its index and its name, and forget what it was copied from."""
        if self._log is None:
            return
        log = self._log
        log.finish()
        kept_path(log.path).unlink(missing_ok=True)
        self.parts.append((log.path, log.t - self._first))

    def abandon(self) -> None:
        """Leave a readable partial."""
        if self._log is not None:
            self._log.abandon()

    @property
    def _writing(self) -> ViewLog:
        if self._log is None:
            raise ValueError(f"{self.view}: its log is not open")
        return self._log

    def _path(self) -> Path:
        """File of the part that comes after those that are done."""
        number = "" if self._split is None else f"-{len(self.parts):03d}"
        return self._folder / f"{self.view}{number}.mcap"

    def _new(self) -> ViewLog:
        return ViewLog(
            self._folder,
            self.view,
            self._identity,
            self._settings,
            pose=self._pose,
            name=self._path().name,
            first_frame=self._first,
        )

    def _pieces(self, block: Block) -> Iterator[Block]:
        """Pieces of a block that belong into one part each."""
        at = 0
        while at < len(block):
            step = len(block)
            if self._length is not None:
                step = self._length - (block.t + at) % self._length
            elif self._split is not None:
                step = 1
            piece = slice(at, at + step)
            yield Block(block.stream, block.t + at, block.frames[piece], block.truth[piece])
            at += step

    def _is_full(self) -> bool:
        held = self.t - self._first
        if self._length is not None:
            return held >= self._length
        size = self._split.size if self._split else None
        return size is not None and held > 0 and self._writing.size >= size

    def _begin_next(self) -> None:
        """Begin a part before the one before is finished, so that some file is always open.

        Whoever follows the recording sees that it goes on.
        """
        full, first = self._writing, self._first
        full.flush()
        self.parts.append((full.path, full.t - first))
        self._first = full.t
        try:
            self._log = self._new()
        finally:
            full.finish()
        kept_path(full.path).unlink(missing_ok=True)

    def _to_continue(self, frames: int) -> tuple[Path, int] | None:
        """Pass over the parts that are done, and find the one to go on with.

        Returns:
            The earlier log of that part that holds the most frames, and up to which frame.

        Raises:
            UsageError: it is a recording of something else, or split in another way.
        """
        self._refuse_other_split()
        while True:
            path = self._path()
            found = {p: self._whole(p) for p in earlier_logs(path)}
            best = max(found, key=lambda p: found[p], default=None)
            if best is None or found[best] <= self._first:
                if path in found:
                    raise UsageError(
                        f"{path} holds no frames of {self.view} from {self._first} on: "
                        "overwrite with --force"
                    )
                for torn in found:
                    torn.unlink()
                return None
            check_identity(best, self._identity.metadata(self.view, self._first))
            done = (path, found[best] - self._first)
            if self._length is not None and done[1] > self._length:
                raise self._another_split(best, done[1])
            if best != path or not self._goes_on(done):
                return best, found[best]
            if found[best] >= frames:
                raise UsageError(
                    f"{path} ends at frame {found[best]}, and more follow: ask for more frames, "
                    "or overwrite with --force"
                )
            self.parts.append(done)
            self._first = found[best]

    def _whole(self, path: Path) -> int:
        """Up to before which frame a file holds all of the part to go on with."""
        if path not in self._held:
            self._held[path] = frames_held(path, self.view)
        return self._held[path].whole(self._first)

    def _goes_on(self, done: tuple[Path, int]) -> bool:
        """Whether another part follows a finished one."""
        if self._split is None:
            return False
        logs = view_logs(self._folder, self.view, split=True)
        follows = any(_part(path.name) > len(self.parts) for path in logs)
        if follows and self._length is not None and done[1] != self._length:
            raise self._another_split(*done)
        return follows

    def _another_split(self, path: Path, frames: int) -> UsageError:
        return UsageError(
            f"{path} has {frames} frames, with this --split it would have {self._length}: "
            "use the same, or overwrite with --force"
        )

    def _later_parts(self) -> list[Path]:
        """Logs of parts after the one to go on with, begun when the recorder ended."""
        if self._split is None or self._resume is None:
            return []
        last = self._path().name
        logs = view_logs(self._folder, self.view, split=True)
        return [p for p in logs if _part(p.name) > _part(last)]

    def _refuse_later_parts(self) -> None:
        for path in self._later_parts():
            if path.suffix == ".mcap":
                raise UsageError(
                    f"{path} is there, {self._path().name} before it is not whole: recover that "
                    "part first, or overwrite with --force"
                )

    def _refuse_other_split(self) -> None:
        split = self._split is not None
        others = view_logs(self._folder, self.view, split=not split)
        if others:
            raise UsageError(
                f"{others[0]} was recorded {'without' if split else 'with'} --split: "
                "use the same, or overwrite with --force"
            )


def _part(name: str) -> int:
    """Number of a part by its file's name."""
    return int(name.partition(".")[0].rpartition("-")[2])


def view_logs(folder: Path, view: str, *, split: bool | None = None) -> list[Path]:
    """Files of a view in a folder, finished or not.

    Args:
        folder: of the recording.
        view: name of the view.
        split: only parts, or only whole views; None for both.
    """
    parts = r"-\d{3,}"
    middle = {True: parts, False: "", None: f"({parts})?"}[split]
    pattern = re.compile(rf"{re.escape(view)}{middle}\.mcap(\.partial(\.kept)?)?")
    return sorted(p for p in folder.glob(f"{view}*") if pattern.fullmatch(p.name))
