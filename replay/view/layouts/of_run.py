"""Which layout a run gets: the story of the learner that it is of."""

from __future__ import annotations

import rerun.blueprint as rrb

from replay.runs.run import Outline
from replay.view.layouts.first import first_tab
from replay.view.layouts.panels import Panels
from replay.view.layouts.paper import paper_layout
from replay.view.layouts.progress import progress_layout
from replay.view.world.first import First


def run_layout(
    outline: Outline,
    first: First,
    *,
    all_views: bool = False,
    head: bool = False,
    tab: str | None = None,
) -> rrb.Blueprint:
    """The layout of a run, ready to be sent.

    Args:
        outline: the run in short.
        first: what the first tab shows.
        all_views: what was not watched is there too.
        head: where the head was turned is there too.
        tab: name of the tab that is open; by default the first.

    Raises:
        UsageError: there is no such tab.
    """
    layout = progress_layout if outline.header.by_progress else paper_layout
    panels = Panels(outline, all_views=all_views, head=head, tab=tab)
    own = layout(panels)
    return panels.tabs(first_tab(panels, first), *own)
