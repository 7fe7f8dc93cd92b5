"""The arena: plan trials, make their streams, run what is missing.

DIR/rows.jsonl has a row for every finished trial, DIR/streams what they learned from; what all
of them came to is in `results`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from cdmisfa.arena.contestants import CONTESTANTS, configured
from cdmisfa.arena.library import Library, Wanted
from cdmisfa.arena.sets import SETS, SUITE
from cdmisfa.arena.streams import parse
from cdmisfa.arena.trial import ArenaTrial, run_trial
from cdmisfa.core.config import as_table
from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.processes import WorkerDied, run_all
from cdmisfa.experiments.documents import plain
from cdmisfa.experiments.store import SweepReport, answer, code, identity, run_trials

STREAMS_FOLDER: Final = "streams"
"""Where the streams are, in the folder of the results."""

COMPUTED: Final = tuple(
    f"cdmisfa/arena/{name}"
    for name in (
        "environments", "library", "measures", "pictures", "source", "streams", "trial"
    )
)  # fmt: skip
"""Modules that decide what a trial comes to."""

Progress = Callable[[int, int, str], None]
"""Told how many are done, of how many, and what else is to be said."""


def arena(
    folder: Path,
    sets: Sequence[str] = SUITE,
    learners: Sequence[str] = (),
    seeds: Iterable[int] = range(10),
    *,
    settings: Sequence[str] = (),
    frames: int | None = None,
    streams: Path | None = None,
    jobs: int = 1,
    engine: str = "local",
    scheduler: str | None = None,
    retry_failed: bool = False,
    making: Progress = lambda done, total, note: None,
    progress: Progress = lambda done, total, note: None,
) -> SweepReport:
    """Run every learner on every set with every seed, where that was not done yet.

    Args:
        folder: of the results.
        sets: names in `SETS`.
        learners: names in `CONTESTANTS`; by default all.
        seeds: of learners and streams, both.
        settings: `section.key=value` words for all learners.
        frames: after so many a run is stopped, not after those of its set.
        streams: folder of the streams, by default in that of the results.
        jobs: local processes.
        engine: where to compute, see `engines.ENGINES`.
        scheduler: address of a dask scheduler.
        retry_failed: compute trials again that failed before.
        making: told of streams that are made.
        progress: told of trials.

    Raises:
        UsageError: a wrong name, key or value, or a stream needs a package that is missing.
        EngineError: no scheduler answers.
    """
    library = Path(streams or folder / STREAMS_FOLDER).resolve()
    trials = plan(sets, learners or tuple(CONTESTANTS), seeds, settings, frames, library)
    where: dict[str, Any] = {"jobs": jobs, "engine": engine, "scheduler": scheduler}

    def begin(missing: Sequence[ArenaTrial]) -> None:
        _make_streams([w for trial in missing for w in trial.wanted()], library, where, making)

    return run_trials(
        trials,
        Path(folder).resolve(),
        compute,
        **where,
        retry_failed=retry_failed,
        begin=begin,
        progress=lambda done, failed, total: progress(
            done, total, f"{failed} failed" if failed else ""
        ),
    )


def plan(
    sets: Sequence[str],
    learners: Sequence[str],
    seeds: Iterable[int],
    settings: Sequence[str],
    frames: int | None,
    library: Path,
) -> list[ArenaTrial]:
    """Every trial, seeds innermost; see `arena`.

    Raises:
        UsageError: a wrong name, key or value.
    """
    version, each = code(*COMPUTED), tuple(dict.fromkeys(seeds))
    more = dict(word.split("=", 1) for word in settings if "=" in word)
    if frames is not None:
        more["frames"] = str(frames)
    trials = []
    for name in dict.fromkeys(sets):
        entry = SETS[name] if frames is None else replace(SETS[name], frames=frames)
        shown = {key: value for key, value in asdict(entry).items() if key != "about"}
        for learner in dict.fromkeys(learners):
            configuration = configured(learner, settings, images=entry.images)
            table = as_table(configuration)
            trials += [
                ArenaTrial(
                    id=identity(shown, table, seed, version),
                    point={"set": name, "learner": learner, **more},
                    seed=seed,
                    streams=entry,
                    learner=configuration,
                    library=library,
                    code=version,
                )
                for seed in each
            ]
    return trials


def compute(trial: ArenaTrial) -> Mapping[str, Any]:
    """Compute one trial: its row, or under "error" why there is none."""
    return answer(trial, code(*COMPUTED), lambda it: plain(run_trial(it)))


def _make_streams(
    wanted: Sequence[Wanted], folder: Path, where: Mapping[str, Any], making: Progress
) -> None:
    """Make the streams that are missing, each in one process: first what bad cameras look at."""
    references: dict[tuple[str, int], set[tuple[int, str]]] = {}
    for each in wanted:
        (signal,) = parse(each.name)
        references.setdefault((signal.kind, each.seed), set())
        references.setdefault((each.name, each.seed), set()).update(each.references)
    tasks = [
        (folder, Wanted(name, seed, tuple(sorted(found))))
        for (name, seed), found in sorted(references.items())
    ]
    tasks = [task for task in tasks if not Library(folder).has(task[1])]
    seen = [task for task in tasks if parse(task[1].name)[0].camera]
    plain_first = [task for task in tasks if task not in seen]
    done = 0
    for turn in (plain_first, seen):
        for _, result in run_all(make_stream, turn, **where):
            if isinstance(result, WorkerDied):
                raise CdmisfaError(f"a stream could not be made: {result.what}")
            done += 1
            making(done, len(tasks), "")


def make_stream(task: tuple[Path, Wanted]) -> None:
    """Make a stream, for any process to call."""
    folder, wanted = task
    Library(folder).prepare(wanted)
