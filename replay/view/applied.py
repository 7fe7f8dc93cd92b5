"""The outputs of frozen modules on the frames of a log, beside its images, as a Rerun view."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.modules import Module, columns_of
from replay.view.build import recording_to, view_entities
from replay.view.columns import MOST_STREAMS, Target
from replay.view.labels import label, part
from replay.view.layouts import blueprint, lines, near_axis, time_axis
from replay.view.panels import NEAR

if TYPE_CHECKING:
    from replay.export.applied import Applied

EVERY = 10
"""Of so many images one is kept; values all are."""


class ViewSink:
    """Writes the images of each stream and what each module gives there.

    `/outputs/<stream>/<module>` holds the outputs frame by frame; `/slowness/<stream>` of the first
    output of each module and `/novelty/<stream>` have a value a block, at its first frame.

    Args:
        recording: where they go.
        spec: of the frames.
        modules: in their order.
    """

    def __init__(
        self, recording: rr.RecordingStream, spec: SourceSpec, modules: Sequence[Module]
    ) -> None:
        self._recording, self._spec, self._end = recording, spec, 0
        self._modules = list(columns_of(modules))
        target, named = Target(recording, spec), [f"module {m.index}" for m, _ in self._modules]
        streams = [part(spec.streams, s) for s in range(len(spec.streams))]
        widths = [(m, range(1, len(m.phi) + 1)) for m, _ in self._modules]
        self._frames = [target.frames(entity) for entity in view_entities(spec)]
        self._slowness = [target.lines(f"slowness/{stream}", named) for stream in streams]
        self._novelty = [target.lines(f"novelty/{stream}", named) for stream in streams]
        self._outputs = [
            [
                target.lines(f"outputs/{stream}/{m.index}", [f"y{j}" for j in outputs], within=1)
                for m, outputs in widths
            ]
            for stream in streams
        ]

    def add(self, applied: Applied) -> None:
        """See `AppliedSink`."""
        block, s = applied.block, applied.block.stream
        frames = np.arange(block.t, block.t + len(block))
        self._end = max(self._end, block.t + len(block))
        kept = frames % (EVERY if self._spec.images else 1) == 0
        self._frames[s].add(frames[kept], None, block.frames[kept])
        slowness = applied.slowness[[own.start for _, own in self._modules]]
        slowness = np.where(np.isfinite(slowness), slowness, np.nan)
        self._slowness[s].add(frames[:1], None, slowness[None])
        self._novelty[s].add(frames[:1], None, applied.novelty[None])
        for (_, own), column in zip(self._modules, self._outputs[s], strict=True):
            column.add(frames, None, applied.y[:, own])

    def close(self) -> None:
        """See `AppliedSink`."""
        for column in chain(self._frames, self._slowness, self._novelty, *self._outputs):
            column.flush()
        tabs = [self._tab(s) for s in range(min(len(self._spec.streams), MOST_STREAMS))]
        self._recording.send_blueprint(blueprint(*tabs, name="Applied modules", length=self._end))

    def _tab(self, s: int) -> rrb.Container:
        """A stream: its images, how novel they are, and the outputs of each module."""
        stream, name = part(self._spec.streams, s), label(self._spec.streams[s])
        entity, axis = f"/{view_entities(self._spec)[s]}", time_axis(self._end)
        image = rrb.Spatial2DView(origin=entity, name=name)
        shown = rrb.Vertical(
            image if self._spec.images else lines(name, [entity], axis),
            lines("Novelty of blocks: known below 1", [f"/novelty/{stream}"], axis),
            lines("Slowness of first outputs [1/frame]", [f"/slowness/{stream}"], axis),
        )
        title = f"outputs on the last {NEAR} frames"
        outputs = [
            lines(f"Module {m.index}: {title}", [f"/outputs/{stream}/{m.index}"], near_axis(NEAR))
            for m, _ in self._modules
        ]
        return rrb.Horizontal(shown, rrb.Vertical(*outputs), column_shares=[2, 3], name=name)


@contextlib.contextmanager
def written_view(
    out: Path, spec: SourceSpec, modules: Sequence[Module], *, force: bool
) -> Iterator[ViewSink]:
    """Write a view of what modules give, whole when the body has ended.

    Args:
        out: the file.
        spec: of the source.
        modules: in their order.
        force: replace an existing file.

    Raises:
        UsageError: it exists.
        CdmisfaError: it cannot be written.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with recording_to(out, out.stem, out, force=force) as recording:
        view = ViewSink(recording, spec, modules)
        yield view
        view.close()
