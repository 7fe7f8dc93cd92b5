"""The outputs of frozen modules on the frames of a log, beside its images, as a Rerun view."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.modules import Module, columns_of
from replay.view.build import recording_to, view_entities
from replay.view.layouts import RECENT, blueprint, curve_view, images
from replay.view.writer import MOST_STREAMS, Writer, drawable, part

if TYPE_CHECKING:
    from replay.export.applied import Applied, AppliedSink

# Frames from one image that is drawn to the next; values are all drawn.
EVERY = 10


class ViewSink:
    """Writes the images of each stream and the outputs of each module on them.

    `/outputs/<stream>/<module>` holds the outputs frame by frame; `/block_slowness/<stream>` of the
    first output of each module and `/novelty/<stream>` have a value a block, at its first frame.

    Args:
        recording: where they go.
        spec: specification of the source.
        modules: the modules in order.
    """

    def __init__(
        self, recording: rr.RecordingStream, spec: SourceSpec, modules: Sequence[Module]
    ) -> None:
        self._recording, self._spec, self._end = recording, spec, 0
        self._writer, self._modules = Writer(recording, spec), list(columns_of(modules))

    def add(self, applied: Applied) -> None:
        """Write the outputs on a block."""
        block, s = applied.block, applied.block.stream
        stream = part(self._spec.streams, s)
        frames = np.arange(block.t, block.t + len(block))
        self._end = max(self._end, block.t + len(block))
        drawn = frames % (EVERY if self._spec.of(s).images else 1) == 0
        at = frames[drawn], None
        self._writer.frames(view_entities(self._spec)[s], at, block.frames[drawn], s)
        first, names = (frames[:1], None), [f"module {m.index}" for m, _ in self._modules]
        slowness = applied.block_slowness[[columns.start for _, columns in self._modules]]
        slowness = np.where(np.isfinite(slowness), slowness, np.nan)
        self._writer.lines(f"block_slowness/{stream}", names, first, slowness[None])
        self._writer.lines(f"novelty/{stream}", names, first, applied.novelty[None])
        for module, columns in self._modules:
            outputs = [f"y{label}" for label in module.labels]
            path = f"outputs/{stream}/{module.index}"
            self._writer.lines(path, outputs, (frames, None), applied.y[:, columns], gap=1)

    def close(self) -> None:
        """Write what waits, and the layout of the view."""
        self._writer.flush()
        tabs = [self._tab(s) for s in range(min(len(self._spec.streams), MOST_STREAMS))]
        self._recording.send_blueprint(blueprint(*tabs, name="Applied modules", length=self._end))

    def _tab(self, s: int) -> rrb.Container:
        """Return a stream's tab: its images, how novel they are, and the outputs of each module."""
        stream, name = part(self._spec.streams, s), drawable(self._spec.streams[s])
        entity, end = f"/{view_entities(self._spec)[s]}", self._end
        column = rrb.Vertical(
            images(entity, name) if self._spec.of(s).images else curve_view(name, [entity], end),
            curve_view("Novelty of each block: explained up to 1", [f"/novelty/{stream}"], end),
            curve_view(
                "Slowness within each block, first outputs [cycles/frame]",
                [f"/block_slowness/{stream}"],
                end,
            ),
        )
        outputs = [
            curve_view(f"Module {m.index}: y [SD]", [f"/outputs/{stream}/{m.index}"], recent=RECENT)
            for m, _ in self._modules
        ]
        return rrb.Horizontal(column, rrb.Vertical(*outputs), column_shares=[2, 3], name=name)


@contextlib.contextmanager
def written_view(out: Path, spec: SourceSpec, modules: Sequence[Module]) -> Iterator[AppliedSink]:
    """Yield a sink that writes a view of modules' outputs, whole when the body has ended.

    Args:
        out: the file.
        spec: specification of the source.
        modules: the modules in order.

    Raises:
        CdmisfaError: it cannot be written.
    """
    with recording_to(out, out.stem, out, force=True) as recording:
        view = ViewSink(recording, spec, modules)
        yield view.add
        view.close()
