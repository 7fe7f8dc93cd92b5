"""Runs to write reports of, and what a page says."""

from __future__ import annotations

import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from run_data import DELTA, IMAGE, module_of, write_run

from cdmisfa.core.blocks import SourceSpec
from replay.runs.modules import save_modules
from replay.runs.run import read_outline

HOSTILE = (
    "<img src=x onerror=alert(1)>",
    "o'\"brien & sons</script><script>alert(2)</script>",
    "right",
)
RULES = {"novel_share": 0.9, "min_variance": 0.1, "eta_dot_window": 8}


def pictured_run(folder: Path, spec: SourceSpec | None = None, iterations: int = 60) -> Path:
    """A run of pictures, of streams with hostile names, with three modules and a run.json."""
    spec = spec or dataclasses.replace(IMAGE, streams=HOSTILE)
    folder.mkdir(parents=True)
    log = folder / "run.mcap"
    write_run(log, spec, iterations, saves=True, learner={"delta": DELTA, **RULES})
    rng = np.random.default_rng(5)
    size = int(np.prod(spec.frame_shape))
    modules = [
        module_of(
            save.module,
            save.iteration,
            rng.standard_normal((2, size)),
            save.stream,
            spec.streams[save.stream],
        )
        for save in read_outline(log).saved
    ]
    two = {"eta": np.array([0.0123, 0.2]), "band_mean": np.zeros(2), "band_sd": np.ones(2)}
    modules = [dataclasses.replace(m, **two, slow=np.array([1, 0])) for m in modules]
    save_modules(folder / "modules.npz", modules)
    result = {"ended": "max_modules", "signals_sha256": "ab" * 32, "streams": []}
    (folder / "run.json").write_text(json.dumps({"schema": 1, "result": result}))
    return folder


class _Text(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self._inside = ""

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.append((tag, dict(attrs)))
        self._inside = tag

    def handle_data(self, data: str) -> None:
        if self._inside not in ("script", "style"):
            self.text.append(data)


class Page:
    """A report as a browser reads it: its words, its elements, its frames."""

    def __init__(self, path: Path) -> None:
        self.source = path.read_text("utf-8")
        parser = _Text()
        parser.feed(self.source)
        self.tags = parser.tags
        self.text = re.sub(r"\s+", " ", " ".join(parser.text))
        result = re.search(r'<script type="application/json"[^>]*>(.*?)</script>', self.source)
        assert result is not None
        self.frames: dict[str, Any] = json.loads(result[1])

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.tags)
