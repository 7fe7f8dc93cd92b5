"""The arena: plan trials, make their streams, run what is missing.

DIR/rows.jsonl has a row for every finished trial, DIR/streams what they learned from; what all
of them came to is in `results`. Beside the progress learner and the paper's own there is the
progress learner with every other rule for choosing the stream to watch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

from cdmisfa.agents.progress.config import ATTENTIONS
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.processes import WorkerDied, run_all
from cdmisfa.core.registry import Registry
from cdmisfa.experiments.documents import plain
from cdmisfa.experiments.sources import configure
from cdmisfa.experiments.store import SweepReport, answer, code, run_trials, trial_id
from cdmisfa.studies.arena.library import Library
from cdmisfa.studies.arena.streams import SETS, SUITE, parse
from cdmisfa.studies.arena.trial import ArenaTrial, run_arena_trial

CONTESTANTS: Registry[tuple[str, ...]] = Registry(
    "learner of the arena",
    {
        "progress": ("learner.algorithm=progress",),
        "2.0": ("learner.algorithm=2.0",),
        "1.0": ("learner.algorithm=1.0",),
        **{
            name: ("learner.algorithm=progress", f"learner.attention={name}")
            for name in ATTENTIONS
            if name != "progress"
        },
    },
)
"""Settings of every learner that is compared, over its preset; `CONTESTANTS.add` adds one."""

COMPUTED: Final = tuple(
    f"cdmisfa/studies/arena/{name}" for name in ("library", "pictures", "streams", "trial")
)
"""Modules that decide what a trial comes to."""

Progress = Callable[[int, int, str], None]
"""Told how many are done, of how many, and what else is to be said."""


def run_arena(
    folder: Path,
    sets: Sequence[str] = SUITE,
    learners: Sequence[str] = (),
    seeds: Iterable[int] = range(10),
    *,
    settings: Sequence[str] = (),
    frames: int | None = None,
    streams: Path | None = None,
    retry_failed: bool = False,
    making: Progress = lambda done, total, note: None,
    progress: Progress = lambda done, total, note: None,
    **where: Any,
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
        retry_failed: compute trials again that failed before.
        making: told of streams that are made.
        progress: told of trials.
        where: to compute: jobs, engine and scheduler, see `run_all`.

    Raises:
        UsageError: a wrong name, key or value, or a stream needs a package that is missing.
        EngineError: no scheduler answers.
    """
    library = Path(streams or folder / "streams").resolve()
    trials = plan_arena(sets, learners or tuple(CONTESTANTS), seeds, settings, frames, library)
    return run_trials(
        trials,
        Path(folder).resolve(),
        compute_arena_trial,
        **where,
        retry_failed=retry_failed,
        begin=lambda missing: _make_streams(missing, where, making),
        progress=lambda done, failed, total: progress(
            done, total, f"{failed} failed" if failed else ""
        ),
    )


def plan_arena(
    sets: Sequence[str],
    learners: Sequence[str],
    seeds: Iterable[int],
    settings: Sequence[str],
    frames: int | None,
    library: Path,
) -> list[ArenaTrial]:
    """Every trial, seeds innermost; see `run_arena`.

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
        preset = "icub" if entry.images else "oscillatory"
        for learner in dict.fromkeys(learners):
            config = configure(preset, settings=(*CONTESTANTS[learner], *settings)).learner
            point = {"set": name, "learner": learner, **more}
            for seed in each:
                trial = ArenaTrial(
                    id=trial_id(shown, section_table(config), seed, version),
                    point=point,
                    seed=seed,
                    code=version,
                    streams=entry,
                    learner=config,
                    library=library,
                )
                trials.append(trial)
    return trials


def compute_arena_trial(trial: ArenaTrial) -> Mapping[str, Any]:
    """Compute one trial: its row, or under "error" why there is none."""
    return answer(trial, code(*COMPUTED), lambda it: plain(run_arena_trial(it)))


Task = tuple[Path, list[tuple[str, int, int, str]]]
"""Folder of the streams, and what to prepare there, one after the other; see `Library`."""


def _make_streams(trials: Sequence[ArenaTrial], where: Mapping[str, Any], making: Progress) -> None:
    """Make the streams that are missing; in one process what is seen of one through cameras."""
    tasks: dict[tuple[str, int], Task] = {}
    for trial in trials:
        for showing in {s for word in trial.streams.words for s in parse(word)}:
            wanted = showing.name, trial.seed, *trial.reference
            _, group = tasks.setdefault((showing.kind, trial.seed), (trial.library, []))
            if wanted not in group and not Library(trial.library).has(*wanted):
                group.append(wanted)
    missing = [(folder, sorted(group)) for folder, group in tasks.values() if group]
    for done, (_, result) in enumerate(run_all(make_streams, missing, **where), 1):
        if isinstance(result, WorkerDied):
            raise CdmisfaError(f"a stream could not be made: {result.what}")
        making(done, len(missing), "")


def make_streams(task: Task) -> None:
    """Make streams, for any process to call."""
    folder, wanted = task
    for each in wanted:
        Library(folder).prepare(*each)
