"""The viewer in a real browser: it draws the run, and nobody but it is asked or answered."""

from __future__ import annotations

import contextlib
import http.client
import http.server
import re
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from browser import chromium, drawn, errors
from run_data import VECTOR, write_run
from waiting import started

from replay.viewer import web
from replay.viewer.web import POLICY, page_of, pieces_of, served


@pytest.fixture
def browser(tmp_path):
    with chromium(tmp_path) as driver:
        yield driver


@pytest.fixture
def command(tmp_path):
    """`cdmisfa view RUN --web`; interrupted at the end."""
    (tmp_path / "run").mkdir()
    write_run(tmp_path / "run" / "run.mcap", VECTOR, 24)
    with started("view", tmp_path / "run", "--web", "--tab", "Overview") as process:
        yield process
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 130


@pytest.fixture
def address(command):
    """Where it serves the run."""
    found = None
    while found is None:
        line = command.stderr.readline()
        assert line, "the command ended"
        found = re.search(r"http://127\.0\.0\.1:\d+/\S*", line)
    return found[0]


def test_the_page_draws_the_run_and_asks_this_machine_only(browser, address):
    browser.get(address)
    assert drawn(browser) == {"127.0.0.1"}
    assert errors(browser) == []


def asked(port, path, host=None):
    """What is answered at a port of this machine: status, headers and content."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{port}"})
        answer = connection.getresponse()
        return answer.status, dict(answer.headers), answer.read()
    finally:
        connection.close()


RUN = bytes(range(256)) * 9000


@pytest.fixture
def page():
    """A page of one line, and a run: its address, and the viewer's own server."""

    class Viewer(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200 if self.path == "/" else 404)
            self.send_header("Content-Type", "text/html")
            self.send_header("X-Other", "1")
            self.end_headers()
            self.wfile.write(b"page")

        def log_message(self, *_):
            pass

    viewer = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Viewer)
    threading.Thread(target=viewer.serve_forever, args=(0.05,), daemon=True).start()
    with tempfile.TemporaryFile() as run:
        run.write(RUN)
        run.flush()
        with served(page_of(viewer.server_port, lambda: pieces_of(run))) as address:
            yield urlsplit(address), viewer
    viewer.shutdown()
    viewer.server_close()


def test_the_policy_goes_with_every_page(page, monkeypatch):
    address, viewer = page
    monkeypatch.setattr(web, "START_SECONDS", 0.2)
    status, headers, body = asked(address.port, f"{address.path}?url=x")
    assert (status, body, headers["Content-Type"]) == (200, b"page", "text/html")
    assert headers["Content-Security-Policy"] == POLICY
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "X-Other" not in headers
    assert asked(address.port, f"{address.path}missing")[0] == 404
    viewer.shutdown()
    viewer.server_close()
    assert asked(address.port, address.path)[0] == 502


def test_only_who_has_the_address_is_answered(page):
    """Not a page of another name that leads here, and not who only knows the port."""
    address, _ = page
    status, headers, body = asked(address.port, f"{address.path}run.rrd")
    assert (status, body) == (200, RUN)
    assert not [name for name in headers if name.lower().startswith("access-control")]
    places = [f"{address.path}{name}" for name in ("", "run.rrd", "re_viewer.js", "?url=x")]
    for path in places:
        for host in (
            "example.org",
            f"example.org:{address.port}",
            f"localhost:{address.port}",
            "127.0.0.1",
        ):
            assert asked(address.port, path, host)[0] == 403, (path, host)
    token = address.path.strip("/")
    other = token[:-1] + ("A" if token[-1] != "A" else "B")
    for path in (
        "/",
        "/run.rrd",
        f"/{other}/run.rrd",
        f"/{token}",
        f"/{token[:-1]}/run.rrd",
        f"/x/../{token}/run.rrd",
    ):
        status, _, body = asked(address.port, path)
        assert (status, RUN[:64] in body) == (403, False), path
    assert len(token) >= 32


def test_each_time_there_is_another_token():
    tokens = set()
    for _ in range(3):
        with served(lambda request, path: None) as address:
            tokens.add(address.rsplit("/", 2)[1])
    assert len(tokens) == 3


def test_the_policy_names_nobody_else():
    assert "://" not in POLICY
    assert "*" not in POLICY


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's table of sockets")
def test_a_run_in_the_browser_is_at_no_other_port(address, command):
    """Of all ports of the command and its viewer, one gives data, to who has the address."""
    shown = urlsplit(address)
    assert asked(shown.port, f"{shown.path}run.rrd")[2].startswith(b"RRF2")
    end = time.monotonic() + 30
    while len(ports := listening(command.pid)) < 2:
        assert time.monotonic() < end, ports
        time.sleep(0.1)
    assert shown.port in ports
    for port in ports - {shown.port}:  # Rerun's page without data
        assert asked(port, "/")[0] == 200
        for path in (f"{shown.path}run.rrd", "/run.rrd", "/proxy"):
            assert asked(port, path)[0] == 404
        assert asked(port, "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages")[0] == 404
    token = shown.path.strip("/")
    for process in family(command.pid):
        assert token not in Path(f"/proc/{process}/cmdline").read_text()


def family(pid):
    """A process and its children."""
    found = [pid]
    for number in found:
        for task in Path(f"/proc/{number}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    return found


def listening(pid):
    """The ports at which a process and its children listen."""
    inodes = set()
    for process in family(pid):
        for file in Path(f"/proc/{process}/fd").iterdir():
            with contextlib.suppress(OSError):
                inodes.add(file.readlink().name)
    rows = [row.split() for row in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return {
        int(row[1].split(":")[1], 16)
        for row in rows
        if row[3] == "0A" and f"socket:[{row[9]}]" in inodes
    }
