"""Several at once: two commands to one output, a reader beside a writer, files that change.

Both commands end, with a result or a clear line; what is there then is what one of them was to
write. What reads a recording that is written, removed, replaced or overwritten meanwhile gives the
signals of the frames that were there, or an error.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from camera_files import write_pictures
from pyarrow import csv, parquet

from . import materials
from .commands import Fork, Ran, here, judge, must, until, worst
from .kills import check_disk
from .outcomes import MIXED, RIGHT, WRONG, Defect, Job, Limits, Outcome
from .witness import witnessing
from .works import EASY, files
from .works import run as run_result

LIMITS = Limits(seconds=120, enough=300, beside=2, share=2)

Words = tuple[object, ...]
Line = Callable[[Path, Path], Words]

LEARN = (*EASY, "--max-iterations", 60, "--no-rerun")
WRITERS: dict[str, tuple[Line, Callable[[Path], Any]]] = {
    "record": (
        lambda at, out: ("record", "oscillatory", "--frames", 500, "-o", out),
        files,
    ),
    "learn": (lambda at, out: ("learn", at / "recording", "--loop", *LEARN, "-o", out), run_result),
    "convert": (
        lambda at, out: (
            *("convert", at / "png" / "left", at / "png" / "right", "--rate", 25),
            *("--size", "16x12", "-o", out),
        ),
        files,
    ),
    "recover": (
        lambda at, out: ("recover", at / "recording" / "x1.mcap", "-o", out / "x1.mcap"),
        files,
    ),
    "export": (
        lambda at, out: ("export", at / "run", "-o", out / "run.csv"),
        lambda out: (out / "run.csv").read_bytes(),
    ),
    "export images": (
        lambda at, out: ("export", at / "images", "--to", "images", "-o", out),
        lambda out: {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*.png")},
    ),
    "sweep": (
        lambda at, out: (
            *("sweep", "oscillatory", "--seeds", "0:3", "--max-iterations", 20, "-o", out),
        ),
        lambda out: here("results", out, "--json").json,
    ),
}
READERS: dict[str, Line] = {
    "info": lambda at, out: ("info", at),
    "verify": lambda at, out: ("verify", at),
    "recover": lambda at, out: ("recover", at / "x1.mcap.partial", "-o", out / "x.mcap"),
    "learn": lambda at, out: ("learn", at, *LEARN),
}


TWO = ("--topic", "/cam_left", "--topic", "/cam_right", "--size", "16x12")
OTHERS: dict[str, Words] = {
    "png": ("--rate", 25, "--size", "16x12"),
    "bag": TWO,
    "db3": TWO,
    "mp4": ("--size", "16x12"),
    "csv": ("--rate", 25),
    "parquet": ("--rate", 25),
}
"""Inputs without checksums, and the options with which they are read."""


def _table(folder: Path) -> Path:
    """One of numbers, in both forms."""
    table = pyarrow.table({f"x{i}": np.sin(np.arange(3000) / (7 + i)) for i in range(4)})
    for name in ("csv", "parquet"):
        (folder / name).mkdir()
    csv.write_csv(table, folder / "csv" / "a.csv")
    parquet.write_table(table, folder / "parquet" / "a.parquet", row_group_size=100)
    return folder


def prepare(folder: Path) -> dict[str, Any]:
    """What is read, and what commands give that are alone."""
    for seed, name in enumerate(("recording", "other")):
        words = ("record", "oscillatory", "--frames", 1500, "--seed", seed, "-o", folder / name)
        must(folder, *words)
    (folder / "png").mkdir()
    for name in ("left", "right"):
        write_pictures(folder / "png" / name, 100)
    must(folder, *WRITERS["convert"][0](folder, folder / "images"))
    must(folder, "learn", folder / "recording", "--loop", *LEARN, "-o", folder / "run")
    results = {}
    for name, (line, result) in WRITERS.items():
        place = folder / "alone" / name
        ran = here(*line(folder, place))
        if ran.code != 0:
            raise Defect(WRONG, "setup", f"{ran.line}: {ran.told()}")
        results[name] = result(place)
    learned = here("learn", folder / "recording", *LEARN, "--json").json["signals_sha256"]
    others = [kind for kind in OTHERS if kind not in materials.missing()]
    (folder / "others").mkdir()
    _table(folder / "others")
    for kind in others:
        if kind in materials.MAKERS:
            materials.MAKERS[kind](folder / "others" / kind)
    return {"folder": folder, "results": results, "learned": learned, "others": others}


def case(job: Job) -> Outcome:
    """One of the three; each other file that is read is no recording."""
    reading = (_while_others_are_read, _while_it_is_read)[job.seed // 3 % 2]
    return (_two_writers, _beside_a_writer, reading)[job.seed % 3](job)


def _two_writers(job: Job) -> Outcome:
    name = job.rng.choice(list(WRITERS))
    line, result = WRITERS[name]
    place, group = job.folder / "out", f"two of {name} to one output"
    words = line(job.given["folder"], place)
    force = ("--force",) if name != "sweep" else ()
    pause = job.rng.choice((0.0, 0.01))
    begun = []
    for number in range(2):
        chosen = force if job.rng.random() < 0.5 else ()
        tweak = witnessing(job.folder / f"witness{number}", pause)
        begun.append(Fork(job.folder, *words, *chosen, tweak=tweak))
        until(lambda: False, job.rng.choice((0.0, 0.01, 0.1, 0.5)))
    ended = [process.wait(60, group, "beside another") for process in begun]
    outcomes = [judge(ran, group, limit=None) for ran in ended]
    check_disk(place, {}, group, ended[0])
    told = [(ran.code, ran.told()) for ran in ended]
    if all(code != 0 for code, _ in told):
        raise Defect(WRONG, group, f"{ended[0].line}: neither wrote it: {told}")
    if result(place) != job.given["results"][name]:
        raise Defect(MIXED, group, f"{ended[0].line}: {told}")
    if left := [path.name for path in job.folder.rglob("*.partial")]:
        raise Defect(WRONG, group, f"{ended[0].line}: {told}, and there is {left}")
    return worst(outcomes)


def _beside_a_writer(job: Job) -> Outcome:
    name = job.rng.choice(list(READERS))
    place, group = job.folder / "rec", f"{name} beside its writer"
    (job.folder / "out").mkdir()
    pause = job.rng.choice((0.0, 0.005))
    words = ("record", "oscillatory", "--frames", 1500, "--seed", 0, "-o", place)
    writer = Fork(job.folder, *words, tweak=witnessing(job.folder / "witness", pause))
    outcomes = []
    while writer.running:
        until(lambda: not writer.running, job.rng.uniform(0, 0.3))
        ran = here(*READERS[name](place, job.folder / "out"), "--json")
        outcomes.append(judge(ran, group))
        if name == "learn" and ran.code == 0 and not _begins_as(job.given["folder"], ran):
            raise Defect(MIXED, group, f"{ran.line}: other signals, no error")
        shutil.rmtree(job.folder / "out")
        (job.folder / "out").mkdir()
    written = writer.wait(5, group)
    if written.code != 0 or files(place) != files(job.given["folder"] / "recording"):
        raise Defect(WRONG, group, f"{written.line}: {written.told()}")
    return worst(outcomes or [Outcome(RIGHT, group)])


def _begins_as(folder: Path, ran: Ran) -> bool:
    """Whether what was learned of a recording that had come so far is how the whole one begins."""
    first = ("--max-iterations", ran.json["iterations"])
    whole = here("learn", folder / "recording", *LEARN, *first, "--json")
    return bool(whole.json["signals_sha256"] == ran.json["signals_sha256"])


def _removed(path: Path, other: Path) -> None:
    path.unlink()


def _replaced(path: Path, other: Path) -> None:
    copy = path.with_name("other")
    shutil.copy(other, copy)
    os.replace(copy, path)


def _cut(path: Path, other: Path) -> None:
    os.truncate(path, path.stat().st_size // 3)


def _overwritten(path: Path, other: Path) -> None:
    with path.open("r+b") as file:
        file.write(other.read_bytes())


def _emptied(path: Path, other: Path) -> None:
    os.truncate(path, 0)


CHANGES = (_removed, _replaced, _cut, _overwritten, _emptied)


def _while_it_is_read(job: Job) -> Outcome:
    change = job.rng.choice(CHANGES)
    group = f"a file {change.__name__[1:]} while it is learned from"
    shared, place, run = job.given["folder"], job.folder / "rec", job.folder / "run"
    shutil.copytree(shared / "recording", place)
    words = ("learn", place, *LEARN, "--json", "-o", run)
    reader = Fork(job.folder, *words, tweak=witnessing(job.folder / "witness", 0.005))
    until(lambda: not reader.running, job.rng.uniform(0, 0.6))
    name = job.rng.choice(("x1.mcap", "x2.mcap", "x3.mcap"))
    change(place / name, shared / "other" / name)
    ran = reader.wait(30, group)
    outcome = judge(ran, group, limit=None)
    if ran.code == 0 and ran.json["signals_sha256"] != job.given["learned"]:
        raise Defect(MIXED, group, f"{ran.line}: other signals, no error")
    check_disk(run, {}, group, ran)
    return outcome


def _while_others_are_read(job: Job) -> Outcome:
    """Nothing tells other pixels from those that were there, but no reader falls over them."""
    kind, change = job.rng.choice(job.given["others"]), job.rng.choice(CHANGES)
    command = job.rng.choice(("learn", "convert"))
    group = f"{kind} {change.__name__[1:]} while it is read"
    place = job.folder / "in"
    shutil.copytree(job.given["folder"] / "others" / kind, place)
    files = sorted(path for path in place.rglob("*") if path.is_file())
    inputs = sorted(place.iterdir())
    how = (*LEARN, "--loop") if command == "learn" else ("-o", job.folder / "out")
    reader = Fork(
        job.folder,
        *(command, *inputs, *OTHERS[kind], *how),
        tweak=witnessing(job.folder / "witness", 0.01),
    )
    until(lambda: not reader.running, job.rng.uniform(0, 0.6))
    one, other = job.rng.choice(files), job.rng.choice(files)
    change(one, other)
    return judge(reader.wait(30, group), group, limit=None)
