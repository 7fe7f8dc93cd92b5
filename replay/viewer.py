"""Rerun's own programs: the window of a view, its page in a browser, and its screenshot.

All of them listen at 127.0.0.1 only.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import rerun_cli

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.log.files import atomic_write
from replay.open_sources import holds_run
from replay.runs.log import EVENT_TOPIC, read_batches, read_columns

HOST = "127.0.0.1"

# Size of a screenshot, in points.
WINDOW = "1600x1000"

# Seconds before a screenshot, in which the viewer's notices disappear.
SETTLE = 6.0

# Longest wait for an answer of the viewer, which is slow without a graphics card.
SECONDS = 120.0

# Command that installs a Vulkan driver for machines without a graphics card.
INSTALL = "apt-get install mesa-vulkan-drivers libvulkan1"

ITERATION_PATTERN = re.compile(r"iteration\s*(\d+)", re.IGNORECASE)


class Program(subprocess.Popen[bytes]):
    """Rerun's viewer or server, which ends with the `with` block that runs it.

    It has a session of its own, so that an interrupt reaches it through us alone. Its output goes
    to a file: it hangs where it cannot write to a pipe.

    Args:
        arguments: command line arguments of the program.
    """

    def __init__(self, *arguments: str) -> None:
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the program)
        # The `rerun` on the path is a wrapper that does not end its child when it is ended.
        path = Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")
        super().__init__(
            [str(path), "--bind", HOST, *arguments],
            env={**os.environ, "CI": "1", "RUST_LOG": "warn"},  # CI switches the telemetry off
            stdout=self._output,
            stderr=self._output,
            start_new_session=True,
        )

    def __exit__(self, *error: Any) -> None:
        self.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(timeout=5)
        self.kill()
        super().__exit__(*error)
        self._output.close()

    def until_end(self) -> None:
        """Wait until the program ends.

        Raises:
            CdmisfaError: the program ends with an error.
        """
        if self.wait():
            raise self._failure()

    def _failure(self) -> CdmisfaError:
        self._output.seek(0)
        lines = self._output.read().decode("utf-8", "replace").strip().splitlines()
        why = [line for line in lines if "panicked" in line] + lines[-1:] + ["no reason given"]
        return CdmisfaError(f"the viewer ended with code {self.returncode}: {why[0].strip()}")

    def wait_for(self, condition: Callable[[], Any]) -> Any:
        """Call `condition` until its result is true, and return the result.

        Errors are ignored, because Rerun's client raises them until the viewer answers.

        Raises:
            CdmisfaError: the program ended, or the result is not true in time.
        """
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            if self.poll() is not None:
                raise self._failure()
            with contextlib.suppress(OSError, RuntimeError, ValueError):
                if answer := condition():
                    return answer
            time.sleep(0.05)
        raise CdmisfaError(f"the viewer did not respond within {SECONDS:.0f} s")

    def connect(self, port: str, frame: int | None) -> Any:
        """Wait until the viewer shows its view, and return Rerun's client of it.

        Args:
            port: port at which the viewer listens.
            frame: frame to put the time cursor at; None leaves it at the end.
        """
        from rerun.experimental import ViewerClient

        from replay.view.writer import FRAME

        client = self.wait_for(lambda: ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy"))
        self.wait_for(lambda: is_painted(client))
        if frame is not None:
            client.set_time(FRAME, sequence=frame, play_state="paused")
        return client


def is_painted(client: Any) -> bool:
    """Return whether a viewer shows everything that it was given."""
    state = client.get_state()
    return bool(state.recordings) and bool(state.views) and not state.loading


def open_window(view: Path, frame: int | None = None) -> None:
    """Show an .rrd file in a window, at a frame, until the window is closed.

    Raises:
        CdmisfaError: there is no display, or the viewer ends with an error.
    """
    if not has_display():
        raise CdmisfaError("no display is available: use --web, --save or --screenshot")
    port = str(free_port())
    with Program("--port", port, str(view)) as viewer:
        if frame is not None:
            viewer.connect(port, frame)
        viewer.until_end()


@contextlib.contextmanager
def served(view: Path, port: int = 0) -> Iterator[tuple[Program, str]]:
    """Serve an .rrd file to browsers on this machine.

    Args:
        view: the file.
        port: port of the page; by default a free one.

    Yields:
        The server, and the address of the page.

    Raises:
        CdmisfaError: the port is taken.
    """
    data = free_port()
    with _page(port, f"rerun+http://{HOST}:{data}/proxy", "--port", str(data), str(view)) as page:
        yield page


@contextlib.contextmanager
def live_window(data: str, say: Callable[[str], None]) -> Iterator[None]:
    """Show a live view in a window, or without a display on a web page.

    The window stays open afterwards, with its last view.

    Args:
        data: address of the live view.
        say: called with a line that names the address.
    """
    if has_display():
        say(f"live view {data}")
        Program("--port", str(free_port()), "--connect", data)
        yield
        return
    with _page(0, data, data) as (_, address):
        say(f"live view {address}    open it in a browser on this machine")
        yield


@contextlib.contextmanager
def _page(port: int, data: str, *words: str) -> Iterator[tuple[Program, str]]:
    """Serve the viewer's page, which shows the data at an address."""
    port = free_port(port)

    def answers() -> bool:
        with socket.create_connection((HOST, port)):
            return True

    with Program("--serve-web", "--web-viewer-port", str(port), *words) as server:
        server.wait_for(answers)
        yield server, f"http://{HOST}:{port}/?url={quote(data, safe='')}"


def screenshot(view: Path, out: Path, frame: int | None = None) -> None:
    """Draw an .rrd file as a PNG without a screen.

    Args:
        view: the file.
        out: the PNG file, which is replaced.
        frame: frame of the time cursor; by default the last.

    Raises:
        CdmisfaError: there is no driver, or the viewer fails.
    """
    if sys.platform.startswith("linux") and not vulkan_drivers():
        raise UsageError(f"{out} cannot be drawn: no Vulkan driver is installed; {INSTALL}")
    port = str(free_port())
    words = ("--headless", "--hide-welcome-screen", "--window-size", WINDOW)
    with Program(*words, "--port", port, str(view)) as viewer:
        client = viewer.connect(port, frame)
        time.sleep(SETTLE)
        viewer.wait_for(lambda: is_painted(client))
        png = bytes(viewer.wait_for(client.take_screenshot))
    with atomic_write(out) as partial:
        partial.write_bytes(png)


def frame_at(path: Path, at: str) -> int:
    """Return the number of the frame that --at names.

    Args:
        path: a run or recording, or an .rrd file.
        at: a frame, as "20000"; of a run also an iteration, as "iteration 500", or words of an
            event, as "module 2": the first one that has them.

    Raises:
        UsageError: there is no such iteration or event.
        LogDamagedError: the log cannot be read.
    """
    if at.isdecimal():
        return int(at)
    if path.suffix != ".rrd" and holds_run(path):
        if match := ITERATION_PATTERN.fullmatch(at.strip()):
            for columns in read_columns(path):
                for frame in columns.frames[columns.iterations == int(match[1])]:
                    return int(frame)
        words = re.compile(rf"\b{re.escape(at.strip())}\b", re.IGNORECASE)
        for batch in read_batches(path, topics=(EVENT_TOPIC,)):
            for event in batch.events:
                if words.search(event.text):
                    return int(event.t)
    raise UsageError(
        f"--at {at!r} is not a frame, iteration or event of {path}: write it as 2000, "
        "'iteration 50' or 'module 2'"
    )


def free_port(port: int = 0) -> int:
    """Return a port of this machine at which nothing listens.

    Args:
        port: the requested port; 0 for any.

    Raises:
        CdmisfaError: the port is taken, or this user may not use it.
    """
    with socket.socket() as probe:
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise CdmisfaError(f"--port {port}: {error.strerror}; choose another port") from error
        return int(probe.getsockname()[1])


def has_display() -> bool:
    """Return whether a window can be opened."""
    displays = map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))
    return not sys.platform.startswith("linux") or any(displays)


def vulkan_drivers() -> list[Path]:
    """Return the manifests of the Vulkan drivers that a loader would find."""
    chosen = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    if chosen:
        return [p for p in map(Path, chosen.split(os.pathsep)) if p.exists()]
    shared = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    folders = (Path(f, "vulkan", "icd.d") for f in ("/etc", *shared.split(os.pathsep)))
    return sorted(file for folder in folders for file in folder.glob("*.json"))
