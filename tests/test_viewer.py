"""The viewer shows a view in a window and without one, and ends when it should."""

from __future__ import annotations

import dataclasses
import io
import socket
import sys
import time
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import rerun.blueprint as rrb
from conftest import Cdmisfa
from PIL import Image
from run_data import IMAGE, PROGRESS, VECTOR, read_signals, run_of, write_run
from view_data import views_of
from waiting import running, wait_for

from cdmisfa.core.errors import CdmisfaError, UsageError
from replay.view import panels
from replay.view.bindings import viewer_program
from replay.view.build import build_view, view_of
from replay.viewer import headless, program, window
from replay.viewer.catalogue import served_moment
from replay.viewer.moments import frame_at
from replay.viewer.program import (
    check_limit,
    environment,
    free_port,
    private_host,
    run_program,
)
from replay.viewer.steered import Steered, is_painted

ITERATIONS = 24


needs_driver = pytest.mark.skipif(bool(program.missing_driver()), reason=program.missing_driver())


@needs_driver
def test_the_viewer_shows_the_layout_without_a_complaint(tmp_path):
    """Opens the view, scrubs to two frames, and looks at the pixels."""
    write_run(tmp_path / "run.mcap", IMAGE, ITERATIONS)
    build_view(tmp_path, tmp_path / "run.rrd", tab="Abstraction")
    blocks = [block for _, block in run_of(IMAGE, ITERATIONS)]
    with headless.headless_viewer() as opened:
        opened.ask(lambda client: client.open(str(tmp_path / "run.rrd")))
        views = {view.name: view for view in opened.ask(all_views)}
        assert [view.reports for view in views.values()] == [[]] * len(views)
        for block in (blocks[3], next(b for b in blocks if b.stream != blocks[3].stream)):
            opened.go_to(block.t)
            grey = int(block.frames[0].min())
            view = views["Input x"].view_id
            opened.ask(lambda client, v=view, g=grey: shows(client, v, g))


NAMED = {
    "2.0": (7, 30, ("R and Q, every 10 iterations", "What was done: the last 50 blocks", "Events")),
    "progress": (
        5,
        23,
        ("What it mostly attends to", "Output y on new frames, from least to most", "Events"),
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
    write_run(
        *(tmp_path / "run.mcap", spec, ITERATIONS),
        saves=True,
        learner=learner,
        edit=lambda record: dataclasses.replace(record, stream=record.iteration % 3),
    )
    tabs = []

    def side_by_side(*views, **_):
        tabs.extend(views)
        shown = [view for tab in views for view in views_of(tab)]  # none behind another page
        return rrb.Blueprint(rrb.Grid(*shown), auto_views=False, auto_layout=False)

    monkeypatch.setattr(panels, "blueprint", side_by_side)
    build_view(tmp_path, tmp_path / "run.rrd")
    assert len(tabs) == n_tabs
    with headless.headless_viewer("2400x1600") as opened:
        opened.ask(lambda client: client.open(str(tmp_path / "run.rrd")))
        views = opened.ask(all_views)
        assert len(views) > n_views
        for name in some:
            (view,) = [v for v in views if v.name == name]
            opened.ask(lambda client, v=view: client.take_screenshot(v.view_id))
        state = opened.ask(lambda client: client.get_state())
        assert [(v.name, v.reports) for v in state.views if v.reports] == []


def all_views(client):
    state = client.get_state()
    found = [view for view in state.views if view.name in ("Summary", "Input x")]
    return state.views if found and not state.loading else None


def shows(client, view, grey):
    """Whether most of an image view's pixels of colour are this grey."""
    picture = np.asarray(Image.open(io.BytesIO(client.take_screenshot(view))).convert("L"))
    return np.mean(np.abs(picture.astype(int) - grey) < 6) > 0.2


@needs_driver
def test_a_screenshot_is_a_picture(tmp_path, monkeypatch):
    monkeypatch.setattr(headless, "SETTLE", 0.5)
    write_run(tmp_path / "run.mcap", VECTOR, 6)
    headless.screenshot(tmp_path, tmp_path / "s.png", at=80, window="800x500")
    with Image.open(tmp_path / "s.png") as picture:
        assert picture.size in ((800, 500), (1600, 1000))
        assert len(np.unique(np.asarray(picture.convert("L")))) > 20
    with pytest.raises(UsageError, match="--force"):
        headless.screenshot(tmp_path, tmp_path / "s.png")


@needs_driver
def test_a_screenshot_of_a_tab_at_an_event(tmp_path, monkeypatch):
    """The cursor stands where module 2 was saved, in the tab that was asked for."""
    records = write_run(tmp_path / "run.mcap", VECTOR, 12, saves=True)
    seen = []

    def look(viewer, out):
        state = viewer.ask(lambda client: client.get_state())
        opened = viewer.ask(lambda client: client.get_blueprint()).blueprint
        seen.append((state.recordings[0].current_time, opened))

    monkeypatch.setattr(headless.Steered, "draw", look)
    monkeypatch.setattr(headless, "SETTLE", 0.5)
    headless.screenshot(tmp_path, tmp_path / "s.png", at="iteration 5", tab="gate")
    ((time_then, blueprint),) = seen
    kinds = [
        part["ContainerBlueprint"] for part in blueprint.values() if "ContainerBlueprint" in part
    ]
    tabs = max(kinds, key=lambda part: len(part["contents"]) * (part["container_kind"] == "Tabs"))
    opened = blueprint[f"/{tabs['active_tab']}"]["ContainerBlueprint"]["display_name"]
    assert (time_then, opened) == (records[5].t, "Gate")


@needs_driver
def test_a_window_opens_at_a_moment(tmp_path, monkeypatch):
    """A window without a screen; it ends once it has said where its cursor stands."""
    records = write_run(tmp_path / "run.mcap", VECTOR, 12)
    run, go_to, seen = window.run_program, window._go_to, []

    def without_a_screen(words, *more):
        run(["--headless", *words], *more)

    def look(frame, viewer, place):
        go_to(frame, viewer, place)
        seen.append(Steered(viewer, place).ask(lambda client: client.get_state()))
        viewer.terminate()

    monkeypatch.setattr(window, "has_display", lambda: True)
    monkeypatch.setattr(window, "run_program", without_a_screen)
    monkeypatch.setattr(window, "_go_to", look)
    with pytest.raises(CdmisfaError, match="ended with code -15"):
        window.open_window(tmp_path, at="iteration 5")
    assert seen[0].recordings[0].current_time == records[5].t


@needs_driver
def test_a_page_opens_at_a_moment(tmp_path):
    """Its link, in a viewer without a browser, with the tabs of the view."""
    records = write_run(tmp_path / "run.mcap", VECTOR, 12)
    with (
        view_of(tmp_path, 10, None, "Gate") as view,
        served_moment(view, records[5].t) as (_, page),
        headless.headless_viewer() as viewer,
    ):
        (link,) = parse_qs(urlsplit(page).query)["url"]
        viewer.ask(lambda client: client.open(link))
        shown = viewer.ask(lambda client: is_painted(client.get_state()) and client.get_state())
        assert shown.recordings[0].current_time == records[5].t
        assert "Verdict on each block: the last 50 blocks" in {one.name for one in shown.views}


def test_a_moment_is_a_frame_an_iteration_or_an_event(cdmisfa: Cdmisfa, tmp_path):
    words = ["learn", "oscillatory", "--algorithm", "progress", "-o", tmp_path, "--no-rerun"]
    assert cdmisfa(*words, "--max-modules", 2).code == 0
    first, second = (s.t for s in read_signals(tmp_path) if s.saved)
    assert frame_at(tmp_path, "123") == 123
    assert frame_at(tmp_path, "iteration 7") == 7 * 40
    assert (frame_at(tmp_path, "module 1"), frame_at(tmp_path, "Module 2")) == (first, second)
    for wrong, said in (
        ("999999", "the last of"),
        ("iteration 999999", "the last of"),
        ("module 7", "; events: stream x"),
        ("odule 1", "no frame, iteration or event"),
    ):
        with pytest.raises(UsageError, match=said):
            frame_at(tmp_path, wrong)
    with pytest.raises(UsageError, match="only a run"):
        frame_at(tmp_path / "v.rrd", "module 1")


def test_tabs_and_sizes_that_are_not_there_are_refused(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 3)
    with pytest.raises(
        UsageError, match="no tab 'Bridge': there are Overview, Abstraction, Gate, Decision"
    ):
        build_view(tmp_path, tmp_path / "run.rrd", tab="Bridge")
    build_view(tmp_path, tmp_path / "run.rrd", tab="MODULES")
    with (
        pytest.raises(UsageError, match="is built already"),
        view_of(tmp_path / "run.rrd", 10, None, "Gate"),
    ):
        pass
    for size in ("big", "10x10", "1600", "1600x-2"):
        with pytest.raises(UsageError, match="say 1600x1000"):
            headless.screenshot(tmp_path, tmp_path / "s.png", window=size)


def test_a_port_that_is_taken_is_refused_in_one_line(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 2)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(CdmisfaError, match=r"--port \d+: .*choose another"):
            window.serve(tmp_path, port=taken.getsockname()[1])


def test_without_a_driver_the_remedy_is_said(tmp_path, monkeypatch):
    write_run(tmp_path / "run.mcap", VECTOR, 2)
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(CdmisfaError, match="mesa-vulkan-drivers"):
        headless.screenshot(tmp_path, tmp_path / "s.png")


def test_telemetry_is_off():
    assert environment()["CI"] == "1"
    assert viewer_program().is_file()


def test_what_cannot_be_shown_is_refused_at_once(tmp_path, monkeypatch):
    write_run(tmp_path / "run.mcap", VECTOR, 2)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(CdmisfaError, match=r"no display .* --web"):
        window.open_window(tmp_path)
    for limit in ("banana", "4", "GB", "-1GB"):
        with pytest.raises(UsageError, match="4GB or 75%"):
            window.open_window(tmp_path, memory_limit=limit)
    assert [check_limit(limit) for limit in ("4GB", "75%", "512MiB")]
    last = max(s.t + len(s.y) - 1 for s in read_signals(tmp_path))
    with pytest.raises(UsageError, match=f"the last of .* is {last}$"):
        headless.screenshot(tmp_path, tmp_path / "s.png", at=last + 1)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells a child")
def test_the_program_ends_with_a_parent_that_is_killed(tmp_path):
    told = tmp_path / "pid"
    program = tmp_path / "program"
    program.write_text(f"#!/bin/sh\necho $$ > {told}.part\nmv {told}.part {told}\nexec sleep 60\n")
    program.chmod(0o755)
    code = (
        "import sys, pathlib, replay.viewer.program as v\n"
        f"v.viewer_program = lambda: pathlib.Path({str(program)!r})\n"
        "v.run_program([])\n"
    )
    with running("-c", code) as parent:
        wait_for(told.exists, 60, parent)
    child = Path("/proc") / told.read_text().strip() / "cmdline"
    for _ in range(100):
        if not child.exists() or not child.read_bytes():
            return
        time.sleep(0.05)
    pytest.fail("it runs on")


def test_a_program_that_fails_is_quoted(tmp_path, monkeypatch, capfd):
    script = tmp_path / "program"
    script.write_text("#!/bin/sh\necho chatter >&2\necho 'no luck' >&2\nexit 3\n")
    script.chmod(0o755)
    monkeypatch.setattr("replay.viewer.program.viewer_program", lambda: script)
    with pytest.raises(CdmisfaError, match="code 3: no luck"):
        run_program([])
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has a whole network")
def test_a_view_is_opened_where_no_page_finds_it_and_leaves_nothing_behind(tmp_path, monkeypatch):
    """It has no name by then, and the port asks nobody, but is at an address by chance."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    write_run(tmp_path / "run.mcap", VECTOR, 2)
    given = []

    def program(arguments, view=None):
        assert list((tmp_path / "temporary").iterdir()) == []
        given.append((arguments, view and view.read(4)))

    monkeypatch.setattr(window, "run_program", program)
    monkeypatch.setattr(window, "has_display", lambda: True)
    window.open_window(tmp_path)
    window.open_window(tmp_path)
    window.serve(tmp_path)
    heads = [("-" in arguments, head) for arguments, head in given]
    assert heads == [(True, b"RRF2")] * 2 + [(False, None)]  # the last serves it itself
    places = {arguments[arguments.index("--bind") + 1] for arguments, _ in given[:2]}
    assert len(places) == 2
    hosts = places | {private_host() for _ in range(20)}
    assert len(hosts) == 22
    assert all(host.startswith("127.") and host != "127.0.0.1" for host in hosts)
    assert all(map(free_port, hosts))
