"""Damage files of every kind and read them with a command.

It gives a result or one clear line, in less than 5 s and 512 MB. `verify` never calls changed
bytes whole. What is learned from frames under checksums is what was learned from the undamaged
files, or an error.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from replay.runs.provenance import facts_sha256

from .cases import Defect, Job
from .commands import here, judge, must
from .materials import MAKERS
from .mutations import damage

MEGABYTES = 512

Words = tuple[object, ...]
Line = Callable[[Path, Path], Words]
"""Returns a command, of a damaged folder and a path for what it writes."""

QUICK = ("--max-iterations", 3, "--set", "learner.tau=10", "--no-rerun", "--json")
ONCE = ("--passes", 1)  # else a log that was cut is read again, and has other signals
SIZE = ("--size", "16x12")
RATE = ("--rate", 25)
BOTH = ("--topic", "/cam_left", "--topic", "/cam_right")


@dataclass(frozen=True, slots=True)
class Kind:
    """Files of a kind and the commands that read them.

    Attributes:
        lines: commands.
        files: pattern of the files that are damaged.
        learn: command whose signals are the same, or an error; None without checksums.
        verified: whether `verify` notices every change.
        of: kind of the material, where it is another's.
    """

    lines: tuple[Line, ...]
    files: str = "**/*"
    learn: Line | None = None
    verified: bool = False
    of: str = ""


def _first(place: Path) -> Path:
    return min(path for path in place.rglob("*") if path.is_file())


def _learn(*options: object) -> Line:
    return lambda place, out: ("learn", *sorted(place.iterdir()), *SIZE, *options, *ONCE, *QUICK)


def _convert(*options: object) -> Line:
    return lambda place, out: ("convert", *sorted(place.iterdir()), *SIZE, *options, "-o", out)


def _resume(place: Path, out: Path) -> Words:
    return ("learn", "-o", place, "--resume", "--max-iterations", 70, "--no-rerun", "--json")


def _recorded(place: Path, out: Path) -> Words:
    return ("learn", place, *ONCE, *QUICK)


LOGS: tuple[Line, ...] = (
    lambda place, out: ("info", place),
    lambda place, out: ("recover", _first(place), "-o", out.with_suffix(".mcap")),
    lambda place, out: ("learn", place, "--skip-damaged", *QUICK),
)
RUNS: tuple[Line, ...] = (
    lambda place, out: ("info", place),
    lambda place, out: ("export", place, "-o", out.with_suffix(".npz")),
    lambda place, out: ("compare", place, place),
    lambda place, out: ("recover", place / "run.mcap", "-o", out.with_suffix(".mcap")),
    _resume,
)
RESUMED: tuple[Line, ...] = (
    lambda place, out: ("info", place),
    lambda place, out: (
        *("record", "oscillatory", "-o", place, "--resume", "--frames", 300, "--seed", 5),
    ),
)
PRESETS: tuple[Line, ...] = (
    lambda place, out: ("learn", "oscillatory", "--preset", _first(place), *QUICK),
)

KINDS: Mapping[str, Kind] = {
    "recording": Kind(LOGS, learn=_recorded, verified=True),
    "recording of images": Kind(
        (*LOGS, lambda place, out: ("export", place, "--to", "images", "-o", out)),
        learn=_recorded,
        verified=True,
    ),
    "recording in parts": Kind(LOGS, learn=_recorded, verified=True),
    "recording begun": Kind((*RESUMED, *LOGS[-1:]), verified=True),
    "run": Kind(RUNS, "run.mcap", verified=True),
    "modules.npz": Kind(RUNS, "modules.npz", verified=True, of="run"),
    "run.json": Kind(RUNS, "run.json", verified=True, of="run"),
    "run begun": Kind(RUNS[:1], learn=_resume),
    "progress run begun": Kind(RUNS[:1], learn=_resume),
    "preset": Kind(PRESETS),
    "camera log": Kind(
        (*LOGS[:2], _convert(*BOTH), _learn("--skip-damaged", *BOTH)), learn=_learn(*BOTH)
    ),
    "png": Kind((_convert(*RATE),), learn=_learn(*RATE)),
    "bag": Kind((_convert(*BOTH), _learn(*BOTH))),
    "db3": Kind((_convert(*BOTH), _learn(*BOTH))),
    "mp4": Kind((_convert(), _learn())),
    "mkv": Kind((_convert(), _learn())),
}


def prepare(folder: Path) -> tuple[Path, dict[str, set[str]]]:
    """Make all materials and learn from them; return their folder and the signals of each."""
    signals: dict[str, set[str]] = {}
    for name, make in MAKERS.items():
        make(folder / name)
    for name, kind in KINDS.items():
        place, out = folder / f"{name} once", folder / f"{name} out"
        for line in (*kind.lines, *([kind.learn] if kind.learn else ())):
            shutil.copytree(folder / (kind.of or name), place)
            ran = must(*line(place, out), done=(0, 3) if "begun" in name else (0,))
            if line is kind.learn:
                signals[name] = {ran.json["signals_sha256"]}
                for number in () if line is _resume else (1, 2):  # of a log that was cut
                    words = (*line(place, out), "--max-iterations", number)
                    signals[name].add(must(*words).json["signals_sha256"])
            shutil.rmtree(place)
            shutil.rmtree(out, ignore_errors=True)
    return folder, signals


def case(job: Job) -> str:
    """Damage a file of a kind; verify it and read it with one of the commands."""
    (folder, signals), name = job.shared, list(KINDS)[job.seed % len(KINDS)]
    kind, place, out = KINDS[name], job.folder / "damaged", job.folder / "out"
    shutil.copytree(folder / (kind.of or name), place)
    files = sorted(path for path in place.glob(kind.files) if path.is_file())
    before = [_content(path) for path in files]
    done = damage(job.rng, files)
    changed = [_content(path) for path in files] != before
    if kind.verified:
        ran = here("verify", place)
        if changed and ran.code == 0:
            raise Defect(f"{done}: verified as whole: {ran}")
        judge(ran)
    line = job.rng.choice((*kind.lines, *([kind.learn] * 2 if kind.learn else ())))
    ran = here(*line(place, out))
    result = judge(ran)
    # A PNG file does not say which of many it is: one in the place of another is whole.
    unnamed = name == "png" and "replaced" in done
    learned = line is kind.learn and ran.code == 0 and not unnamed
    if learned and ran.json["signals_sha256"] not in signals[name]:
        raise Defect(f"{done}: other signals and no error: {ran}")
    return result


def _content(path: Path) -> object:
    """Return what must not change unnoticed: of run.json the facts in the run's final record."""
    raw = path.read_bytes()
    if path.name != "run.json":
        return raw
    try:
        return facts_sha256(json.loads(raw))
    except (ValueError, AttributeError, RecursionError):
        return raw
