"""A run in the viewer while it learns.

Signals are kept in memory and handed over in large pieces, so that the learner hardly waits.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.learning import Learner, Sink, weights_after
from cdmisfa.core.signals import NO_STATE, SIGNALS, BlockSignals
from replay.runs.columns import Blocks, columns_of_records
from replay.runs.log import Batch, Frames, RunHeader, read_batches
from replay.runs.run import LINES, Outline
from replay.view.build import APPLICATION
from replay.view.columns import MOST_STREAMS, Target
from replay.view.modules import ModulesView
from replay.view.panels import MOST_MODULES, run_layout
from replay.view.run import RunView
from replay.view.world import WorldView

EVERY_SECONDS = 1.5
"""Time between two pieces."""

SUMMARY = "It is being learned. What came of it stands in the view of the finished run."

EVERY_FRAMES = 10
"""Frames between two at which it is said where things are."""

MOST_BLOCKS = 500
"""Most blocks that wait, however quick the learner is."""

PIECE = 10
"""Blocks of which lanes say what was mostly the case: how many there will be is not known."""


class LiveView(Sink):
    """Shows a run to viewers on this machine while it learns.

    Args:
        spec: what the learner's source delivers.
        manifest: what the run was started with, as for `RunWriter`.
        tau: frames of a block.
        outputs: outputs of an abstraction.
        run: its folder, where it has one.

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
        outline = _nothing_yet(RunHeader(spec, manifest), tau, outputs)
        self._recording = rr.RecordingStream(APPLICATION, recording_id=f"live-{os.getpid()}")
        self._recording.set_log_time_enabled(False)
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        sink = rr.GrpcServerSink("127.0.0.1", port)
        self._recording.set_sinks(sink)
        self.address = str(sink.uri)
        self._recording.send_recording_name("live")
        self._recording.log("summary", rr.TextDocument(SUMMARY), static=True)
        streams = outline.streams(MOST_STREAMS)
        self._world = WorldView(
            self._recording, outline.header, run or Path(), streams, EVERY_FRAMES
        )
        self._recording.send_blueprint(run_layout(outline, self._world.tab()))
        # No image is left out here: of each block only the first is taken.
        self._view = RunView(self._recording, outline.header, streams, every=1, piece=PIECE)
        self._modules = ModulesView(Target(self._recording, spec))
        for note in self._world.notes:
            self._view.event(0, 0, note, "WARN")
        self._images = spec.images
        self._next = time.monotonic() + EVERY_SECONDS
        self._forget()

    def _forget(self) -> None:
        self._records: list[BlockSignals] = []
        self._watched: list[NDArray[Any]] = []
        self._truth: list[NDArray[np.float64]] = []
        self._phi: list[tuple[int, NDArray[np.float64]]] = []

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """Take what one iteration gave; see `Sink`."""
        if self._records and not self._records[-1].saved:
            self._phi.pop()  # of the abstraction's weights, the last and the saved ones are shown
        self._phi.append((block.t, weights_after(signals, learner)))
        self._records.append(signals)
        self._watched.append(block.frames[:1].copy() if self._images else block.frames)
        self._truth.append(block.truth)
        if len(self._records) >= MOST_BLOCKS or time.monotonic() >= self._next:
            self.flush()

    def earlier(self, run: Path) -> None:
        """Show what the log of a resumed run holds already, before its next block.

        Raises:
            UsageError: there is no such run.
            LogDamagedError: its log cannot be read.
        """
        for batch in read_batches(run):
            if self._images:
                batch = replace(batch, watched=_first_of_blocks(batch))
            self._show(batch)

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Say in words what happened; see `Sink`."""
        self._view.event(t, iteration, text, level)

    def finish(self) -> None:
        """Hand over the rest; viewers are served until `close`."""
        self.flush()

    def flush(self) -> None:
        """Hand over everything that waits."""
        if self._records:
            starts, tau = np.array([s.t for s in self._records]), len(self._records[-1].y)
            every = (starts[:, None] + np.arange(tau)).reshape(-1)
            at = starts if self._images else every
            signals = tuple(columns_of_records(self._records))
            self._show(
                Batch(
                    signals=signals,
                    blocks=Blocks.concatenated([*map(Blocks.of, signals)]),
                    watched=((at, np.concatenate(self._watched)),),
                    truth=((every, np.concatenate(self._truth)),),
                    phi=tuple(self._phi),
                    events=(),
                )
            )
            self._forget()
        self._next = time.monotonic() + EVERY_SECONDS

    def _show(self, batch: Batch) -> None:
        self._view.take(batch)
        self._world.take(batch)
        for columns in batch.signals:
            self._view.threshold(columns.frames[-1:], columns.iterations[-1:])
        self._modules.take(batch)
        self._modules.flush()
        self._view.flush()
        self._world.flush()

    def close(self) -> None:
        """Hand over the rest and stop serving; a viewer keeps what it has."""
        self.flush()
        self._recording.flush()
        self._recording.disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _first_of_blocks(batch: Batch) -> tuple[Frames, ...]:
    """Of each block's pictures the first one that its log has, wherever the block begins."""
    pieces = ((np.diff(batch.blocks.places(at), prepend=-1), at, p) for at, p in batch.watched)
    return tuple((at[begins != 0], pictures[begins != 0]) for begins, at, pictures in pieces)


def _nothing_yet(header: RunHeader, tau: int, outputs: int) -> Outline:
    """A run that has not begun: there may come as many modules as there are streams."""
    streams = len(header.spec.streams)
    return Outline(
        header=header,
        iterations=0,
        frames=0,
        blocks=Blocks.concatenated(()),
        end=0,
        tau=tau,
        outputs=outputs,
        modules=min(streams, MOST_MODULES),
        visits=np.zeros(streams, dtype=np.int64),
        saved=(),
        last=None,
        lines={name: np.empty(0) for name in LINES},
        told=frozenset(SIGNALS),
        states=(NO_STATE,) * streams,
    )
