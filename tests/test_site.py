"""The site of the pages: built without a warning, no dead link, nothing from elsewhere."""

from __future__ import annotations

import functools
import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from html import unescape
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urldefrag, urlsplit

import pytest
from browser import chromium, errors

pytest.importorskip("furo", reason="pip install 'cdmisfa[dev]'")
pytestmark = pytest.mark.xdist_group("site")

ROOT = Path(__file__).parents[1]
VIEWER = "_static/viewer"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `make docs` builds it, tutorials executed."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-b", "html", "docs", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def pages(site: Path) -> list[Path]:
    return [page for page in sorted(site.rglob("*.html")) if VIEWER not in str(page)]


def test_every_link_leads_somewhere_and_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    anchors = {
        page: {unquote(name) for name in re.findall(r'\bid="([^"]+)"', page.read_text("utf-8"))}
        for page in pages(site)
    }
    assert len(anchors) > 50
    dead = []
    for page in anchors:
        text = page.read_text("utf-8")
        assert not re.search(r'<(?:script|img|iframe)[^>]+src="(?:https?:)?//', text), page
        assert not re.search(r'<link[^>]+rel="stylesheet"[^>]+href="(?:https?:)?//', text), page
        for link in re.findall(r'\b(?:href|src)="([^"]+)"', text):
            address, anchor = urldefrag(unescape(link))
            if urlsplit(address).scheme:
                continue
            file = (page.parent / unquote(urlsplit(address).path)).resolve() if address else page
            if not file.exists() or (anchor and unquote(anchor) not in anchors.get(file, {anchor})):
                dead.append((page.name, link))
    assert dead == []


def test_tutorials_say_what_they_did(site: Path) -> None:
    first = (site / "tutorials" / "first-run.html").read_text("utf-8")
    assert "identical, bit for bit" in first
    assert "data:image/png" in first or "_images/" in first
    assert "learned again, they are identical" in (site / "tutorials/time-travel.html").read_text()


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    handler = functools.partial(Quiet, directory=str(site))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


@pytest.fixture
def driver(tmp_path: Path) -> Iterator[Any]:
    with chromium(tmp_path) as driver:
        yield driver


def waited_for(question: Any) -> Any:
    end = time.monotonic() + 120
    while not (answer := question()):
        assert time.monotonic() < end
        time.sleep(0.2)
    return answer


def background(driver: Any) -> int:
    colour = "return getComputedStyle(document.body).backgroundColor"
    return sum(map(int, re.findall(r"\d+", driver.execute_script(colour))[:3]))


def test_every_page_opens_on_a_telephone_light_and_dark(
    site: Path, address: str, driver: Any
) -> None:
    driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True},
    )
    wide = []
    for page in pages(site):
        driver.get(address + str(page.relative_to(site)))
        if driver.execute_script("return document.documentElement.scrollWidth") > 390:
            wide.append(page.name)
        assert errors(driver) == [], page
    assert wide == []
    for scheme, bright in (("light", True), ("dark", False)):
        feature = {"name": "prefers-color-scheme", "value": scheme}
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        driver.get(address)
        assert (background(driver) > 3 * 128) is bright


def test_search_finds_without_a_network(address: str, driver: Any) -> None:
    driver.get(f"{address}search.html?q=whitening")
    found = "return [...document.querySelectorAll('#search-results li a')].map(a => a.href)"
    assert waited_for(lambda: driver.execute_script(found))


def test_the_viewer_shows_the_run_and_asks_nobody_else(address: str, driver: Any) -> None:
    driver.get(f"{address}{VIEWER}/index.html")
    asked: set[str] = set()

    def run_was_read() -> bool:
        for entry in driver.get_log("performance"):
            event = json.loads(entry["message"])["message"]
            if event["method"] == "Network.responseReceived":
                asked.add(event["params"]["response"]["url"])
        return any(url.endswith("/run.rrd") for url in asked)

    waited_for(run_was_read)
    assert {urlsplit(url).hostname for url in asked if url.startswith("http")} == {"127.0.0.1"}
