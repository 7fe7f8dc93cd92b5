"""What is killed: commands whose results are the same each time, however often they are resumed."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from camera_files import write_pictures

from replay.storage.identity import file_sha256

from .commands import here, must
from .materials import EASY
from .outcomes import WRONG, Defect

Words = tuple[object, ...]
FRAMES = 4000
ITERATIONS = 300


@dataclass(frozen=True, slots=True)
class Work:
    """A command that is killed.

    Attributes:
        words: of the command, of where it writes and of the shared folder.
        again: what is added to go on.
        result: what it came to, the same each time.
        share: how often it is killed, relative to others.
        blocks: how many it writes, each of which is waited for so that it takes some seconds; 0
            where it takes its own time.
        log_fps: of what it records.
        on: what goes on with it, where those are other words.
    """

    words: Callable[[Path, Path], Words]
    again: Words
    result: Callable[[Path], Any]
    share: float
    blocks: int = 0
    log_fps: float = 50.0
    on: Callable[[Path], Words] | None = None


def files(place: Path) -> dict[str, str]:
    """Of a recording: every byte."""
    return {
        str(path.relative_to(place)): file_sha256(path) for path in sorted(place.rglob("*.mcap"))
    }


def run(place: Path) -> dict[str, Any]:
    """Of a run: its signals and modules; also that it proves itself."""
    verified = here("verify", place)
    document = json.loads((place / "run.json").read_text())["result"]
    return {
        "whole": verified.code == 0,
        "modules": file_sha256(place / "modules.npz"),
        **{key: document[key] for key in ("signals_sha256", "iterations", "modules", "ended")},
    }


def sweep(place: Path) -> Any:
    """Of a sweep: the mean of each point."""
    return here("results", place, "--json").json


def reproduction(place: Path) -> Any:
    """Of a reproduced experiment."""
    return json.loads((place / "five" / "results.json").read_text())


def _learn(*words: object) -> Callable[[Path, Path], Words]:
    def line(place: Path, shared: Path) -> Words:
        source = [shared / word[1:] if str(word).startswith("@") else word for word in words]
        limit = ("--max-iterations", ITERATIONS, "--no-rerun")
        return ("learn", *source, "--seed", 3, "-o", place, *limit)

    return line


def _record(*words: object) -> Callable[[Path, Path], Words]:
    return lambda place, shared: ("record", *words, "--seed", 3, "-o", place)


def _sweep(jobs: int) -> Callable[[Path, Path], Words]:
    grid = ("--grid", "learner.nu=0.03,0.05", "--seeds", "0:3", "--max-iterations", 40)
    return lambda place, shared: ("sweep", "oscillatory", *grid, "--jobs", jobs, "-o", place)


PARTS = ("--split", "20s")
MODULES = ("--max-modules", 9)
RESUME = ("--resume",)
STREAMS = ("oscillatory", "--frames", FRAMES)

WORKS: Mapping[str, Work] = {
    "record oscillatory": Work(_record(*STREAMS), RESUME, files, 20, blocks=250),
    "record oscillatory --split": Work(_record(*STREAMS, *PARTS), RESUME, files, 12, blocks=250),
    "record icub": Work(_record("icub", "--frames", 60), RESUME, files, 4),
    "learn, 2.0": Work(_learn("oscillatory", *EASY, *MODULES), RESUME, run, 20, blocks=ITERATIONS),
    "learn, 2.0, recorded": Work(
        _learn("@recording", *EASY, *MODULES, "--loop"), RESUME, run, 10, blocks=ITERATIONS
    ),
    "learn, progress": Work(
        _learn("oscillatory", "--algorithm", "progress"), RESUME, run, 15, blocks=130
    ),
    "learn, progress, pictures": Work(
        _learn("@png/left", "@png/right", "--rate", 25, "--size", "16x12", "--loop"),
        *(RESUME, run, 8, ITERATIONS),
    ),
    "fork": Work(
        lambda place, shared: ("fork", shared / "run", "--at", 150, "--no-rerun", "-o", place),
        *((), run, 10, ITERATIONS // 2),
        on=lambda place: ("learn", "-o", place, "--resume", "--no-rerun"),
    ),
    "convert": Work(
        lambda place, shared: (
            *("convert", shared / "png" / "left", shared / "png" / "right"),
            *("--rate", 25, "--size", "16x12", "-o", place),
        ),
        *(RESUME, files, 12, 50, 25.0),
    ),
    "sweep": Work(_sweep(1), (), sweep, 5),
    "sweep --jobs 2": Work(_sweep(2), (), sweep, 2),
    "reproduce": Work(
        lambda place, shared: ("reproduce", "five", "--trials", 10, "-o", place),
        *((), reproduction, 5),
    ),
}


def prepared(folder: Path, names: Collection[str]) -> dict[str, Any]:
    """Results of works that nobody stops, and how many seconds each takes."""
    must(folder, "record", "oscillatory", "-o", folder / "recording", "--frames", FRAMES)
    must(folder, *WORKS["learn, 2.0"].words(folder / "run", folder))
    (folder / "png").mkdir()
    for name in ("left", "right"):
        write_pictures(folder / "png" / name, 400)
    results, seconds = {}, {}
    for name in names:
        work, place = WORKS[name], folder / "done" / name
        began = time.monotonic()
        ran = here(*work.words(place, folder))
        if ran.code != 0:
            raise Defect(WRONG, "setup", f"{ran.line}: exit {ran.code}: {ran.told()}")
        results[name], seconds[name] = work.result(place), time.monotonic() - began
    return {"folder": folder, "results": results, "seconds": seconds}
