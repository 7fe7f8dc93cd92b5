"""Record a source while it is learned from."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

from cdmisfa.core.blocks import Block, ForwardSource, FrameSource, check_request
from cdmisfa.core.errors import LogExhaustedError
from recorder.config import RecordConfig
from recorder.log.files import folder_here, prepared_folder, refuse_existing
from recorder.log.resume import begin_view, other_recordings
from recorder.recording import ViewLogs, ViewRecording, recording_spec
from recorder.world.scenes import BLOCK

# Name of the metadata record that counts used and dropped images of a live stream.
COUNTS: Final = "cdmisfa.live"


class RecordedWhileWatched(ForwardSource):
    """Record every stream of a source, whichever is watched.

    The recording gives the blocks of `take` again, to the bit: `learn` from both gives the same
    signals. Used as a context: leaving it finishes the files, also when the source has ended or
    learning was stopped; an error leaves readable `.partial` files.

    Args:
        source: at its first frame, such as cameras that cannot go back; closed with this.
        folder: of the recording; made if it does not exist.
        settings: how the files are written; the clock is the source's.
        split: seconds of the parts that every view is written as.
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
        split: float | None = None,
        force: bool = False,
    ) -> None:
        self.files: list[ViewRecording] = []
        self.ended = ""
        self._source, self._spec, self._t = source, source.spec, source.t
        self.folder = folder_here(folder)
        self.gaps = bool(getattr(source, "gaps", False))
        refuse_existing(self.folder, force=force, goes_on=False)
        settings = settings or RecordConfig()
        recording = recording_spec(source, settings, None)
        views = recording.spec.streams
        places = {view: begin_view(self.folder, view, split, source.t) for view in views}
        with ExitStack() as stack:
            stale = other_recordings(self.folder, recording) if force else []
            stack.enter_context(prepared_folder(self.folder, views if force else (), stale))
            self._logs = ViewLogs(self.folder, recording, settings, places, 1, split)
            stack.callback(self._logs.abandon)
            self._open = stack.pop_all()

    @property
    def alignment(self) -> Mapping[str, Mapping[str, int]]:
        """See `LiveSource`; empty of sources that count nothing."""
        return getattr(self._source, "alignment", {})

    @property
    def stop(self) -> Callable[[], bool]:
        """Function that the source calls while it waits; true ends the wait."""
        return getattr(self._source, "stop", lambda: False)

    @stop.setter
    def stop(self, stop: Callable[[], bool]) -> None:
        if hasattr(self._source, "stop"):
            self._source.stop = stop

    def take_all(self, n: int) -> tuple[Block, ...]:
        """See `FrameSource`; recorded before it is given."""
        check_request(self.spec, 0, n)
        try:
            blocks = self._source.take_all(n)
        except LogExhaustedError as error:
            self.ended = str(error)
            raise
        for block in blocks:
            self._logs.write(block)
        self._t = self._source.t
        return blocks

    def describe(self) -> Mapping[str, Any]:
        """Return the identity of the source."""
        return self._source.describe()

    def finish(self) -> None:
        """Finish the files."""
        for stream, view in enumerate(self.spec.streams):
            if counts := self.alignment.get(view):
                self._logs.add_metadata(stream, COUNTS, {k: str(n) for k, n in counts.items()})
        self.files = self._logs.finish()

    def close(self) -> None:
        """Close the source, and leave the files as they are."""
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
        frames: number of frames; by default all that the source shows.
        stop: called often; true ends the recording.
        progress: called with the number of frames.

    Raises:
        LogWriteError: the disk does not take it.
    """
    recorded.stop = stop
    step = 1 if recorded.gaps else BLOCK
    with recorded, contextlib.suppress(LogExhaustedError):
        while not stop() and (frames is None or recorded.t < frames):
            recorded.take_all(step if frames is None else min(step, frames - recorded.t))
            progress(recorded.t)
