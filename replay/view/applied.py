"""What frozen modules give on the frames of a log, beside its pictures, as a Rerun view."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.modules import Module, columns_of
from replay.palette import BROWN, GREY, LILAC, MIST, colour, packed_all
from replay.view.build import recording_to, view_entities
from replay.view.columns import MOST_STREAMS, Target
from replay.view.labels import label, part
from replay.view.layouts import blueprint, heights, lines, near, near_axis, time_axis
from replay.view.panels import NEAR

if TYPE_CHECKING:
    from replay.export.applied import Applied

EVERY: Final = 10
"""Of so many images one is kept; values all are."""

STATES: Final = {"known": MIST, "novel": LILAC, "not alive": BROWN}
"""What a block is to a module, with the colours of lanes."""


class ViewSink:
    """The pictures of each stream, and what each module gives there.

    `/outputs/<stream>/<module>` holds the outputs frame by frame; `/slowness/<stream>`, of the
    first output of each module, and `/novelty/<stream>` hold a value a block, from its first frame
    on; `/known/<stream>/<module>` is a lane.

    Args:
        recording: where they go.
        spec: of the frames.
        modules: in their order.
    """

    def __init__(
        self, recording: rr.RecordingStream, spec: SourceSpec, modules: Sequence[Module]
    ) -> None:
        self._target, self._spec = Target(recording, spec), spec
        self._modules = list(columns_of(modules))
        self._firsts = [own.start for _, own in self._modules]
        width = len(str(modules[-1].index))
        self._names = [f"{module.index:0{width}}" for module in modules]
        self._streams = [part(spec.streams, s) for s in range(len(spec.streams))]
        line = self._target.lines
        rgbs = [colour(i) for i in range(len(modules))]
        named = [f"module {module.index}" for module in modules]
        self._frames = [self._target.frames(entity) for entity in view_entities(spec)]
        self._outputs = [
            [
                line(
                    f"outputs/{stream}/{name}",
                    [f"y{j + 1}" for j in range(own.stop - own.start)],
                    within=1,
                )
                for name, (_, own) in zip(self._names, self._modules, strict=True)
            ]
            for stream in self._streams
        ]
        self._slowness = [line(f"slowness/{s}", named, rgbs, steps=True) for s in self._streams]
        bound = [*named, "known below 1"], [*rgbs, GREY]
        self._novelty = [line(f"novelty/{s}", *bound, steps=True) for s in self._streams]
        self._states: dict[str, str] = {}
        self._ends: dict[int, int] = {}

    def add(self, applied: Applied) -> None:
        """See `AppliedSink`."""
        block, stream = applied.block, applied.block.stream
        frames = np.arange(block.t, block.t + len(block))
        if block.t > (end := self._ends.get(stream, block.t)):  # frames are missing
            self._tell(stream, end, np.full((2, len(self._names)), np.nan), [""] * len(self._names))
        self._ends[stream] = block.t + len(block)
        kept = frames % (EVERY if self._spec.images else 1) == 0
        self._frames[stream].add(frames[kept], None, block.frames[kept])
        for (_, own), column in zip(self._modules, self._outputs[stream], strict=True):
            column.add(frames, None, applied.y[:, own])
        slowness = applied.slowness[self._firsts]
        slowness = np.where(np.isfinite(slowness), slowness, np.nan)
        known = np.where(applied.novelty < 1, "known", "novel")
        states = np.where(applied.alive, known, "not alive").tolist()
        self._tell(stream, block.t, np.stack([slowness, applied.novelty]), states)

    def close(self) -> None:
        """See `AppliedSink`."""
        for column in (*self._frames, *self._slowness, *self._novelty):
            column.flush()
        for outputs in self._outputs:
            for column in outputs:
                column.flush()
        for stream, end in self._ends.items():
            for name in self._names:
                self._enter(stream, name, end, "")
        tabs = [self._tab(s) for s in range(min(len(self._streams), MOST_STREAMS))]
        layout = blueprint(*tabs, name="Applied modules", length=self._end)
        self._target.recording.send_blueprint(layout)

    @property
    def _end(self) -> int:
        return max(self._ends.values(), default=0)

    def _tell(self, stream: int, t: int, values: FloatArray, states: Sequence[str]) -> None:
        """From a frame on, slowness and novelty, (2, M), and what the block is to each module."""
        at = np.array([t])
        self._slowness[stream].add(at, None, values[:1])
        self._novelty[stream].add(at, None, np.append(values[1], 1.0)[None])
        for name, state in zip(self._names, states, strict=True):
            self._enter(stream, name, t, state)

    def _enter(self, stream: int, module: str, frame: int, state: str) -> None:
        """Begin a state of a module's lane, where it is another one."""
        lane = f"known/{self._streams[stream]}/{module}"
        if lane not in self._states:
            names, rgbs = list(STATES), packed_all(list(STATES.values()))
            known = rr.StateConfiguration(values=names, labels=names, colors=rgbs)
            self._target.log(lane, known)
        if self._states.get(lane) == state:
            return
        self._states[lane] = state
        times = self._target.times(np.array([frame]))
        self._target.recording.send_columns(lane, times, rr.StateChange.columns(state=[state]))

    def _tab(self, s: int) -> rrb.Container:
        """A stream: what it shows and how well it is known, and the outputs of each module."""
        stream, name, axis = self._streams[s], label(self._spec.streams[s]), time_axis(self._end)
        entity = f"/{view_entities(self._spec)[s]}"
        shown: rrb.View = lines("What it shows", [entity], axis)
        if self._spec.images:
            shown = rrb.Spatial2DView(origin=entity, name="What it shows")
        lanes = rrb.StateTimelineView(
            origin="/",
            contents=[f"/known/{stream}/**"],
            name="Which modules know it",
            time_view=time_axis(self._end, lanes=True),
        )
        how = rrb.Vertical(
            shown,
            lanes,
            lines("Novelty of blocks", [f"/novelty/{stream}"], axis, legend=False),
            lines("Slowness of first outputs [1/frame]", [f"/slowness/{stream}"], axis),
            row_shares=[200, heights(len(self._names)), 150, 150],
        )
        shortly = near_axis(NEAR)
        outputs = [
            lines(
                f"Module {int(module)}: outputs on the last {NEAR} frames",
                [f"/outputs/{stream}/{module}"],
                shortly,
                within=near(NEAR),
            )
            for module in self._names
        ]
        return rrb.Horizontal(how, rrb.Vertical(*outputs), column_shares=[2, 3], name=name)


@contextlib.contextmanager
def written_view(
    out: Path, spec: SourceSpec, modules: Sequence[Module], *, force: bool
) -> Iterator[ViewSink]:
    """A view of what modules give, whole when the body has ended.

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
