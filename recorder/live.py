"""What a source shows, recorded while it is watched."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

from cdmisfa.core.blocks import Block, FrameSource, SourceSpec, check_request, take_unbroken
from cdmisfa.core.errors import LogExhaustedError
from recorder.config import RecordConfig
from recorder.log.begun import Begun, keep_recording
from recorder.log.folder import folder_here, prepared_folder, refuse_existing
from recorder.log.resume import other_recordings
from recorder.log.split import Split
from recorder.log.viewlog import ViewParts
from recorder.recording import ViewRecording, check_block, identity_of, view_recording
from recorder.world.scenes import BLOCK

COUNTS: Final = "cdmisfa.live"
"""Name of the metadata record that says what became of a live stream's pictures."""


class RecordedWhileWatched:
    """A source whose every stream is recorded, whichever is watched.

    What `take` gives can be taken again from the recording, to the bit: `learn` from both gives
    the same signals. Used as a context: leaving it finishes the files, also when the source has
    ended or learning was stopped; an error leaves readable `.partial` files.

    Args:
        source: at its first frame, such as cameras that cannot go back; closed with this.
        folder: of the recording; made if it does not exist.
        settings: how the files are written; the clock is the source's.
        split: write every view as parts of limited size or duration.
        fsync_every: see `record`.
        force: overwrite an earlier recording in the folder.

    Attributes:
        files: of the recording, once it is finished.
        ended: why the source ended, where it did.

    Raises:
        UsageError: the folder exists, or no recording can hold what the source shows.
        LogWriteError: the disk does not take it.
    """

    def __init__(
        self,
        source: FrameSource,
        folder: str | Path,
        *,
        settings: RecordConfig | None = None,
        split: Split | None = None,
        fsync_every: float | None = None,
        force: bool = False,
    ) -> None:
        self.files: list[ViewRecording] = []
        self.ended = ""
        self._source = source
        self.folder = folder_here(folder)
        self.gaps = bool(getattr(source, "gaps", False))
        refuse_existing(self.folder, force=force, goes_on=False)
        settings = settings or RecordConfig()
        identity = identity_of(source, None, settings, None)
        self._views = identity.spec.streams
        self._parts: dict[str, list[tuple[Path, int]]] = {view: [] for view in self._views}
        with ExitStack() as stack:
            stale = other_recordings(self.folder, identity) if force else []
            stack.enter_context(prepared_folder(self.folder, self._views if force else (), stale))
            most = {"frames": dict.fromkeys(self._views, 1), "split": {}, "seed": identity.seed}
            keep_recording(self.folder, self._views, Begun((identity.kind,), most))
            self._logs = []
            for view, parts in self._parts.items():
                log = ViewParts(
                    self.folder,
                    view,
                    identity,
                    settings,
                    split,
                    None,
                    parts,
                    source.t,
                    fsync_every,
                )
                stack.callback(log.abandon)
                self._logs.append(log)
            self._open = stack.pop_all()

    @property
    def spec(self) -> SourceSpec:
        """What the source delivers."""
        return self._source.spec

    @property
    def t(self) -> int:
        """Global counter of the next frame."""
        return self._source.t

    @property
    def alignment(self) -> Mapping[str, Mapping[str, int]]:
        """See `LiveSource`; empty of sources that count nothing."""
        return getattr(self._source, "alignment", {})

    @property
    def stop(self) -> Callable[[], bool]:
        """Asked while the source waits; true ends the wait."""
        return getattr(self._source, "stop", lambda: False)

    @stop.setter
    def stop(self, stop: Callable[[], bool]) -> None:
        if hasattr(self._source, "stop"):
            self._source.stop = stop

    def take(self, stream: int, n: int) -> Block:
        """See `FrameSource`; what the other streams show meanwhile is recorded, too."""
        return take_unbroken(self, stream, n)

    def take_all(self, n: int) -> tuple[Block, ...]:
        """See `FrameSource`; recorded before it is given."""
        check_request(self.spec, 0, n)
        try:
            blocks = self._source.take_all(n)
        except LogExhaustedError as error:
            self.ended = str(error)
            raise
        for block in blocks:
            check_block(block, self.spec)
            self._logs[block.stream].write(block)
        return blocks

    def describe(self) -> Mapping[str, Any]:
        """What identifies the source."""
        return self._source.describe()

    def finish(self) -> None:
        """Finish the files."""
        for view, log in zip(self._views, self._logs, strict=True):
            if counts := self.alignment.get(view):
                log.state(COUNTS, {name: str(count) for name, count in counts.items()})
            log.finish()
        keep_recording(self.folder, self._views)
        self.files = [
            view_recording(view, path, n) for view, done in self._parts.items() for path, n in done
        ]

    def close(self) -> None:
        """Let go of the source, and of the files as they are."""
        self._source.close()
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        try:
            if kind is None or issubclass(kind, LogExhaustedError):
                self.finish()
        finally:
            self.close()


def record_watched(
    recorded: RecordedWhileWatched,
    *,
    frames: int | None = None,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[float], None] = lambda done: None,
) -> None:
    """Record until the source ends, or is stopped; then finish the recording.

    Args:
        recorded: entered, and finished, here.
        frames: how many; by default all that the source shows.
        stop: asked often; true ends the recording.
        progress: told how many frames there are.

    Raises:
        LogWriteError: the disk does not take it.
    """
    recorded.stop = stop
    step = 1 if recorded.gaps else BLOCK
    with recorded, contextlib.suppress(LogExhaustedError):
        while not stop() and (frames is None or recorded.t < frames):
            recorded.take_all(step if frames is None else min(step, frames - recorded.t))
            progress(recorded.t)
