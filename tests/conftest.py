"""Fixtures that several areas share."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from ignored_signals import let_children_be_signalled
from waiting import listens, wait_for

MEMORY, ROOM = Path("/dev/shm"), 6 << 30
if "TMPDIR" not in os.environ and MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM:
    # What tests write is synced some thousand times, which a disk takes milliseconds for.
    os.environ["TMPDIR"] = tempfile.tempdir = str(MEMORY)

# Rerun drops data that it does not understand, with a warning only, unless told so.
os.environ.setdefault("RERUN_STRICT", "1")

if "PYTEST_XDIST_WORKER" in os.environ:
    # Other cores have processes of their own: threads for one product would wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Machines are shared, and a test run says the same thing every time.
hypothesis.settings.register_profile("cdmisfa", deadline=None, derandomize=True)
hypothesis.settings.load_profile("cdmisfa")


@dataclass(frozen=True)
class Outcome:
    """What a command left: its exit code and what it wrote."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The one document on stdout; anything else there fails."""
        return json.loads(self.out)


Cdmisfa = Callable[..., Outcome]


SLOW = (
    "test_bombs.py",
    "test_moments.py",
    "test_notebook.py",
    "test_page_blocks.py",
    "test_viewer.py",
)
"""Files with a test, or a group of tests, that takes tens of seconds."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what would leave other processes idle at the end."""
    items.sort(key=lambda item: item.path.name not in SLOW)


@pytest.fixture(scope="session", autouse=True)
def _signalled_children() -> None:
    """What tests begin and end with signals ends, though the tests were begun under nohup."""
    let_children_be_signalled()


@pytest.fixture(scope="module", params=["_plain", "_wide"])
def both_modules(request: pytest.FixtureRequest) -> Iterator[None]:
    """Tests of kernels run with each of the two modules that were compiled."""
    from both_modules import using

    from cdmisfa import kernels

    if request.param == "_wide" and not kernels.WIDE:
        pytest.skip("this processor has no AVX2")
    with using(importlib.import_module(f"cdmisfa.kernels.{request.param}")):
        yield


@pytest.fixture
def cdmisfa(capfd: pytest.CaptureFixture[str]) -> Cdmisfa:
    """Run the command line in this process and take what it wrote."""
    from cdmisfa.cli import run

    def call(*args: object) -> Outcome:
        capfd.readouterr()
        code = run([str(arg) for arg in args])
        written = capfd.readouterr()
        return Outcome(code, written.out, written.err)

    return call


@pytest.fixture(scope="session")
def oscillatory_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the oscillatory streams, 2000 frames; not to be changed."""
    from cdmisfa.cli import run

    folder = tmp_path_factory.mktemp("recordings") / "oscillatory"
    assert run(["record", "oscillatory", "-o", str(folder), "--frames", "2000"]) == 0
    return folder


@pytest.fixture(scope="session")
def oscillatory_run(tmp_path_factory: pytest.TempPathFactory, oscillatory_recording: Path) -> Path:
    """A run of 15 iterations on that recording, without a Rerun view; not to be changed."""
    from cdmisfa.cli import run

    folder = tmp_path_factory.mktemp("runs") / "oscillatory"
    words = ["learn", str(oscillatory_recording), "-o", str(folder)]
    assert run([*words, "--max-iterations", "15", "--no-rerun"]) == 0
    return folder


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A dask scheduler and two worker processes on loopback, as a user would start them."""
    pytest.importorskip("distributed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    dask = [sys.executable, "-m", "dask"]
    quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    port = address.rpartition(":")[2]
    started = [
        subprocess.Popen(
            [*dask, "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"], **quiet
        )
    ]
    for _ in range(2):
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
        started.append(subprocess.Popen([*dask, "worker", address, *options], **quiet))
    try:
        wait_for(lambda: listens(int(port)), seconds=60)
        yield address, started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait()


@pytest.fixture
def keyframes_every(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let runs keep the learner's state every so many iterations, whatever room that takes."""
    from cdmisfa.experiments.session import Session

    defaults: Any = Session.learn.__kwdefaults__
    return lambda every: monkeypatch.setitem(defaults, "keyframes", every)
