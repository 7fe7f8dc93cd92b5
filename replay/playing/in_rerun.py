"""A recording in the Rerun viewer as it was seen."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from replay.playing.feed import Playback, Played, frames_feed, opened_source, paced
from replay.view.build import recording_layout, view_entities
from replay.view.columns import Target
from replay.view.labels import label
from replay.viewer.broadcast import Broadcast

PER_SECOND: Final = 20
"""Most times a second that viewers are handed what they show: a browser that draws without a
graphics card takes about 25 pieces a second, and would come to lag behind."""


def play_in_rerun(
    paths: Sequence[Path],
    how: Playback,
    *,
    port: int | None = None,
    announce: Callable[[Broadcast], None] = lambda broadcast: None,
) -> Played:
    """Serve a recording's frames to Rerun viewers on this machine when they are due.

    Args:
        paths: the recording's folder, or files; or camera logs of others.
        how: it is played.
        port: to listen at; by default a free one.
        announce: called with what viewers are served.

    Raises:
        UsageError: no such log.
        LogDamagedError: it is damaged.
        CdmisfaError: the port is taken, or Rerun is switched off.
    """
    played = Played()
    with contextlib.ExitStack() as stack:
        source = stack.enter_context(opened_source(paths, how))
        spec, first, feed = source.spec, source.t, frames_feed(source)
        broadcast = Broadcast("played", port)
        stack.callback(broadcast.close)
        recording = broadcast.recording
        recording.send_recording_name(label(paths[0].resolve().stem))
        recording.send_blueprint(recording_layout(spec, first + source.frames))
        target = Target(recording, spec)
        columns = [target.frames(entity) for entity in view_entities(spec)]
        if spec.truth:
            columns.append(target.lines("world/truth", spec.truth, within=1))
        broadcast.hand_over()
        announce(broadcast)
        next_time = 0.0
        for number, (_, frame) in enumerate(paced(feed, how, played)):
            for column, value in zip(columns, (*frame.shown, frame.truth), strict=False):
                if value is not None:
                    column.add(np.array([first + number]), None, value[None])
            if (now := time.monotonic()) >= next_time:
                next_time = now + 1 / PER_SECOND
                for column in columns:
                    column.flush()
                broadcast.hand_over()
                how.progress(played.seconds, feed.seconds(how))
        for column in columns:
            column.flush()
    return played
