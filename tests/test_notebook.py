"""In Jupyter a view is a frame below its cell, and objects print facts about themselves."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from urllib.request import urlopen

import pytest

nbformat = pytest.importorskip("nbformat", reason="pip install nbclient ipykernel")
nbclient = pytest.importorskip("nbclient", reason="pip install nbclient ipykernel")

EXAMPLE = Path(__file__).parents[1] / "examples" / "notebook.py"


def test_the_example_shows_its_objects_and_serves_the_view(tmp_path: Path) -> None:
    code = re.findall(r"^# %%\n(.*?)(?=^# %%|\Z)", EXAMPLE.read_text("utf-8"), re.M | re.S)
    node = nbformat.v4.new_notebook(cells=list(map(nbformat.v4.new_code_cell, code)))
    where = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(node, timeout=120, resources=where)
    with client.setup_kernel():
        for index, cell in enumerate(node.cells):
            client.execute_cell(cell, index)
        *objects, view = [cell.outputs[-1].data for cell in node.cells]
        (address,) = re.findall(r'<iframe\s[^>]*src="(http[^"]+)"', view["text/html"])
        with contextlib.closing(urlopen(address, timeout=60)) as page:
            assert b"re_viewer" in page.read()
    assert all(data["text/plain"].startswith("<") for data in objects)
    assert len(nbformat.writes(node)) < 100_000  # and no code of the viewer
