"""Commands whose results are the same bytes each time, however often they are resumed."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from camera_files import write_pictures

from replay.storage.identity import file_sha256

from .cases import Defect
from .commands import UNCLEAR, Ran, here, must
from .materials import EASY

Words = tuple[object, ...]
FRAMES = 4000
ITERATIONS = 300


@dataclass(frozen=True, slots=True)
class Work:
    """A command that is interrupted.

    Attributes:
        words: returns the command, of its output folder and the shared folder.
        resume: words that are added to resume it, or the whole command where `-o` is among them.
        result: reads what must be the same each time.
        blocks: number of blocks that it writes, each of which can be slowed down; else 0.
        log_fps: frames per second of log time of what it records.
    """

    words: Callable[[Path, Path], Words]
    resume: Words
    result: Callable[[Path], Any]
    blocks: int = 0
    log_fps: float = 50.0

    def again(self, place: Path, shared: Path) -> Words:
        """Return the command that resumes what is in `place`, or begins where nothing is."""
        if not (place.exists() and any(place.iterdir())):
            return self.words(place, shared)
        if "-o" in self.resume:
            return (*self.resume, place)
        return (*self.words(place, shared), *self.resume)

    def finish(self, place: Path, shared: Path, expected: Any) -> None:
        """Resume to the end and compare the result."""
        ran = here(*self.again(place, shared))
        if not_begun(ran):
            ran = here(*self.words(place, shared), "--force")
        if ran.code != 0:
            raise Defect(f"{'unclear' if UNCLEAR.search(ran.err) else 'not resumed'}: {ran}")
        if (result := self.result(place)) != expected:
            raise Defect(f"another result, {result}: {ran}")


def not_begun(ran: Ran) -> bool:
    """Return whether a command refused to resume because nothing of use is there yet."""
    return ran.code == 2 and ("to resume: start" in ran.err or "fork again with --f" in ran.err)


def _files(place: Path) -> dict[str, str]:
    paths = sorted(place.rglob("*.mcap"))
    return {str(path.relative_to(place)): file_sha256(path) for path in paths}


def _run(place: Path) -> dict[str, Any]:
    result = json.loads((place / "run.json").read_text())["result"]
    return {
        "verified": here("verify", place).code == 0,
        "modules.npz": file_sha256(place / "modules.npz"),
        **{key: result[key] for key in ("signals_sha256", "iterations", "modules", "ended")},
    }


def _sweep(place: Path) -> Any:
    return here("sweep", place, "--summary", "--json").json


def _learn(*words: object) -> Callable[[Path, Path], Words]:
    def line(place: Path, shared: Path) -> Words:
        source = [shared / word[1:] if str(word).startswith("@") else word for word in words]
        limit = ("--max-iterations", ITERATIONS, "--no-rerun")
        return ("learn", *source, "--seed", 3, "-o", place, *limit)

    return line


def _record(*words: object) -> Callable[[Path, Path], Words]:
    return lambda place, shared: ("record", *words, "--seed", 3, "-o", place)


STREAMS = ("oscillatory", "--frames", FRAMES)
GRID = ("--grid", "learner.nu=0.03,0.05", "--seeds", "0:3", "--max-iterations", 40)
MODULES = (*EASY, "--max-modules", 9)
PICTURES = ("--rate", 25, "--size", "16x12")
RESUME = ("--resume",)

WORKS: Mapping[str, Work] = {
    "record": Work(_record(*STREAMS), RESUME, _files, blocks=250),
    "record --split": Work(_record(*STREAMS, "--split", "20s"), RESUME, _files, blocks=250),
    "record icub": Work(_record("icub", "--frames", 60), RESUME, _files),
    "learn, 2.0": Work(_learn("oscillatory", *MODULES), RESUME, _run, ITERATIONS),
    "learn, 2.0, recorded": Work(
        _learn("@recording", *MODULES, "--loop"), RESUME, _run, ITERATIONS
    ),
    "learn, progress, images": Work(
        _learn("@png/left", "@png/right", *PICTURES, "--loop"), RESUME, _run, ITERATIONS
    ),
    "fork": Work(
        lambda place, shared: (
            "fork",
            shared / "run",
            "--iteration",
            150,
            "--no-rerun",
            "-o",
            place,
        ),
        ("learn", "--resume", "--no-rerun", "-o"),
        *(_run, ITERATIONS // 2),
    ),
    "convert": Work(
        lambda place, shared: (
            *("convert", shared / "png" / "left", shared / "png" / "right"),
            *(*PICTURES, "-o", place),
        ),
        *(RESUME, _files, 50, 25.0),
    ),
    "sweep": Work(
        lambda place, shared: ("sweep", "oscillatory", *GRID, "--jobs", 1, "-o", place), (), _sweep
    ),
    "sweep --jobs 2": Work(
        lambda place, shared: ("sweep", "oscillatory", *GRID, "--jobs", 2, "-o", place), (), _sweep
    ),
}


def prepare(folder: Path, names: Collection[str]) -> tuple[dict[str, Any], dict[str, float]]:
    """Make what works read; return the result of each without interruption, and its seconds."""
    must("record", "oscillatory", "-o", folder / "recording", "--frames", FRAMES)
    must(*WORKS["learn, 2.0"].words(folder / "run", folder))
    (folder / "png").mkdir()
    for name in ("left", "right"):
        write_pictures(folder / "png" / name, 400)
    results, seconds = {}, {}
    for name in names:
        work, place, began = WORKS[name], folder / "done" / name, time.monotonic()
        must(*work.words(place, folder))
        results[name], seconds[name] = work.result(place), time.monotonic() - began
    return results, seconds
