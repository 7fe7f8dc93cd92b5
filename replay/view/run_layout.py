"""The layout of a run: the tables of its learner's tabs, its world, and its modules."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import rerun.blueprint as rrb

from cdmisfa.core.blocks import SourceSpec
from replay.runs.log import PHI_EVERY
from replay.runs.run import Outline
from replay.view import layouts
from replay.view.image_grid import GRID, grid_bounds, sheet_size
from replay.view.layouts import RECENT, Panel, Tab, Views, beside, curve_view, images
from replay.view.writer import MOST_STREAMS, Interval, Writer, drawable, for_stream

# Most modules with a page each; of more modules, the number on one page.
PAGES, MOST_MODULES = 12, 6

# Modules side by side in the tab on novelty.
ACROSS = 3

# Height of a panel of state timelines without its rows, and height of a row, in points.
ROW, LANE = 55, 40

# Most state timelines with full height; more are scrolled.
MOST_LANES = 9

# Height of a tab on a screen of 1280 x 720, and least height of a row of plots, in points.
HEIGHT, LEAST = 624, 60

# Share of an axis that is added on either side of its values.
MARGIN = 0.05


def run_layout(
    outline: Outline,
    writer: Writer | None = None,
    *,
    has_scene: bool = False,
    followed: Sequence[Panel] = (),
    sheets: Collection[int] = (),
    tab: str | None = None,
) -> rrb.Blueprint:
    """Return the layout of a run, ready to be sent.

    Where there is a world, or something is known of it, it comes first.

    Args:
        outline: outline of the run.
        writer: the written rows; None before there are any.
        has_scene: the world is there in 3D.
        followed: panels of what each module has learned.
        sheets: modules whose images of least to greatest output are there.
        tab: name of the tab that is open; by default the first.

    Raises:
        UsageError: the tab does not exist.
    """
    layout = RunLayout(outline, writer, has_scene=has_scene)
    tabs = [layout.world(followed)] if has_scene or followed else []
    tabs += map(layout.tab, layouts.tabs_of("progress" if outline.header.by_progress else "paper"))
    return layouts.blueprint(*tabs, layout.modules(sheets), name="Run", length=outline.end, tab=tab)


# Colors of weights of images.
COLOURS = " (blue < 0, orange > 0)"


class RunLayout:
    """The tabs of a run; they adapt to its streams and modules, and to the signals it has.

    Args:
        outline: outline of the run.
        writer: the written rows; None before there are any: then every panel is there.
        has_scene: the world is there in 3D.
    """

    def __init__(self, outline: Outline, writer: Writer | None, *, has_scene: bool) -> None:
        self._outline, self._header, self._end = outline, outline.header, outline.end
        self._writer, self._spec, self._has_scene = writer, outline.header.spec, has_scene
        keys = ("roc_error", "delta", "novel_share", "min_variance")
        self._facts = {key: f"{self._header.number(key) or 0.0:g}" for key in keys}
        self._facts["colours"] = COLOURS if self._spec.images else ""
        self._facts["interval"] = f", every {PHI_EVERY} blocks" if outline.iterations else ""

    def tab(self, tab: Tab) -> rrb.Container:
        """Return a tab of a table."""
        columns = [self._column(panels, tab.name) for panels in (tab.left, tab.panels) if panels]
        if len(columns) == 1:
            return columns[0]
        return rrb.Horizontal(*columns, column_shares=[2, 5], name=tab.name)

    def _column(self, panels: Sequence[Panel], name: str) -> rrb.Container:
        """Return panels below one another, and panels of modules beside one another."""
        placed: list[tuple[Panel, Views]] = []
        for panel in panels:
            if views := self._views(panel):
                if panel.beside and placed:
                    placed[-1][1].extend(views)
                else:
                    placed += [(panel, views[i : i + ACROSS]) for i in range(0, len(views), ACROSS)]
        heights = self._heights([panel for panel, _ in placed])
        return rrb.Vertical(*(beside(views) for _, views in placed), row_shares=heights, name=name)

    def _heights(self, panels: Sequence[Panel]) -> list[float]:
        """Return the heights of rows, such that a small screen shows each state timeline."""
        counts = [p.state_rows + (len(self._spec.streams) if p.per_stream else 0) for p in panels]
        high = [ROW + LANE * min(count, MOST_LANES) if count else 0 for count in counts]
        plots = sum(p.height for p, count in zip(panels, counts, strict=True) if not count)
        left = max(HEIGHT - sum(high), LEAST * counts.count(0))
        pairs = zip(panels, high, strict=True)
        return [float(height or left * panel.height / plots) for panel, height in pairs]

    def _views(self, panel: Panel) -> Views:
        """Return the views of a panel: none, one, or one for each module."""
        clusters, several = self._header.clusters, self._outline.outputs > 1
        when = {"bands": not clusters, "clusters": clusters, "outputs": several}
        if not when.get(panel.when, True):
            return []
        title = panel.title.format(i="{i}", **self._facts)
        if panel.kind == "states":
            return [layouts.state_rows(title, panel.entities, self._end)]
        if panel.kind == "recent states":
            title = f"{title}, last {layouts.RECENT_BLOCKS} blocks"
            blocks = layouts.RECENT_BLOCKS * max(self._outline.tau, 1)
            return [layouts.state_rows(title, panel.entities, recent=blocks, room=False)]
        if panel.kind == "summary":
            return [rrb.TextDocumentView(origin="/summary", name=title)]
        if panel.kind == "streams":
            return [self._streams(title)]
        if panel.kind == "input":
            return [self._input(title)]
        if panel.kind == "weights":
            paths = () if self._spec.kinds else panel.entities[:1]
            return [self._weights(path, title, self._spec) for path in paths]
        count = min(self._outline.modules, MOST_MODULES) if panel.each_module else 1
        views: Views = []
        for i in range(1, count + 1):
            entities = [entity.format(i=i) for entity in panel.entities]
            written = [e for e in entities if self._writer is None or self._writer.matching(e)]
            if entities[0] in written:
                views.append(self._plot(panel, title.format(i=i), written))
        return views

    def _plot(self, panel: Panel, title: str, entities: Sequence[str]) -> rrb.View:
        """Return the curves of a panel, with a legend where they are several."""
        several = len(entities) > 1 or "*" in entities[0] or self._outline.outputs > 1
        several |= entities[0] in ("/decision/attention", "/world/truth")
        recent, span = RECENT if panel.kind == "recent" else 0, self._span(panel, entities)
        legend = panel.legend and several
        return curve_view(title, entities, self._end, recent=recent, span=span, legend=legend)

    def _span(self, panel: Panel, entities: Sequence[str]) -> Interval | None:
        """Return the range of a panel's axis; None leaves it to the viewer."""
        if panel.low is not None and panel.high is not None:
            return panel.low, panel.high
        spans = [self._writer.covered(entity) for entity in entities if self._writer is not None]
        values = [value for span in spans if span for value in span]
        if not panel.fit or not values:
            return None
        low, high = min(values) if panel.low is None else panel.low, max(values)
        room = MARGIN * (high - low) or 0.1 * abs(high) or 1.0
        return (low - room if panel.low is None else low), high + room

    def world(self, followed: Sequence[Panel]) -> rrb.Container:
        """Return the tab with the world, current frame, results, events and followed quantities."""
        summary = rrb.TextDocumentView(origin="/summary", name="Results")
        words = rrb.Tabs(summary, layouts.events("Events"))
        if self._has_scene:
            right = rrb.Vertical(self._input("Current frame"), words, row_shares=[2, 4])
            above = rrb.Horizontal(layouts.scene(), right, column_shares=[5, 3])
        else:
            above = rrb.Horizontal(self._streams("Current frame"), words, column_shares=[5, 3])
        plots: Views = [self._plot(panel, panel.title, panel.entities) for panel in followed]
        below = [beside(plots[i : i + 2]) for i in range(0, len(plots), 2)]
        return rrb.Vertical(above, *below, row_shares=[5, *(2 for _ in below)], name="World")

    def modules(self, sheets: Collection[int]) -> rrb.Container:
        """Return the modules, each on a page of its own; many share pages."""
        count = max(self._outline.modules, len(self._outline.saved))
        truth = Panel("Ground truth", ("/world/truth",), "recent")
        known: Views = [*(self._views(truth) if self._spec.truth else ()), layouts.events("Events")]
        if not count:
            return rrb.Vertical(*known, name="Modules")
        pages: Views = []
        for start in range(1, count + 1, MOST_MODULES if count > PAGES else 1):
            page = range(start, min(start + MOST_MODULES, count + 1))
            if count > PAGES:
                pairs = (rrb.Horizontal(*self._module_views(i)) for i in page)
                pages.append(rrb.Vertical(*pairs, name=f"{page[0]} to {page[-1]}"))
            else:
                pages.append(self._module(start, has_sheet=start in sheets))
        return rrb.Tabs(*pages, rrb.Vertical(*known, name="Events"), name="Modules")

    def _module(self, i: int, *, has_sheet: bool) -> rrb.Container:
        """Return a module's page: weights, frames, and its output, also around its save."""
        left, output = ([view] for view in self._module_views(i))
        name = f"Module {i}"
        if has_sheet:
            title = "Frames with the least, middle and greatest output 1"
            width, height = sheet_size(*self._spec_of(i).frame_shape)
            bounds = grid_bounds(3, height, width, columns=1)
            left.append(images(f"/modules/{i}/sheet", title, bounds))
        for save in (save for save in self._outline.saved if save.module == i):
            name += f": {drawable(self._spec.streams[save.stream])}"
            blocks, saved = self._outline.blocks, save.t + self._outline.tau
            later = blocks.starts[(blocks.streams == save.stream) & (blocks.starts >= saved)]
            ends = {"before the save": saved}
            if len(later):
                ends["of the stream"] = int(later[-1]) + self._outline.tau
            entities = [f"/modules/{i}/output", f"/modules/{i}/saved"]
            windows: Views = [
                curve_view(f"Last {RECENT} frames {words}", entities, end, start=end - RECENT)
                for words, end in ends.items()
            ]
            output.append(beside(windows))
        columns = (rrb.Vertical(*views) for views in (left, output))
        return rrb.Horizontal(*columns, column_shares=[3, 4], name=name)

    def _module_views(self, i: int) -> Views:
        """Return a module's weights, and its output while its stream was attended."""
        spec = self._spec_of(i)
        colours = COLOURS if spec.images else ""
        output = f"Output of module {i} [SD] while its stream was attended"
        return [
            self._weights(f"/modules/{i}/weights", f"Weights of module {i}{colours}", spec),
            curve_view(output, [f"/modules/{i}/output", f"/modules/{i}/saved"], self._end),
        ]

    def _streams(self, title: str) -> rrb.View | rrb.Container:
        """Return the last image of each stream; of a scene or of numbers the input."""
        if self._has_scene or not self._spec.images:
            return self._input(title)
        count = min(len(self._spec.streams), MOST_STREAMS)
        bounds = grid_bounds(count, *self._spec.frame_shape)
        return images(f"/{GRID}", "Latest attended frame of each stream", bounds)

    def _input(self, name: str) -> rrb.View | rrb.Container:
        """Return the learner's input: an image with the name of its stream, or the last values."""
        if self._spec.images:
            height, width = self._spec.frame_shape
            # A fifth of it below for the name.
            return images("/world/watched", name, ((0, width), (0, height + 0.2 * height)))
        views: Views = []
        for s, stream in enumerate(self._spec.streams[:MOST_STREAMS] if self._spec.kinds else [""]):
            path = f"/{for_stream('world/watched', self._spec, s)}"
            title = drawable(stream) or "Input values"
            shows = self._spec.of(s).images
            views.append(images(path, title) if shows else curve_view(title, [path], recent=RECENT))
        whose = layouts.state_rows("Attended stream", ["/attended/each_block"], recent=RECENT)
        return rrb.Vertical(*views, whose, row_shares=[*(3 for _ in views), 2])

    def _spec_of(self, module: int) -> SourceSpec:
        """Return the spec of a module's stream."""
        streams = {save.module: save.stream for save in self._outline.saved}
        return self._spec.of(streams.get(module, 0))

    def _weights(self, path: str, name: str, spec: SourceSpec) -> rrb.View:
        outputs = self._outline.outputs
        if not spec.images:
            hidden = rrb.PlotLegend(visible=False)
            return rrb.BarChartView(origin=path, name=name, plot_legend=hidden)
        bounds = grid_bounds(outputs, *spec.frame_shape) if outputs > 1 else None
        return images(path, name, bounds)
