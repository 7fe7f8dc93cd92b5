"""Record a source while a learner learns from it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

from cdmisfa.core.blocks import Block, ForwardSource, FrameSource, check_request
from cdmisfa.core.errors import LogExhaustedError
from recorder.config import RecordConfig
from recorder.log.files import local_folder, prepared_folder, refuse_existing
from recorder.log.resume import begin_view, other_recordings
from recorder.recording import ViewLogs, ViewRecording, recording_spec
from recorder.world.scenes import BLOCK

# Name of the metadata record with the numbers of used and dropped images of a live stream.
COUNTS: Final = "cdmisfa.live"


class LiveRecorder(ForwardSource):
    """Source that records every stream of another source, whichever the learner attends to.

    The recording gives the blocks of `take` again, bit for bit: `learn` from both gives the same
    signals. Use it as a context manager: leaving the context finishes the files, also if the source
    has ended or learning was stopped; an error leaves readable `.partial` files.

    Args:
        source: a source at its first frame, such as cameras that cannot go back; it is closed
            together with this object.
        folder: folder of the recording; it is created if missing.
        settings: settings of the files; the clock is that of the source.
        split: length of the parts of every view (s); None: one file.
        force: True to overwrite an earlier recording in the folder.

    Attributes:
        files: files of the recording after it is finished.
        ended: the message with which the source ended, or "".

    Raises:
        UsageError: the folder exists, or a recording cannot hold the source.
        LogWriteError: a file cannot be written.
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
        self.folder = local_folder(folder)
        self.gaps = bool(getattr(source, "gaps", False))
        refuse_existing(self.folder, force=force, resumable=False)
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
        """See `LiveSource`; empty for sources that do not count images."""
        return getattr(self._source, "alignment", {})

    @property
    def stop(self) -> Callable[[], bool]:
        """Function that the source calls while it waits; True ends the wait."""
        return getattr(self._source, "stop", lambda: False)

    @stop.setter
    def stop(self, stop: Callable[[], bool]) -> None:
        if hasattr(self._source, "stop"):
            self._source.stop = stop

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Record the next frames, and return them; see `FrameSource`."""
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


def record_live(
    recorder: LiveRecorder,
    *,
    frames: int | None = None,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[float], None] = lambda done: None,
) -> None:
    """Record until the source ends or is stopped; then finish the recording.

    Args:
        recorder: the recorder, whose context is entered and left here.
        frames: number of frames; None: up to the end of the source.
        stop: called often; True ends the recording.
        progress: called with the number of frames.

    Raises:
        LogWriteError: a file cannot be written.
    """
    recorder.stop = stop
    step = 1 if recorder.gaps else BLOCK
    with recorder, contextlib.suppress(LogExhaustedError):
        while not stop() and (frames is None or recorder.t < frames):
            recorder.take_all(step if frames is None else min(step, frames - recorder.t))
            progress(recorder.t)
