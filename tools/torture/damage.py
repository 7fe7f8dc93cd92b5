"""Files of every kind, damaged: flipped bits, cut off, zeroed, spliced, doubled, emptied.

Each is then read by commands that would read it, in less than 5 s and 512 MB, with a result or one
clear line. Verify never calls changed bytes whole; what is learned of frames under checksums is
what was learned of the undamaged files, or an error.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from replay.runs.run import facts_sha256

from .commands import Ran, here, judge, worst
from .materials import MAKERS, missing
from .mutations import damage
from .outcomes import MIXED, WRONG, Defect, Job, Limits, Outcome

LIMITS = Limits(seconds=60, megabytes=512, share=10, enough=10_000)

Words = tuple[object, ...]
Line = Callable[[Path, Path], Words]
"""A command of what is damaged, and of a name for what it writes."""

QUICK = ("--max-iterations", 3, "--set", "learner.tau=10", "--no-rerun", "--json")


@dataclass(frozen=True, slots=True)
class Kind:
    """Files of a kind, and what is done with them.

    Attributes:
        lines: commands that read them.
        files: which of them are damaged.
        learn: a command whose signals are the same or not there; None where no checksum is.
        proven: whether verify states that nothing was changed.
    """

    lines: tuple[Line, ...]
    files: str = "**/*"
    learn: Line | None = None
    proven: bool = False


def _first(place: Path) -> Path:
    return min(path for path in place.rglob("*") if path.is_file())


def _foreign(*options: object) -> Line:
    def line(place: Path, out: Path) -> Words:
        return ("learn", *sorted(place.iterdir()), "--size", "16x12", *options, *QUICK)

    return line


def _converted(*options: object) -> Line:
    def line(place: Path, out: Path) -> Words:
        return ("convert", *sorted(place.iterdir()), "--size", "16x12", *options, "-o", out)

    return line


def _going_on(place: Path, out: Path) -> Words:
    return ("learn", "-o", place, "--resume", "--max-iterations", 70, "--no-rerun", "--json")


LOGS: tuple[Line, ...] = (
    lambda place, out: ("info", place),
    lambda place, out: ("recover", _first(place), "-o", out.with_suffix(".mcap")),
    lambda place, out: ("learn", place, "--salvage", *QUICK),
)
RUNS: tuple[Line, ...] = (
    lambda place, out: ("info", place),
    lambda place, out: ("export", place, "-o", out.with_suffix(".npz")),
    lambda place, out: ("export", place, "-o", out.with_suffix(".csv")),
    lambda place, out: ("compare", place, place),
    lambda place, out: ("recover", place / "run.mcap", "-o", out.with_suffix(".mcap")),
    _going_on,
)
BOTH = ("--topic", "/cam_left", "--topic", "/cam_right")

KINDS: Mapping[str, Kind] = {
    "recording": Kind(LOGS, learn=lambda place, out: ("learn", place, *QUICK), proven=True),
    "recording of images": Kind(
        (*LOGS, lambda place, out: ("export", place, "--to", "images", "-o", out)),
        learn=lambda place, out: ("learn", place, *QUICK),
        proven=True,
    ),
    "recording in parts": Kind(
        LOGS, learn=lambda place, out: ("learn", place, *QUICK), proven=True
    ),
    "recording begun": Kind(
        (
            lambda place, out: ("info", place),
            lambda place, out: (
                *("record", "oscillatory", "-o", place, "--resume"),
                *("--frames", 300, "--seed", 5),
            ),
            lambda place, out: ("learn", place, "--salvage", *QUICK),
        ),
        proven=True,
    ),
    "run": Kind(RUNS, "run.mcap", proven=True),
    "modules.npz": Kind(RUNS, "modules.npz", proven=True),
    "run.json": Kind(RUNS, "run.json", proven=True),
    "run begun": Kind(RUNS[:1], learn=_going_on),
    "progress run begun": Kind(RUNS[:1], learn=_going_on),
    "preset": Kind(
        (
            lambda place, out: ("learn", "oscillatory", "--preset", _first(place), *QUICK),
            lambda place, out: (
                *("record", "oscillatory", "--preset", place / "oscillatory.toml"),
                *("--frames", 5, "-o", out),
            ),
        )
    ),
    "sweep": Kind((lambda place, out: ("results", place, "--json"),)),
    "camera log": Kind(
        (*LOGS[:2], _converted(*BOTH), _foreign("--salvage", *BOTH)), learn=_foreign(*BOTH)
    ),
    "png": Kind((_converted("--rate", 25),), learn=_foreign("--rate", 25)),
    "jpg": Kind((_converted("--rate", 25), _foreign("--rate", 25))),
    "bag": Kind((_converted(*BOTH), _foreign(*BOTH))),
    "db3": Kind((_converted(*BOTH), _foreign(*BOTH))),
    "mp4": Kind((_converted(), _foreign())),
    "mkv": Kind((_converted(), _foreign())),
}
OF = {
    "modules.npz": "run",
    "run.json": "run",
}
"""Kinds of files that are of other materials."""

UNNAMED = ("png",)
"""Files that do not say which of many they are: one in the place of another is whole."""


def prepare(folder: Path) -> dict[str, Any]:
    """Make all materials, and learn of them: also so that everything is imported."""
    signals = {}
    for name in MAKERS.keys() - missing():
        MAKERS[name](folder / name)
    for name, kind in KINDS.items():
        if (source := folder / OF.get(name, name)).exists():
            place, out = folder / f"{name} once", folder / f"{name} out"
            for line in (*kind.lines, kind.learn):
                if line is not None:
                    shutil.copytree(source, place)
                    ran = here(*line(place, out))
                    if ran.code not in (0, 3 if "begun" in name else 0):
                        raise Defect(WRONG, "setup", f"{ran.line}: {ran.told()}")
                    if line is kind.learn:
                        signals[name] = {ran.json["signals_sha256"], *_shorter(line, place, out)}
                    shutil.rmtree(place)
                    shutil.rmtree(out, ignore_errors=True)
    return {"folder": folder, "signals": signals}


def _shorter(line: Line, place: Path, out: Path) -> list[str]:
    """The signals of fewer iterations: a log that was cut short has no more, and that is said."""
    words = line(place, out)
    if "--resume" in words:
        return []
    return [here(*words, "--max-iterations", n).json["signals_sha256"] for n in (1, 2)]


def case(job: Job) -> Outcome:
    """Damage a file, and read it in two ways."""
    name = list(KINDS)[job.seed % len(KINDS)]
    kind, source = KINDS[name], job.given["folder"] / OF.get(name, name)
    if not source.exists():
        return Outcome("skipped", name, "a package is not installed")
    place, out = job.folder / "damaged", job.folder / "out"
    shutil.copytree(source, place)
    files = sorted(path for path in place.glob(kind.files) if path.is_file())
    before = [_content(path) for path in files]
    done = damage(job.rng, files)
    changed = [_content(path) for path in files] != before
    outcomes = []
    if kind.proven:
        outcomes.append(_verified(name, place, done, changed))
    line = job.rng.choice((*kind.lines, *([kind.learn] * 2 if kind.learn else ())))
    ran = here(*line(place, out))
    outcomes.append(judge(ran, name))
    exchanged = "replaced" in done and name in UNNAMED
    learned = line is kind.learn and ran.code == 0 and not exchanged
    if learned and ran.json["signals_sha256"] not in job.given["signals"][name]:
        raise Defect(MIXED, name, f"{done}: {ran.line}: other signals, no error")
    return worst(outcomes)


def _content(path: Path) -> object:
    """What must not change unseen: of run.json what the run's final record states."""
    raw = path.read_bytes()
    if path.name != "run.json":
        return raw
    try:
        return facts_sha256(json.loads(raw))
    except (ValueError, AttributeError, RecursionError):
        return raw


def _verified(name: str, place: Path, done: str, changed: bool) -> Outcome:
    ran: Ran = here("verify", place)
    if changed and ran.code == 0:
        raise Defect(WRONG, name, f"{done}: {ran.line}: whole")
    return judge(ran, name)
