"""Show a run in the viewer while it learns.

Signals are buffered and written in large pieces, so that the learner hardly waits.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, FrameKind, SourceSpec
from cdmisfa.core.learning import Learner, Sink, weights_after
from cdmisfa.core.signals import BlockSignals
from replay.runs.columns import Blocks, columns_of_records
from replay.runs.log import Batch, RunHeader, read_batches
from replay.runs.run import Tally
from replay.view.build import APPLICATION
from replay.view.run import RunView
from replay.view.run_layout import MOST_MODULES, run_layout
from replay.view.scene import SceneView
from replay.view.writer import MOST_STREAMS, Writer

# Seconds between two pieces: a shorter interval slows the learner, a longer one the display.
EVERY_SECONDS = 1.5

# Frames between two poses of the scene, and between two logged images.
EVERY_FRAMES = 10

# Most buffered blocks, which bounds the memory of a fast learner.
MOST_BLOCKS = 500

# Blocks per state in timelines of most blocks: fixed, as the length of the run is unknown.
PIECE = 10


class LiveView(Sink):
    """Shows a run to viewers on this machine while it learns.

    Args:
        spec: what the learner's source delivers.
        manifest: what the run was started with, as for `RunWriter`.
        tau: frames of a block.
        outputs: outputs of an abstraction.
        run: folder of the run, if it has one.

    Attributes:
        address: where Rerun's viewers connect, on this machine.
    """

    def __init__(
        self,
        spec: SourceSpec,
        manifest: Mapping[str, Any],
        tau: int,
        outputs: int,
        *,
        run: Path | None = None,
    ) -> None:
        header = RunHeader(spec, manifest)
        modules = min(len(spec.streams), MOST_MODULES)  # as many as there may come
        empty = replace(Tally(header).outline(), tau=tau, outputs=outputs, modules=modules)
        self._recording = rr.RecordingStream(APPLICATION, recording_id=f"live-{os.getpid()}")
        self._recording.set_log_time_enabled(False)
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        sink = rr.GrpcServerSink("127.0.0.1", port)
        self._recording.set_sinks(sink)
        self.address = str(sink.uri)
        self._recording.send_recording_name("live")
        self._writer = writer = Writer(self._recording, spec)
        text = "The run has not finished: results follow at its end."
        writer.log("summary", rr.TextDocument(text))
        shown = empty.streams(MOST_STREAMS)
        self._view = RunView(writer, header, shown, run or Path(), every=EVERY_FRAMES, piece=PIECE)
        has_scene = isinstance(self._view.world, SceneView)
        self._recording.send_blueprint(run_layout(empty, has_scene=has_scene))
        self._spec = spec
        self._next = time.monotonic() + EVERY_SECONDS
        self._clear()

    def _clear(self) -> None:
        self._records: list[BlockSignals] = []
        self._watched: dict[FrameKind, list[tuple[NDArray[Any], NDArray[Any]]]] = {}
        self._truth: list[NDArray[np.float64]] = []
        self._phi: list[tuple[int, NDArray[np.float64]]] = []

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """Take what one iteration gave; see `Sink`."""
        if self._records and not self._records[-1].saved:
            self._phi.pop()  # of the abstraction's weights, the last and the saved ones are shown
        self._phi.append((block.t, weights_after(signals, learner)))
        self._records.append(signals)
        count = 1 if self._spec.of(block.stream).images else len(block)
        watched = self._watched.setdefault(self._spec.kind(block.stream), [])
        watched.append((block.t + np.arange(count), block.frames[:count].copy()))
        self._truth.append(block.truth)
        if len(self._records) >= MOST_BLOCKS or time.monotonic() >= self._next:
            self.flush()

    def earlier(self, run: Path) -> None:
        """Show what the log of a resumed run holds already, before its next block.

        Raises:
            UsageError: the run does not exist.
            LogDamagedError: its log cannot be read.
        """
        for batch in read_batches(run, every=EVERY_FRAMES):
            self._view.take(batch)
            self._writer.flush()

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Log the text of an event; see `Sink`."""
        self._writer.event(t, iteration, text, level)

    def finish(self) -> None:
        """Write the rest; viewers are served until `__exit__`."""
        self.flush()

    def flush(self) -> None:
        """Write everything that waits."""
        if self._records:
            starts, tau = np.array([s.t for s in self._records]), len(self._records[-1].y)
            frames = (starts[:, None] + np.arange(tau)).reshape(-1)
            signals = tuple(columns_of_records(self._records))
            watched = (zip(*of_kind, strict=True) for of_kind in self._watched.values())
            batch = Batch(
                signals=signals,
                blocks=Blocks.concatenated([*map(Blocks.of, signals)]),
                watched=tuple((np.concatenate(t), np.concatenate(x)) for t, x in watched),
                truth=((frames, np.concatenate(self._truth)),),
                phi=tuple(self._phi),
                events=(),
            )
            self._view.take(batch)
            self._clear()
        self._writer.flush()
        self._next = time.monotonic() + EVERY_SECONDS

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Write the rest and stop serving; a viewer keeps its data."""
        self.flush()
        self._recording.flush()
        self._recording.disconnect()
