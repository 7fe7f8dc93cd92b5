"""The viewer in a real browser: it draws the run, and asks nobody but this machine."""

from __future__ import annotations

import http.client
import http.server
import io
import json
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from run_data import VECTOR, write_run

from replay.viewer import webpage
from replay.viewer.program import free_port
from replay.viewer.webpage import policy, serve_page

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
SECONDS = 240
"""Longest wait for a page that is drawn without a graphics card on a busy machine."""

LANES = {"stream watched": (124, 195, 238), "novel": (60, 178, 146)}
"""Colours of lanes that are on the first page, as the browser shows them."""

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--force-device-scale-factor=1",
    "--window-size=1200,800",
)


@pytest.fixture
def browser(tmp_path):
    """Chromium without a screen, which can reach this machine only."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="pip install selenium")
    if BROWSER is None or DRIVER is None:
        pytest.skip("no browser: apt-get install chromium chromium-driver")
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in FLAGS:
        options.add_argument(flag)
    options.add_argument(f"--user-data-dir={tmp_path / 'profile'}")
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1")
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "WARNING"})
    with webdriver.Chrome(options=options, service=Service(DRIVER)) as driver:
        yield driver


@pytest.fixture
def address(tmp_path):
    """Where `cdmisfa view RUN --web` serves a run."""
    (tmp_path / "run").mkdir()
    write_run(tmp_path / "run" / "run.mcap", VECTOR, 24)
    command = [sys.executable, "-m", "cdmisfa", "view", str(tmp_path / "run"), "--web"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        found = None
        while found is None:
            line = process.stderr.readline()
            assert line, "the command ended"
            found = re.search(r"http://127\.0\.0\.1:\d+/\S*", line)
        yield found[0]
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 130
    finally:
        process.kill()
        process.communicate()


def picture(driver):
    """The page's pixels (height, width, 3); none where the browser is too busy to say."""
    from selenium.common.exceptions import WebDriverException

    try:
        png = driver.get_screenshot_as_png()
    except WebDriverException as error:
        print(f"{time.monotonic():.0f} s: {str(error).splitlines()[0]}")
        return np.empty((0, 0, 3), dtype=int)
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    print(f"{time.monotonic():.0f} s: {shown(pixels)} in a picture of {len(png)} bytes")
    return pixels


def shown(pixels):
    """How many pixels have each lane's colour."""
    return {
        name: int((np.abs(pixels - colour).max(axis=2) <= 12).sum())
        for name, colour in LANES.items()
    }


def test_the_page_draws_the_run_and_asks_this_machine_only(browser, address):
    browser.get(address)
    events, end = [], time.monotonic() + SECONDS

    def heard(word):
        """Whether the page has asked for it; asks the driver, not the busy page."""
        for entry in browser.get_log("performance"):
            events.append(json.loads(entry["message"])["message"])
        return any(word in str(event["params"].get("request")) for event in events)

    def drawn():
        return min(shown(picture(browser)).values()) > 1000

    for ready in (lambda: heard("MessageProxyService/ReadMessages"), drawn):
        while not ready():
            assert time.monotonic() < end, "the page does not show the run"
            time.sleep(3)
    heard("")

    asked, refused = {}, set()
    for event in events:
        facts = event["params"]
        if event["method"] == "Network.requestWillBeSent":
            asked[facts["requestId"]] = facts["request"]["url"]
        if event["method"] == "Network.loadingFailed" and facts.get("blockedReason") == "csp":
            refused.add(facts["requestId"])
    hosts = {
        urlsplit(url).hostname
        for key, url in asked.items()
        if key not in refused and url.startswith(("http", "ws"))
    }
    assert hosts == {"127.0.0.1"}

    # What the policy refuses is an error to the browser; nothing else may be one.
    errors = [e["message"] for e in browser.get_log("browser") if e["level"] == "SEVERE"]
    expected = ("Content Security Policy", "TypeError: Failed to fetch")
    assert [e for e in errors if not any(word in e for word in expected)] == []


@pytest.fixture
def served():
    """A page of one line behind the policy: ask it for a path, as a host."""

    class Viewer(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200 if self.path == "/?url=x" else 404)
            self.send_header("Content-Type", "text/html")
            self.send_header("X-Other", "1")
            self.end_headers()
            self.wfile.write(b"page")

        def log_message(self, *_):
            pass

    viewer = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Viewer)
    threading.Thread(target=viewer.serve_forever, daemon=True).start()
    port = free_port()

    def ask(path, host=f"127.0.0.1:{port}"):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", path, headers={"Host": host})
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        return answer.status, dict(answer.headers), body

    with serve_page(viewer.server_port, 4321, port):
        yield ask, viewer
    viewer.server_close()


def test_the_policy_goes_with_every_answer(served, monkeypatch):
    ask, viewer = served
    monkeypatch.setattr(webpage, "START_SECONDS", 0.2)
    status, headers, body = ask("/?url=x")
    assert (status, body, headers["Content-Type"]) == (200, b"page", "text/html")
    assert headers["Content-Security-Policy"] == policy(4321)
    assert "X-Other" not in headers
    assert ask("/missing")[0] == 404
    viewer.shutdown()
    viewer.server_close()
    assert ask("/?url=x")[0] == 502


def test_names_of_others_are_not_served(served):
    ask, _ = served
    assert ask("/?url=x", "example.org")[0] == 403


def test_the_policy_names_this_machine_only():
    hosts = re.findall(r"\w+://[^\s;]+", policy(4321))
    assert hosts == ["http://127.0.0.1:4321"]
    assert "*" not in policy(4321)
