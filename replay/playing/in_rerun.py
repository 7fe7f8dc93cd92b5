"""A recording in the Rerun viewer as it was seen."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr

from cdmisfa.core.clock import NANOSECONDS
from replay.camera_logs.options import CameraOptions
from replay.inputs import Logged
from replay.playing.feed import frames_of, opened_source
from replay.playing.pace import Played, paced, rounds
from replay.view.columns import frames_column, line_column
from replay.view.labels import label
from replay.view.properties import APPLICATION
from replay.view.recording import recording_layout, view_entities
from replay.viewer.broadcast import Broadcast

NAME: Final = "played.rrd"

PER_SECOND: Final = 60
"""Most times a second that viewers are handed what they show."""


def play_in_rerun(
    paths: Sequence[Path],
    *,
    rate: float = 1.0,
    loop: bool = False,
    fps: float | None = None,
    cameras: CameraOptions | None = None,
    about: Callable[[Logged], None] = lambda source: None,
    port: int | None = None,
    announce: Callable[[str], None] = lambda address: None,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[float, float | None], None] = lambda done, total: None,
) -> Played:
    """Serve a recording's frames to Rerun viewers on this machine when they are due.

    Args:
        paths: the recording's folder, or files; or camera logs of others.
        rate: how many seconds of the recording pass in one.
        fps: frames a second of logs that tell none, as folders of pictures.
        cameras: what is taken of camera logs of others; their rate is `fps`.
        about: given what is played frame by frame before that, to say what it is.
        loop: begin again at the end, at a later time.
        port: to listen at; by default a free one.
        announce: called with the address.
        stop: asked while waiting; true ends it.
        progress: told the seconds that were played, and all that there are.

    Raises:
        UsageError: no such log.
        LogDamagedError: it is damaged.
        CdmisfaError: the port is taken, or Rerun is switched off.
    """
    played = Played()
    with contextlib.ExitStack() as stack:
        source = stack.enter_context(opened_source(paths, fps, cameras, about))
        spec, first, count = source.spec, source.t, source.frames
        recording = rr.RecordingStream(APPLICATION, recording_id=f"played-{os.getpid()}")
        recording.set_log_time_enabled(False)
        broadcast = Broadcast(recording, NAME, port)
        stack.callback(broadcast.close)
        recording.send_recording_name(label(paths[0].resolve().stem))
        recording.send_blueprint(recording_layout(spec, first + count))
        columns = [frames_column(recording, spec, entity) for entity in view_entities(spec)]
        truth = None
        if spec.truth:
            truth = line_column(recording, spec, "world/truth", spec.truth, every_frame=True)
        every = [*columns, *([truth] if truth is not None else [])]
        broadcast.hand_over()
        announce(broadcast.address)
        start, last = spec.time_ns(first), spec.time_ns(first + count - 1)
        total = None if loop else (last - start) / NANOSECONDS
        next_time = 0.0
        items = rounds(lambda: frames_of(source, first), start, last, loop=loop)
        for number, (_, frame) in enumerate(paced(items, rate, played, stop=stop)):
            t = np.array([first + number])
            for column, shown in zip(columns, frame.shown, strict=True):
                if shown is not None:
                    column.add(t, None, shown[None])
            if truth is not None and frame.truth is not None:
                truth.add(t, None, frame.truth[None])
            if (now := time.monotonic()) >= next_time:
                next_time = now + 1 / PER_SECOND
                for column in every:
                    column.flush()
                broadcast.hand_over()
                progress(played.seconds, total)
        for column in every:
            column.flush()
    return played
