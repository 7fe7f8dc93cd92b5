"""What is in the file of a view: rows and styles by entity, and its layout."""

from __future__ import annotations

import fnmatch
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.chunk import RrdReader


def scalars(entity: dict[str, list[Any]]) -> NDArray[np.float64]:
    """(n, lines) numbers of an entity's rows."""
    return np.array(entity["Scalars:scalars"], dtype=np.float64)


class View:
    """A view as it stands in its file.

    Args:
        path: of the file.
        only: the one entity that is looked at.

    Attributes:
        rows: of each entity its columns over all chunks, in the order of frames.
        static: of each entity what is said of it once.
        names: of all entities.
        layout: the components of each part of the layout.
    """

    def __init__(self, path: Path, only: str = "") -> None:
        reader = RrdReader(str(path))
        self.rows: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
        self.static: dict[str, dict[str, Any]] = defaultdict(dict)
        self.layout: dict[str, dict[str, Any]] = defaultdict(dict)
        for chunk in reader.stream():
            if only and chunk.entity_path != only:
                continue  # to read numbers one by one takes long
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                times = batch.column(name).type == pa.timestamp("ns")
                values = batch.column(name).cast("int64") if times else batch.column(name)
                values = values.to_pylist()
                if chunk.is_static:
                    self.static[chunk.entity_path][name] = values[-1]
                else:
                    self.rows[chunk.entity_path][name] += values
        for entity, columns in self.rows.items():
            order = np.argsort(columns.get("frame", []), kind="stable")
            if len(order):
                self.rows[entity] = {
                    name: [values[i] for i in order]
                    for name, values in columns.items()
                    if len(values) == len(order)
                }
        self.names = {*self.rows, *self.static}
        self.blueprints = reader.blueprints()
        for store in self.blueprints:
            for chunk in reader.stream(store=store):
                batch = chunk.to_record_batch()
                for name in (name for name in batch.schema.names if ":" in name):
                    value = batch.column(name).to_pylist()[-1]
                    many = name in ("ViewContents:query", "ContainerBlueprint:contents")
                    self.layout[chunk.entity_path][name] = value if many else (value or [None])[0]

    def titles(self) -> list[str]:
        """What the views and containers of the layout are called."""
        result = (
            part.get(f"{kind}Blueprint:display_name")
            for part in self.layout.values()
            for kind in ("View", "Container")
        )
        return [name for name in result if name]

    def views(self, kind: str) -> list[tuple[str, list[str], Any, Any, Any]]:
        """Name, entities, range of time and of values, and legend of the views of a class."""
        result = []
        for path, parts in list(self.layout.items()):
            if parts.get("ViewBlueprint:class_identifier") == kind:
                query = self.layout[f"{path}/ViewContents"]["ViewContents:query"]
                origin = parts["ViewBlueprint:space_origin"]
                wanted = [q.replace("$origin", origin).replace("**", "*") for q in query]
                entities = [e for e in self.rows if any(fnmatch.fnmatchcase(e, w) for w in wanted)]
                time = self.layout[f"{path}/TimeAxis"].get("TimeAxis:view_range")
                values = self.layout[f"{path}/ScalarAxis"].get("ScalarAxis:range")
                legend = self.layout[f"{path}/PlotLegend"].get("PlotLegend:visible")
                result.append((parts["ViewBlueprint:display_name"], entities, time, values, legend))
        return result

    def contents(self) -> list[tuple[str, list[str]]]:
        """Name of each view of the layout, and the entities that it asks for."""
        result = []
        for path, parts in list(self.layout.items()):
            if "ViewBlueprint:class_identifier" in parts:
                origin = parts["ViewBlueprint:space_origin"]
                wanted = self.layout[f"{path}/ViewContents"]["ViewContents:query"]
                wanted = [origin] if wanted == ["$origin/**"] else wanted
                result.append((parts["ViewBlueprint:display_name"], wanted))
        return result

    def numbers(self, entity: str) -> NDArray[np.float64]:
        """All numbers of an entity, without NaN, (n,)."""
        values = np.ravel(scalars(self.rows[entity])) if entity in self.rows else np.empty(0)
        return values[np.isfinite(values)]

    def states(self, entity: str) -> list[tuple[int, str]]:
        """The states of a lane in the order of time, with their frames."""
        rows = self.rows[entity]
        return [(t, s) for t, (s,) in zip(rows["frame"], rows["StateChange:state"], strict=True)]


def views_of(part: Any) -> list[Any]:
    """All views in a container, tabs too."""
    if isinstance(part, rrb.View):
        return [part]
    return [view for inner in part.contents for view in views_of(inner)]
