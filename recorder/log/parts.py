"""One view's log as a file, or as parts of limited size or duration."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cdmisfa.core.blocks import Block, HeadPose
from cdmisfa.core.errors import LogWriteError
from recorder.config import RecordConfig
from recorder.log.folder import part_name
from recorder.log.resume import Resume, keep, kept_path
from recorder.log.split import Split
from recorder.log.viewfacts import Identity
from recorder.log.viewlog import ViewLog

_BEGINNING = Resume()


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
        resume: where it is resumed.

    Attributes:
        view: name of the view.
        stream: its index.
        parts: for each part that is done its file and number of frames.
        complete: whether an earlier attempt finished the view, which is left as it is.
    """

    def __init__(
        self,
        folder: Path,
        view: str,
        identity: Identity,
        settings: RecordConfig,
        split: Split | None = None,
        pose: HeadPose | None = None,
        resume: Resume = _BEGINNING,
    ) -> None:
        self.view = view
        self.stream = identity.spec.streams.index(view)
        self.parts = list(resume.parts)
        self.complete = resume.complete
        self._folder = folder
        self._identity = identity
        self._settings = settings
        self._split = split
        self._length = split.frames(identity.spec.fps) if split else None
        self._pose = pose
        self._resume = resume
        self._first = resume.first
        self._log: ViewLog | None = None

    def open(self) -> None:
        """Open the part to be written, with what an earlier attempt left of it.

        Raises:
            LogWriteError: the disk does not take it.
        """
        path, resume = self._path(), self._resume
        if self.complete:
            self.parts.append((path, resume.stop - self._first))
            kept_path(path).unlink(missing_ok=True)
            return
        try:
            for old in resume.stale:
                old.unlink()
            kept = None if resume.log is None else keep(path, resume.log)
        except OSError as error:
            raise LogWriteError(f"{path} cannot be continued: {error.strerror}") from error
        self._log = self._new()
        if kept is not None:
            self._log.copy(kept, resume.stop)

    @property
    def t(self) -> int:
        """The next frame to be written."""
        return self._resume.stop if self._log is None else self._log.t

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
        number = None if self._split is None else len(self.parts)
        return self._folder / part_name(self.view, number)

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
        written = self.t - self._first
        if self._length is not None:
            return written >= self._length
        size = self._split.size if self._split else None
        return size is not None and written > 0 and self._writing.size >= size

    def _begin_next(self) -> None:
        """Begin a part before the one before is finished, so that some file is always open.

        Whoever follows the recording sees that it continues.
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
