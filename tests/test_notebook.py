"""In Jupyter a view is a frame below its cell, with a picture where that cannot be."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import html
import http.client
import io
import re
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, urlsplit

import pytest
from browser import chromium, drawn, errors
from PIL import Image

from replay.viewer.web import FRAMED, Answer, served

nbformat = pytest.importorskip("nbformat", reason="pip install nbclient ipykernel")
nbclient = pytest.importorskip("nbclient", reason="pip install nbclient ipykernel")

EXAMPLE = Path(__file__).parents[1] / "examples" / "notebook.py"


class Notebook:
    """The example as Jupyter runs it; its kernel is there until `close`.

    Attributes:
        shown: what stands below each cell at last, by MIME types.
        address: of the page in the last cell's frame.
    """

    def __init__(self, folder: Path) -> None:
        code = re.findall(r"^# %%\n(.*?)(?=^# %%|\Z)", EXAMPLE.read_text("utf-8"), re.M | re.S)
        self.node = nbformat.v4.new_notebook(cells=list(map(nbformat.v4.new_code_cell, code)))
        where = {"metadata": {"path": str(folder)}}
        self.client = nbclient.NotebookClient(self.node, timeout=120, resources=where)
        with contextlib.ExitStack() as kernel:
            kernel.enter_context(self.client.setup_kernel())
            for index, cell in enumerate(self.node.cells):
                self.client.execute_cell(cell, index)
            self.close = kernel.pop_all().close
        self.shown: list[Any] = [cell.outputs[-1].data for cell in self.node.cells]
        (found,) = re.findall(r'<object [^>]*data="([^"]+)"', self.shown[-1]["text/html"])
        self.address: SplitResult = urlsplit(html.unescape(found))

    def asked(self, name: str = "") -> tuple[int, str, bytes]:
        """What the frame's server answers: its status, policy and content."""
        connection = http.client.HTTPConnection("127.0.0.1", self.address.port or 0, timeout=30)
        with contextlib.closing(connection):
            connection.request("GET", self.address.path + name)
            answer = connection.getresponse()
            return answer.status, str(answer.headers["Content-Security-Policy"]), answer.read()


@pytest.fixture(scope="module")
def notebook(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Notebook]:
    made = Notebook(tmp_path_factory.mktemp("notebook"))
    yield made
    made.close()


def page_of(content: str) -> Answer:
    """A page as Jupyter's, which another server has than the frame's."""

    def answer(request: BaseHTTPRequestHandler, path: str) -> None:
        request.send_response(200)
        request.send_header("Content-Type", "text/html; charset=utf-8")
        request.end_headers()
        request.wfile.write(f"<!doctype html><link rel=icon href=data:,>{content}".encode())

    return answer


def test_the_example_shows_what_it_holds_with_pictures(notebook: Notebook) -> None:
    for shown in notebook.shown:
        assert shown["text/plain"].startswith("<")
        assert "data:image/png;base64," in shown["text/html"]
    view = notebook.shown[-1]
    with Image.open(io.BytesIO(base64.b64decode(view["image/png"]))) as picture:
        assert picture.format == "PNG"
    assert len(nbformat.writes(notebook.node)) < 100_000  # and no code of the viewer


def test_the_kernel_itself_serves_the_view_also_once_interrupted(notebook: Notebook) -> None:
    assert notebook.client.km is not None
    asyncio.run(notebook.client.km.interrupt_kernel())
    status, policy, page = notebook.asked()
    assert (status, b"re_viewer" in page) == (200, True)
    assert FRAMED in policy
    assert notebook.asked("run.rrd")[2].startswith(b"RRF2")


def test_a_browser_draws_the_frame_and_then_the_picture_in_its_place(
    notebook: Notebook, tmp_path: Path
) -> None:
    with chromium(tmp_path) as driver, served(page_of(notebook.shown[-1]["text/html"])) as page:
        seen = "return document.querySelector('object img').getBoundingClientRect().height > 0"
        driver.get(page)
        assert drawn(driver, ["stream watched"]) == {"127.0.0.1"}
        assert not driver.execute_script(seen)
        assert errors(driver) == []
        notebook.close()
        with pytest.raises(ConnectionRefusedError):
            notebook.asked()
        driver.get(page)
        assert driver.execute_script(seen)
