"""run.mcap, the whole story of a run: what it was started with, and the topics of its messages."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import ARITHMETIC, Keyframe
from cdmisfa.core.signals import SCHEMA_VERSION
from cdmisfa.core.untrusted.memory import parse_json
from recorder.mcap.reader import LogReader
from replay.runs.folders import RUN_FILE, RUN_METADATA, run_log
from replay.runs.messages import decode_keyframe, missing

SIGNALS_TOPIC = "/signals"
WATCHED_TOPIC = "/watched"
PHI_TOPIC = "/phi"
TRUTH_TOPIC = "/truth"
EVENT_TOPIC = "/event"
KEYFRAME_TOPIC = "/keyframe"

PHI_EVERY = 50
"""Iterations between two weights that a log keeps."""


@dataclass(frozen=True, slots=True)
class RunHeader:
    """What stands at the beginning of a run's log.

    Attributes:
        schema: version of `BlockSignals` it was written with.
        spec: what the learner's source delivered.
        manifest: what the run was started with: `config` by sections, `seed`, `source`, and with
            which `arithmetic` its learner computes.
    """

    schema: int
    spec: SourceSpec
    manifest: Mapping[str, Any]

    @property
    def missing(self) -> tuple[str, ...]:
        """Signals that this log lacks, being older: they are read as NaN."""
        return missing(self.schema)

    @property
    def delta(self) -> float | None:
        """Threshold of eta-dot, where the configuration names it."""
        value = self.setting("learner", "delta")
        return float(value) if isinstance(value, int | float) else None

    @property
    def by_progress(self) -> bool:
        """Whether it is a run of the progress learner."""
        return bool(self.setting("learner", "algorithm") == "progress")

    @property
    def settled(self) -> tuple[float, float] | None:
        """Change and learning error below which a stream is learned, of the progress learner."""
        change = self.setting("learner", "settled")
        agreement = self.setting("learner", "agreement")
        if not isinstance(change, int | float) or not isinstance(agreement, int | float):
            return None
        return float(change), float(change + agreement)

    @property
    def arithmetic(self) -> int:
        """With which version of its arithmetic its learner computed; see `arithmetic_of`."""
        version = self.manifest.get(ARITHMETIC)
        return version if isinstance(version, int) else 1

    @property
    def forked_at(self) -> int | None:
        """Iterations that a fork has in common with its parent; None of a run that is no fork."""
        fork = self.manifest.get("fork")
        at = fork.get("at") if isinstance(fork, Mapping) else None
        return at if isinstance(at, int) and at >= 0 else None

    def setting(self, section: str, key: str) -> Any:
        """A value of the run's configuration, as `setting("learner", "delta")`, or None."""
        config = self.manifest.get("config")
        table = config.get(section) if isinstance(config, Mapping) else None
        return table.get(key) if isinstance(table, Mapping) else None


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, in words, at the end of an iteration's block."""

    t: int
    iteration: int
    text: str
    level: str


def read_header(path: Path) -> RunHeader:
    """What stands at the beginning of a run's log.

    Raises:
        UsageError: the file is no run's log, or of a later version of this software.
        LogDamagedError: it cannot be read.
    """
    log = run_log(path)
    with LogReader(log) as reader:
        found = next((r.values for r in reader.metadata if r.name == RUN_METADATA), None)
    if found is None:
        raise UsageError(f"{log} is no run's log: name a run's folder or its {RUN_FILE}")
    schema = record_version(found)
    if schema < 1:  # asked first: all else may look different in a later one
        text = found.get("schema", "")
        raise LogDamagedError(
            f"{log}: its metadata {RUN_METADATA} is broken (schema {text[:20]!r})"
        )
    if schema > SCHEMA_VERSION:
        raise UsageError(
            f"{log} was written with version {schema} of the signals, this is version "
            f"{SCHEMA_VERSION}: install a newer cdmisfa to read it"
        )
    try:
        spec = parse_json(found["spec"])
        for name in ("streams", "frame_shape", "truth"):
            spec[name] = tuple(spec[name])
        return RunHeader(schema, SourceSpec(**spec), parse_json(found["manifest"]))
    except (KeyError, TypeError, ValueError, UsageError) as error:
        raise LogDamagedError(f"{log}: its metadata {RUN_METADATA} is broken ({error})") from error


def read_keyframe(path: Path, last: int | None = None) -> Keyframe | None:
    """The newest keyframe of a run's log at or before so many iterations, None where there is none.

    Only the chunks that hold keyframes are read. What is no keyframe of this version is passed
    over.
    """
    newest = _keyframes(run_log(path), lambda k: last is None or k <= last, backwards=True)
    return next(newest, None)


def read_keyframes(path: Path, after: int) -> Iterator[Keyframe]:
    """The keyframes of a run's log after more than so many iterations, in order.

    Of two after the same iteration, as where a fork begins, the last one is the run's.
    """
    before: Keyframe | None = None
    for keyframe in _keyframes(run_log(path), lambda k: k > after):
        if before is not None and before.iteration != keyframe.iteration:
            yield before
        before = keyframe
    if before is not None:
        yield before


def _keyframes(
    log: Path, wanted: Callable[[int], bool], *, backwards: bool = False
) -> Iterator[Keyframe]:
    """Keyframes in the order of the file, or from its end on."""
    step = -1 if backwards else 1
    with LogReader(log) as reader:
        own = {n for n, channel in reader.channels.items() if channel.topic == KEYFRAME_TOPIC}
        for segment in reader.segments[::step]:
            counts = segment.channel_counts()
            if counts is not None and not own & counts.keys():
                continue
            table = reader.table(segment)
            if table is None:
                continue
            for row in np.flatnonzero(np.isin(table.channel, list(own)))[::step].tolist():
                if not wanted(int(table.records["sequence"][row])):
                    continue
                with contextlib.suppress(LogDamagedError):
                    keyframe = decode_keyframe(table.payload(row), f"{log} {KEYFRAME_TOPIC}")
                    if wanted(keyframe.iteration):
                        yield keyframe


def record_version(metadata: Mapping[str, str]) -> int:
    """The version of the signals' record that a run's metadata names, 0 where it names none."""
    text = metadata.get("schema", "")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else 0
