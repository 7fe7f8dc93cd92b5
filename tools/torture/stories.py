"""What is done to a folder, how it is gone on with, and what must come of it.

The rule, whatever happens on the way: what is on disk is readable, and going on gives the bits of
an uninterrupted run, or one clear line with an exit code and nothing worse.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import multiprocessing
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from camera_files import write_cameras

from cdmisfa.cli import run
from cdmisfa.core.errors import CdmisfaError
from cdmisfa.experiments.resume import log_to_resume
from cdmisfa.experiments.store import read_rows
from recorder.log.resume import frames_held
from recorder.mcap.reader import LogReader
from replay.runs.folders import MODULES_FILE, RUN_FILE, RUN_JSON
from replay.runs.keyframes import read_keyframe
from replay.runs.modules import load_modules

from .calls import Refusal, watched
from .outcomes import LOST, MIXED, TRACEBACK, WRONG, Defect

FRAMES = 400
ITERATIONS = 450
"""Of a run: its last keyframes are at 400 and 450."""

OUT, GIVEN = "out", "given"
"""In a story's folder: what it writes, and what it is given."""


@dataclass(frozen=True, slots=True)
class Story:
    """Something that a user does.

    Attributes:
        name: of it.
        words: the command, in the story's folder.
        on: commands that go on with it after it was cut short, the next where one refuses.
        result: what must be the same bits however it came about, of the folder written.
        begin: makes what is there before, in the story's folder.
        progress: how far what is written has come; going on never loses it.
        done: exit codes of success.
    """

    name: str
    words: str
    on: tuple[str, ...]
    result: Callable[[Path], Any]
    begin: Callable[[Path], None] = lambda folder: None
    progress: Callable[[Path], int] = lambda out: 0
    done: tuple[int, ...] = (0,)


@dataclass(frozen=True, slots=True)
class Ended:
    """How a command ended."""

    words: str
    code: int
    out: str
    err: str

    def __str__(self) -> str:
        return f"{self.words}: exit {self.code}: {self.err.strip()[-300:]}"


def command(folder: Path, words: str) -> Ended:
    """Run a command line in this process, its paths being in a folder."""
    args = [re.sub(rf"^({OUT}|{GIVEN})\b", lambda m: str(folder / m[0]), w) for w in words.split()]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), forked_workers():
        code = run(args)
    return Ended(words, code, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def forked_workers() -> Iterator[None]:
    """Have worker processes forked off this one: with what is watched here, and all imported."""
    fork = multiprocessing.get_context("fork")
    with mock.patch.object(multiprocessing, "get_context", return_value=fork):
        yield


def refuse_unclear(story: Story, ended: Ended) -> None:
    """Refuse an end that is neither success nor one clear line."""
    if ended.code in story.done:
        return
    if ended.code == 1 and not ended.err:  # a sweep tells of its trials, a line each
        failed = [line for line in ended.out.splitlines() if line.startswith("failed: ")]
        if failed and all("/" in line for line in failed):
            return
    lines = ended.err.splitlines() or [""]  # before it may be notices
    told = sum("cdmisfa: " in line or "Traceback" in line for line in lines)
    clear = told == 1 and re.match(r"cdmisfa: (?!unexpected).*/", lines[-1])  # names a path
    if ended.code not in (1, 2, 3) or not clear:
        raise Defect(TRACEBACK, story.name, str(ended))


def check(story: Story, folder: Path, expected: Any, what: str) -> str:
    """Check the rule on what something left in a story's folder.

    Args:
        story: what was done there.
        folder: is changed.
        expected: the result of an uninterrupted one.
        what: what happened, for the message.

    Returns:
        The command that went on with it.
    """
    try:
        refuse_unreadable(story, folder)
        refused = []
        for words in story.on:
            before = story.progress(folder / OUT) if (folder / OUT).exists() else 0
            ended = command(folder, words)
            refuse_unclear(story, ended)
            if ended.code in story.done:
                compare(story, folder, expected, str(ended))
                return words
            refused.append(str(ended))
            if "--force" not in words and (folder / OUT).exists():
                after = story.progress(folder / OUT)
                if after < before:
                    raise Defect(LOST, story.name, f"{ended}: {before} became {after}")
        raise Defect(WRONG, story.name, f"nothing goes on with it: {'; '.join(refused)}")
    except Defect as defect:
        kind, detail = defect.outcome.kind, defect.outcome.detail
        raise Defect(kind, story.name, f"{what}: {detail}") from defect


def compare(story: Story, folder: Path, expected: Any, what: str) -> None:
    """Refuse a result that is not the expected one."""
    found = story.result(folder / OUT)
    if found != expected:
        raise Defect(MIXED, story.name, f"{what}: {_difference(found, expected)}")


def _difference(found: Any, expected: Any) -> str:
    if isinstance(found, dict) and isinstance(expected, dict):
        keys = sorted(k for k in {*found, *expected} if found.get(k) != expected.get(k))
        return "; ".join(f"{k}: {found.get(k)!s:.90}, not {expected.get(k)!s:.90}" for k in keys)
    return f"{found!s:.200}, not {expected!s:.200}"


def refuse_unreadable(story: Story, folder: Path) -> None:
    """Refuse files that are not what their name says, and unclear words about those cut short."""
    out = folder / OUT
    for path in sorted(out.rglob("*")) if out.exists() else ():
        name = str(path.relative_to(folder))
        if path.name.endswith(".mcap"):
            ended = command(folder, f"verify {name}")
            if ended.code != 0:
                raise Defect(WRONG, story.name, f"{ended} {ended.out[-300:]}")
        elif ".mcap.partial" in path.name:
            ended = command(folder, f"info {name}")
            if ended.code != 3 or ended.err:  # else what it prints says that it was cut short
                refuse_unclear(story, ended)
        elif path.name == "modules.npz":
            load_modules(path)
        elif path.suffix == ".json":
            json.loads(path.read_text("utf-8"))


def expected(story: Story, folder: Path) -> Any:
    """The result of an uninterrupted one, in an empty folder."""
    story.begin(folder)
    ended = command(folder, story.words)
    if ended.code not in story.done:
        raise Defect(WRONG, story.name, str(ended))
    return story.result(folder / OUT)


def files(out: Path) -> dict[str, str]:
    """Every file with its bytes."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def learned(out: Path) -> dict[str, Any]:
    """A run's files, and its signals by its own check of them all."""
    ended = command(out, f"verify {out}")
    about = json.loads((out / "run.json").read_text("utf-8"))
    return {
        "verify": (ended.code, ended.out if ended.code else ""),
        "files": list(files(out)),
        "signals": about["result"]["signals_sha256"],
        "modules": files(out)["modules.npz"],
    }


def rows(out: Path) -> dict[str, Any]:
    """A sweep's rows, and the signals of the runs that it keeps."""
    found: dict[str, Any] = {r["id"]: (r["status"], r.get("result")) for r in read_rows(out)}
    runs = [path for path in sorted(out.glob("trials/*")) if path.is_dir()]
    return {**found, **{str(run.relative_to(out)): learned(run) for run in runs}}


def frames(out: Path) -> int:
    """Frames of a recording, in the best file of each view and part."""
    best: dict[str, int] = {}
    for path in out.glob("*.mcap*"):
        part = path.name.partition(".")[0]
        held = frames_held(path, part.partition("-")[0])
        best[part] = max(best.get(part, 0), held.stop - held.first)
    return sum(best.values())


def iterations(out: Path) -> int:
    """Iterations from which a run would go on."""
    try:
        keyframe = read_keyframe(log_to_resume(out))
    except CdmisfaError:
        return 0
    return keyframe.iteration if keyframe else 0


def done(out: Path) -> int:
    """Rows of a sweep that count."""
    return sum(row["status"] == "done" for row in read_rows(out))


def cut_short(folder: Path, words: str, name: str, writes: int) -> None:
    """Run a command on a disk that is full after so many writes to a file."""
    refuse = Refusal(writes, kinds=("write",), lasting=True)
    with watched(folder / OUT, lambda call: call.path.name.startswith(name) and refuse(call)):
        ended = command(folder, words)
    assert ended.code == 1, str(ended)


RECORD = f"record oscillatory -o {OUT} --frames {FRAMES}"
LEARN = f"learn {GIVEN} -o {OUT} --loop --set learner.tau=10"
LONG = f"{LEARN} --max-iterations {ITERATIONS} --no-rerun"
TORN = f"{GIVEN}/x1.mcap.partial"


def _recording(folder: Path) -> None:
    assert command(folder, f"record oscillatory -o {GIVEN} --frames {FRAMES}").code == 0


def _learned(folder: Path, words: str) -> None:
    _recording(folder)
    assert command(folder, words).code == 0


def _learning(folder: Path) -> None:
    _learned(folder, LONG)
    run = folder / OUT
    with LogReader(run / RUN_FILE) as reader:
        end = reader.segments[-1].offset  # of the last keyframe
    (run / f"{RUN_FILE}.partial").write_bytes((run / RUN_FILE).read_bytes()[:end])
    for name in (RUN_FILE, RUN_JSON, MODULES_FILE):
        (run / name).unlink()
    assert iterations(run) == 400


def _cameras(folder: Path) -> None:
    (folder / GIVEN).mkdir()
    write_cameras(folder / GIVEN / "cameras.mcap", {"/left": (60, 20), "/right": (60, 20)})


def _torn(folder: Path) -> None:
    _recording(folder)
    whole = folder / GIVEN / "x1.mcap"
    data = whole.read_bytes()
    (folder / TORN).write_bytes(data[: len(data) * 2 // 3])


CONVERT = f"convert {GIVEN}/cameras.mcap --topic /left --topic /right --size 16x12 -o {OUT}"
SWEEP = f"sweep oscillatory -o {OUT} --grid learner.nu=0.01,0.02 --seeds 2 --max-iterations 20"
RECOVER = f"recover {TORN} -o {OUT}/x1.mcap"

STORIES = {
    story.name: story
    for story in (
        Story("record", RECORD, (f"{RECORD} --resume", f"{RECORD} --force"), files),
        Story(
            "record in parts",
            f"{RECORD} --split 3s",
            (f"{RECORD} --split 3s --resume", f"{RECORD} --split 3s --force"),
            files,
        ),
        Story(
            "record --resume",
            f"record -o {OUT} --resume",
            (f"record -o {OUT} --resume", f"{RECORD} --resume"),
            files,
            lambda folder: cut_short(folder, RECORD, "x1", 6),
            frames,
        ),
        Story(
            "record in parts --resume",
            f"record -o {OUT} --resume",
            (f"record -o {OUT} --resume", f"{RECORD} --split 3s --resume"),
            files,
            lambda folder: cut_short(folder, f"{RECORD} --split 3s", "x1-002", 3),
            frames,
        ),
        Story(
            "record --force",
            f"{RECORD} --force",
            (f"{RECORD} --seed 0 --resume", f"{RECORD} --force"),
            files,
            lambda folder: cut_short(folder, f"{RECORD} --seed 1", "x1", 6),
        ),
        Story(
            "learn",
            LONG,
            (
                f"learn -o {OUT} --resume --no-rerun",
                f"{LONG} --resume",
                f"{LONG} --force",
            ),
            learned,
            _recording,
        ),
        Story(
            "learn with a view",
            f"{LEARN} --max-iterations 30",
            (
                f"learn -o {OUT} --resume",
                f"{LEARN} --max-iterations 30 --force",
            ),
            learned,
            _recording,
        ),
        Story(
            "learn --resume",
            f"learn -o {OUT} --resume --no-rerun",
            (f"learn -o {OUT} --resume --no-rerun",),
            learned,
            _learning,
            iterations,
        ),
        Story(
            "learn --resume, longer",
            f"{LONG} --resume",
            (f"{LONG} --resume",),
            learned,
            lambda folder: _learned(folder, f"{LEARN} --max-iterations 250 --no-rerun"),
            iterations,
        ),
        Story(
            "learn --force",
            f"{LONG} --force",
            (f"{LONG} --resume", f"{LONG} --force"),
            learned,
            lambda folder: _learned(folder, f"{LONG} --seed 1"),
        ),
        Story("convert", CONVERT, (f"{CONVERT} --resume", f"{CONVERT} --force"), files, _cameras),
        Story("sweep", SWEEP, (f"{SWEEP} --retry-failed",), rows, progress=done),
        Story(
            "sweep --keep-logs",
            f"{SWEEP} --keep-logs",
            (f"{SWEEP} --keep-logs --retry-failed",),
            rows,
            progress=done,
        ),
        Story("recover", RECOVER, (RECOVER, f"{RECOVER} --force"), files, _torn, done=(0, 3)),
        Story(
            "recover a folder",
            f"recover {GIVEN} -o {OUT}",
            (f"recover {GIVEN} -o {OUT}", f"recover {GIVEN} -o {OUT} --force"),
            files,
            _recording,
        ),
    )
}
"""By name."""

WITH_WORKERS = {
    story.name: story
    for story in (
        Story("record --jobs 2", f"{RECORD} --jobs 2", STORIES["record"].on, files),
        Story(
            "sweep --keep-logs --jobs 2",
            f"{SWEEP} --keep-logs --jobs 2",
            STORIES["sweep --keep-logs"].on,
            rows,
            progress=done,
        ),
    )
}
"""Those in which several processes work at the same time."""
