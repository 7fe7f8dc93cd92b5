"""The viewer shows a view in a window, in a browser and without a screen, and ends with it."""

from __future__ import annotations

import dataclasses
import io
import re
import signal
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb
from browser import chromium, drawn
from conftest import Cdmisfa
from headless import Headless, needs_driver, shown
from PIL import Image
from run_data import IMAGE, PROGRESS, VECTOR, read_signals, run_of, save_modules_of, write_run
from view_data import views_of
from waiting import started, wait_for

from cdmisfa.core.errors import CdmisfaError, UsageError
from replay import viewer
from replay.view import run_layout
from replay.view.build import build_view, view_of
from replay.viewer import Program, frame_at

ITERATIONS = 24


@needs_driver
def test_the_viewer_shows_the_layout_without_a_complaint(tmp_path):
    """Opens the view, scrubs to two frames, and looks at the pixels."""
    write_run(tmp_path / "run.mcap", IMAGE, ITERATIONS)
    build_view(tmp_path, tmp_path / "run.rrd", tab="Candidate")
    blocks = [block for _, block in run_of(IMAGE, ITERATIONS)]
    with shown(tmp_path / "run.rrd") as ask:
        views = {view.name: view for view in ask(all_views)}
        assert [view.reports for view in views.values()] == [[]] * len(views)
        for block in (blocks[3], next(b for b in blocks if b.stream != blocks[3].stream)):
            ask(lambda client, t=block.t: client.set_time("frame", sequence=t) or True)
            grey = int(block.frames[0].min())
            view = views["Current frame x"].view_id
            ask(lambda client, v=view, g=grey: shows(client, v, g))


NAMED = {
    "2.0": (
        6,
        28,
        (
            "Policy in each stream",
            "Attended stream, action, and whether the action was random, last 50 blocks",
            "Events",
        ),
    ),
    "progress": (
        4,
        22,
        (
            "Attended stream",
            "Variance of each output on new frames (1 on training frames)",
            "Events",
        ),
    ),
}


@needs_driver
@pytest.mark.parametrize("algorithm", NAMED)
def test_every_tab_shows_without_a_complaint_whatever_things_are_called(
    algorithm, tmp_path, monkeypatch
):
    """All tabs at once; a name in letters that the viewer's font lacks would end it."""
    n_tabs, n_views, some = NAMED[algorithm]
    learner = PROGRESS if algorithm == "progress" else None
    spec = dataclasses.replace(IMAGE, streams=("左", "⟨b⟩/ c", "right"), truth=("x→", "y"))
    records = write_run(
        *(tmp_path / "run.mcap", spec, ITERATIONS),
        saves=True,
        learner=learner,
        edit=lambda record: dataclasses.replace(record, stream=record.iteration % 3),
    )
    save_modules_of(tmp_path, spec, records)
    tabs = []

    def side_by_side(*views, **_):
        tabs.extend(views)
        every = [view for tab in views for view in views_of(tab)]  # none behind another page
        return rrb.Blueprint(rrb.Grid(*every), auto_views=False, auto_layout=False)

    monkeypatch.setattr(run_layout.layouts, "blueprint", side_by_side)
    build_view(tmp_path, tmp_path / "run.rrd")
    assert len(tabs) == n_tabs
    with shown(tmp_path / "run.rrd", "2400x1600") as ask:
        views = ask(all_views)
        assert len(views) > n_views
        for name in some:
            view = next(v for v in views if v.name == name)
            ask(lambda client, v=view: client.take_screenshot(v.view_id))
        state = ask(lambda client: client.get_state())
        assert [(v.name, v.reports) for v in state.views if v.reports] == []


def all_views(client):
    state = client.get_state()
    result = [view for view in state.views if view.name in ("Results", "Current frame x")]
    return state.views if result and not state.loading else None


def shows(client, view, grey):
    """Whether most of an image view's pixels of colour are this grey."""
    picture = np.asarray(Image.open(io.BytesIO(client.take_screenshot(view))).convert("L"))
    return np.mean(np.abs(picture.astype(int) - grey) < 6) > 0.2


@needs_driver
def test_a_screenshot_shows_a_tab_at_a_moment(tmp_path, monkeypatch, cdmisfa: Cdmisfa):
    monkeypatch.setattr(viewer, "SETTLE", 0.5)
    monkeypatch.setattr(viewer, "WINDOW", "800x500")
    records, seen, painted = write_run(tmp_path / "run.mcap", VECTOR, 12), [], viewer.is_painted

    def look(client):
        seen.append((client.get_state(), client.get_blueprint().blueprint))
        return painted(client)

    monkeypatch.setattr(viewer, "is_painted", look)
    words = ("view", tmp_path, "--screenshot", tmp_path / "s.png")
    assert cdmisfa(*words, "--at", "iteration 5", "--tab", "novelty").code == 0
    with Image.open(tmp_path / "s.png") as picture:
        assert picture.size in ((800, 500), (1600, 1000))
        assert len(np.unique(np.asarray(picture.convert("L")))) > 20
    state, blueprint = seen[-1]
    kinds = [
        part["ContainerBlueprint"] for part in blueprint.values() if "ContainerBlueprint" in part
    ]
    tabs = max(kinds, key=lambda part: len(part["contents"]) * (part["container_kind"] == "Tabs"))
    opened = blueprint[f"/{tabs['active_tab']}"]["ContainerBlueprint"]["display_name"]
    assert (state.recordings[0].current_time, opened) == (records[5].t, "Novelty")
    assert "--force" in cdmisfa(*words).err


@needs_driver
def test_a_window_opens_at_a_moment(tmp_path, monkeypatch):
    """The viewer runs without a screen here, and is ended when its cursor stands."""
    records, seen = write_run(tmp_path / "run.mcap", VECTOR, 12), []

    class Window(Headless):
        def connect(self, port, frame):
            client = super().connect(port, frame)
            seen.append(self.wait_for(client.get_state))
            self.terminate()

    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr(viewer, "Program", Window)
    with view_of(tmp_path) as view, pytest.raises(CdmisfaError, match="ended with code -15"):
        viewer.open_window(view, frame_at(tmp_path, "iteration 5"))
    assert seen[0].recordings[0].current_time == records[5].t


@pytest.fixture
def page(tmp_path):
    """`cdmisfa view RUN --web`, interrupted at the end, and the address that it prints."""
    write_run(tmp_path / "run.mcap", VECTOR, 24)
    with started("view", tmp_path, "--web", "--tab", "Overview") as process:
        line = process.stderr.readline()
        yield process, line.strip()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 130


@pytest.mark.system
def test_a_browser_draws_the_page(page, tmp_path):
    with chromium(tmp_path) as browser:
        browser.get(page[1])
        drawn(browser)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's table of sockets")
def test_the_page_and_its_data_are_on_this_machine_only(page):
    result = re.fullmatch(
        r"http://127\.0\.0\.1:(\d+)/\?url=\S*127\.0\.0\.1%3A(\d+)%2Fproxy", page[1]
    )
    assert result is not None, page
    wait_for(lambda: len(addresses(result.groups())) == 2, 60, page[0])
    assert addresses(result.groups()) == {f"0100007F:{int(port):04X}" for port in result.groups()}


def addresses(ports):
    """The addresses of this machine, in hexadecimal, at which something listens at these ports."""
    lines = [Path(f"/proc/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    rows = [line.split() for line in (*lines[0], *lines[1])]
    wanted = {f"{int(port):04X}" for port in ports}
    return {row[1] for row in rows if row[3] == "0A" and row[1].split(":")[1] in wanted}


def test_a_moment_is_a_frame_an_iteration_or_an_event(cdmisfa: Cdmisfa, tmp_path):
    words = ["learn", "oscillatory", "--algorithm", "progress", "-o", tmp_path, "--no-rerun"]
    assert cdmisfa(*words, "--max-modules", 2).code == 0
    first, second = (s.t for s in read_signals(tmp_path) if s.saved)
    assert frame_at(tmp_path, "123") == 123
    assert frame_at(tmp_path, "iteration 7") == 7 * 40
    assert (frame_at(tmp_path, "module 1"), frame_at(tmp_path, "Module 2")) == (first, second)
    for wrong in ("iteration 999999", "module 7", "odule 1"):
        with pytest.raises(UsageError, match="not a frame, iteration or event"):
            frame_at(tmp_path, wrong)


def test_a_port_that_is_taken_is_refused_in_one_line(tmp_path, cdmisfa: Cdmisfa):
    write_run(tmp_path / "run.mcap", VECTOR, 2)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = cdmisfa("view", tmp_path, "--web", "--port", taken.getsockname()[1])
    assert (done.code, "choose another" in done.err) == (1, True)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is a driver")
@pytest.mark.parametrize("name", ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"])
def test_without_a_driver_the_remedy_is_printed_once_the_input_is_right(
    tmp_path, monkeypatch, cdmisfa: Cdmisfa, name
):
    write_run(tmp_path / "run.mcap", VECTOR, 2)
    (tmp_path / "other.rrd").write_text("nothing of Rerun's")
    for variable in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv(name, str(tmp_path / "none.json"))
    for path, words in (
        (tmp_path, "mesa-vulkan-drivers"),
        (tmp_path / "other.rrd", "not an .rrd file"),
    ):
        done = cdmisfa("view", path, "--screenshot", tmp_path / "s.png")
        assert (done.code, words in done.err) == (2, True), done


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's /proc")
def test_its_telemetry_is_off():
    with Program("--serve-grpc", "--port", str(viewer.free_port())) as program:
        environ = Path(f"/proc/{program.pid}/environ")  # empty until the program is executed
        wait_for(lambda: b"CI=1" in environ.read_bytes().split(b"\0"), 30)
