"""Rank the episodes of a dataset: measure each, compare them within groups, and give reasons."""

from __future__ import annotations

import ctypes
import gc
import itertools
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import UsageError
from cdmisfa.core.names import counted
from cdmisfa.core.processes import run_all
from recorder.log.files import locked_folder, make_folder
from replay.episodes.features import features_of, unlike_columns
from replay.episodes.groups import groups_of
from replay.episodes.images import columns_of_images
from replay.episodes.lag import Lag, lag_column
from replay.episodes.measure import Measured, load_measures, save_measures
from replay.episodes.numbers import Column, number_columns
from replay.episodes.reading import EpisodeLog, list_episodes, measure_episode, refuse_input
from replay.episodes.reasons import REASONS, scores
from replay.storage.location import location

# Folder with the measures of each episode, so that the command continues.
MEASURES: Final = "measured"

# Episodes of a group from which on medians and deviations tell which of them differ.
COMPARABLE: Final = 10

# Score of an episode that cannot be read, or lacks a camera that the others have.
UNREADABLE: Final = 100.0


@dataclass(slots=True)
class Ranked:
    """Episodes with their measures and scores.

    Attributes:
        logs: the episodes.
        measured: their measures.
        groups: episodes of each group, by a name.
        columns: the measures that are compared, over all episodes.
        scores: (n, columns) distance over the limit, 1 or more gives the reason; NaN: not judged.
        score: (n,) largest score of each episode; from 1 on it is flagged.
        lags: how late each camera is in each episode, by (episode, camera).
        notes: lines about the dataset as a whole.
        defects: reasons that need no comparison: unreadable, or a camera is missing.
    """

    logs: list[EpisodeLog]
    measured: list[Measured]
    groups: dict[str, IntArray] = field(default_factory=dict)
    columns: list[Column] = field(default_factory=list)
    scores: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    score: FloatArray = field(default_factory=lambda: np.zeros(0))
    lags: dict[tuple[int, str], Lag] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    defects: dict[int, list[str]] = field(default_factory=dict)

    @property
    def order(self) -> list[int]:
        """Episodes, worst first."""
        return [int(i) for i in np.argsort(-self.score, kind="stable")]

    @property
    def flagged(self) -> list[int]:
        """The flagged episodes, worst first."""
        return [i for i in self.order if self.score[i] >= 1]

    def reasons(self, episode: int) -> list[tuple[str, Column | None]]:
        """Return the reasons of an episode in words, each with its column, the worst first."""
        reasons: list[tuple[str, Column | None]] = [
            (r, None) for r in self.defects.get(episode, [])
        ]
        cameras = {column.camera for column in self.columns} - {""}
        row = np.nan_to_num(self.scores[episode])
        for place in np.argsort(-row, kind="stable")[: (row >= 1).sum()]:
            column = self.columns[place]
            group = next(g for g in self.groups.values() if episode in g)
            rest = column.value[group[group != episode]]
            known, at = rest[np.isfinite(rest)], column.at[episode]
            median = float(np.median(known)) if len(known) else math.nan
            words = REASONS[column.reason].text(float(column.value[episode]), median)
            camera = f"{column.camera}: " if column.camera and len(cameras) > 1 else ""
            when = "" if math.isnan(at) else f" at {at:.1f} s"
            reasons.append((f"{camera}{words}{when}", column))
        return reasons

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each episode: its name, score, reasons, and all measures."""
        rows, group_of = [], {int(i): name for name, part in self.groups.items() for i in part}
        for i, (log, measured) in enumerate(zip(self.logs, self.measured, strict=True)):
            row: dict[str, Any] = {"episode": i, "name": log.name, "file": log.files[0]}
            row |= {"group": group_of.get(i, ""), "seconds": measured.seconds, **log.about}
            row |= {"score": float(self.score[i]), "flagged": bool(self.score[i] >= 1)}
            row["reasons"] = [words for words, _ in self.reasons(i)]
            for column, score in zip(self.columns, self.scores[i], strict=True):
                values = {"": column.value[i], "_score": score}
                name = column_name(column)
                if column.reason == "lag" and (lag := self.lags.get((i, column.camera))):
                    values |= {"_error": lag.error, "_margin": lag.margin}
                row |= {name + k: None if math.isnan(v) else float(v) for k, v in values.items()}
            rows.append(row)
        return rows

    def removal(self) -> list[str]:
        """Return commands that remove the flagged episodes of datasets, and all other files."""
        lines, numbers = list[str](), dict[str, list[int]]()
        for i in sorted(self.flagged):
            log = self.logs[i]
            if log.number >= 0:
                numbers.setdefault(log.files[0], []).append(log.number)
            else:
                lines += map(shlex.quote, log.files)
        for file, indices in numbers.items():
            root = location(file).resolve()
            lines.append(
                f"lerobot-edit-dataset --repo_id {shlex.quote(root.name)} --root "
                f"{shlex.quote(str(root))} --operation.type delete_episodes "
                f'--operation.episode_indices "{indices}"'
            )
        return lines


def column_name(column: Column) -> str:
    """Return the name of a column in tables, such as `blur` or `front.blur`."""
    return f"{column.camera}.{column.reason}" if column.camera else column.reason


def rank_episodes(
    words: Sequence[str | Path],
    out: Path,
    *,
    by: str | None = None,
    topics: Mapping[str, Sequence[str]] | None = None,
    jobs: int = 1,
    progress: Callable[[float, float | None], None] = lambda done, total: None,
    stop: Callable[[], bool] = lambda: False,
) -> Ranked | None:
    """Measure the episodes that are not measured yet, and compare all of them.

    Args:
        words: LeRobot datasets, folders, patterns and files.
        out: folder of the results; it keeps the measures.
        by: column of the dataset whose values are groups; None: tasks, and views as detected.
        topics: topics or features of "state" and "action"; others are found by type and name.
        jobs: number of processes; the result does not depend on it.
        progress: called with the number of episodes that are measured, and of all.
        stop: called after each episode; true ends the work.

    Returns:
        The episodes; None if it was stopped before all were measured.

    Raises:
        UsageError: there is no episode, no such column, no episode can be read, or `out` holds one.
        LogDamagedError: the tables of a LeRobot dataset cannot be read.
    """
    refuse_input(words, out)
    folder = out / MEASURES
    make_folder(folder)
    with locked_folder(out):
        logs = list_episodes(words, out, topics or {})
        files = [folder / f"{log.key()}.npz" for log in logs]
        for stale in {*folder.glob("*.npz")} - {*files}:
            stale.unlink()
        measured = dict(enumerate(map(load_measures, files)))
        missing = [i for i, one in measured.items() if one is None]
        done = len(files) - len(missing)
        progress(done, len(files))
        tasks = [(logs[i], files[i]) for i in missing]
        for _ in run_all(_measure, tasks, jobs=jobs):
            done += 1
            progress(done, len(files))
            if stop() and done < len(files):
                return None
        # Only now: while workers measure, this process needs little memory.
        measured |= {i: load_measures(files[i]) for i in missing}
    episodes = [one for one in measured.values() if one is not None]
    if all(one.problem for one in episodes):
        raise UsageError(episodes[0].problem)
    return compare(logs, episodes, by)


def _measure(task: tuple[EpisodeLog, Path]) -> None:
    """Measure an episode, and store the measures."""
    # glibc maps memory of more than 128 KiB anew for each array, which takes as long as decoding,
    # until an array is freed that was larger, of at most 32 MiB.
    np.empty(30 << 20, np.uint8)
    # Collections pass over frozen objects: all modules would take 0.1 s each time.
    gc.collect()
    gc.freeze()
    measured = measure_episode(task[0])
    save_measures(measured, task[1])
    # glibc does not reuse all memory of closed videos: 50 MB remain of each.
    with suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def compare(logs: list[EpisodeLog], measured: list[Measured], by: str | None = None) -> Ranked:
    """Compare measured episodes within their groups."""
    ranked = Ranked(logs, measured)
    ranked.notes += dict.fromkeys(log.missing for log in logs if log.missing)
    readable = np.array([i for i, one in enumerate(measured) if not one.problem])
    groups = groups_of([logs[i] for i in readable], [measured[i] for i in readable], by)
    ranked.groups = {name: readable[part] for name, part in groups.items()}
    for i, one in enumerate(measured):
        if one.problem:
            ranked.defects[i] = [f"cannot be read: {one.problem}"]
    whole: dict[tuple[int, str], Column] = {}
    for name, group in ranked.groups.items():
        if len(group) < COMPARABLE:
            ranked.notes.append(
                f"{name or 'dataset'}: a comparison of {counted(len(group), 'episode')} misses "
                f"faults; it needs {COMPARABLE} or more"
            )
        _find_swapped(ranked, group)
        for part, column in _columns_of(ranked, name, group):
            empty = (np.full(len(measured), np.nan) for _ in range(3))
            key = [*REASONS].index(column.reason), column.camera
            into = whole.setdefault(key, Column(column.reason, column.camera, *empty))
            for target, values in zip(into[2:], column[2:], strict=True):
                target[part] = values
    ranked.columns = [whole[key] for key in sorted(whole)]
    parts, every = list(ranked.groups.values()), []
    for column in ranked.columns:
        score, shared = scores(column, parts)
        every.append(score)
        for place, alike in shared:
            middles = [float(np.nanmedian(column.value[part])) for part in (alike, parts[place])]
            where = ", ".join(filter(None, ([*ranked.groups][place], column.camera)))
            ranked.notes.append(
                f"{len(alike)} of {len(parts[place])} episodes{where and f' ({where})'} share, and "
                f"are not flagged for it: {REASONS[column.reason].text(*middles)}"
            )
    ranked.scores = np.stack(every, axis=1)
    ranked.score = np.nan_to_num(ranked.scores).max(1, initial=0.0)
    ranked.score[[*ranked.defects]] = UNREADABLE
    if absent := [r for r in REASONS if r not in {column.reason for column in ranked.columns}]:
        ranked.notes.append(
            f"not judged, for lack of images, colors, states or actions: {', '.join(absent)}"
        )
    ranked.notes += [f"{one.name}: {remark}" for one in measured for remark in one.remarks]
    return ranked


def _columns_of(ranked: Ranked, name: str, group: IntArray) -> Iterator[tuple[IntArray, Column]]:
    """Yield the columns of a group, each with the episodes that it is measured in."""
    measured = ranked.measured
    sizes = [
        tuple((kind, values.shape[1]) for kind, (_, values) in measured[i].numbers.items())
        for i in group
    ]
    numbers = _alike(ranked, group, sizes, "joint states and actions")
    yield from ((numbers, c) for c in number_columns([measured[i] for i in numbers]))
    group = numbers if 2 * len(numbers) > len(group) else group  # the others have a defect
    for camera in dict.fromkeys(name for i in group for name in measured[i].cameras):
        images = [measured[i].cameras.get(camera) for i in group]
        having = _alike(
            ranked,
            group,
            [c and (c.begin.shape, c.thumbnails.shape[1], c.scale) for c in images],
            camera,
        )
        episodes = [measured[i] for i in having]
        cameras = [one.cameras[camera] for one in episodes]
        features = features_of(cameras)
        for c in (*columns_of_images(episodes, camera), *unlike_columns(cameras, features)):
            yield having, c._replace(camera=camera)
        if late := lag_column(episodes, camera, features.slow):
            column, lags, whole = late
            yield having, column._replace(camera=camera)
            ranked.lags |= {(int(i), camera): lag for i, lag in zip(having, lags, strict=True)}
            place = f"camera {camera}{f' of {name}' if name else ''}"
            missed = int(np.isnan(column.value).sum()) if len(lags) > 1 else 0
            left = f"; not measured in {missed} of {len(lags)} episodes" if missed else ""
            ranked.notes.append(f"{place}: {_lag_text(whole)}{left}")


def _find_swapped(ranked: Ranked, group: IntArray) -> None:
    """Give a reason to episodes in which two cameras are more like each other than like themselves.

    |v1 - m2| + |v2 - m1| < (|v1 - m1| + |v2 - m2|) / 2, m the median view of a camera
    """
    views = {i: {n: c.begin for n, c in ranked.measured[i].cameras.items()} for i in group}
    names = {name: view.shape for one in views.values() for name, view in one.items()}
    for a, b in itertools.combinations(names, 2):
        both = [i for i in group if {a, b} <= views[i].keys()]
        if len({views[i][name].shape for i in both for name in (a, b)}) != 1:
            continue
        middle = {name: np.median([views[i][name] for i in both], axis=0) for name in (a, b)}
        for i in both:
            apart = {(n, m): np.abs(views[i][n] - middle[m]).mean() for n in (a, b) for m in (a, b)}
            if 2 * (apart[a, b] + apart[b, a]) < apart[a, a] + apart[b, b]:
                ranked.defects.setdefault(int(i), []).append(f"cameras {a} and {b} are swapped")


def _alike(ranked: Ranked, group: IntArray, sizes: Sequence[Any], what: str) -> IntArray:
    """Return the episodes of the most common size that is not empty; the others have a defect."""
    common = max((size for size in sizes if size), key=sizes.count, default=sizes[0])
    for i, size in zip(group, sizes, strict=True):
        if size != common and 2 * sizes.count(common) > len(sizes):
            state = "of another size" if size else "missing"
            ranked.defects.setdefault(int(i), []).append(f"{what} {state}")
    return group[[size == common for size in sizes]]


def _lag_text(lag: Lag) -> str:
    if not lag.certain:
        return "its lag behind the joints cannot be measured: there is no clear peak"
    side = "behind" if lag.seconds >= 0 else "ahead of"
    return (
        f"{abs(lag.seconds) * 1e3:.0f} ms {side} the joints, +- {lag.error * 1e3:.0f} ms, "
        f"{lag.margin:.2f} above the second peak"
    )
