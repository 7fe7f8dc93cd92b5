"""In Jupyter a view is a frame below its cell, and objects have tables and small images."""

from __future__ import annotations

import base64
import contextlib
import io
import re
from pathlib import Path
from urllib.request import urlopen

import pytest
from PIL import Image

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
    for number, shown in enumerate(objects):
        assert shown["text/plain"].startswith("<")
        if not number:  # a recording has facts alone
            continue
        (png,) = re.findall(r"data:image/png;base64,([^\"]+)", shown["text/html"])
        with Image.open(io.BytesIO(base64.b64decode(png))) as picture:
            assert picture.format == "PNG"
    assert len(nbformat.writes(node)) < 100_000  # and no code of the viewer
