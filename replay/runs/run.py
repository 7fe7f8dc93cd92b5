"""A run as a whole: what it left behind, in short, and the closing record that proves it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.signals import NO_STATE, SIGNALS
from cdmisfa.modules import Module
from recorder.images.framing import Recipe
from replay.runs.columns import Blocks, SignalColumns, has_values, whole_signals
from replay.runs.folders import MODULES_FILE, read_run_json, run_log
from replay.runs.log import RunHeader, read_columns, read_header
from replay.runs.modules import load_modules
from replay.storage.identity import file_sha256

LINES = (
    *("eta", "eta_dot", "reward", "curiosity", "expert", "xi", "share", "epsilon"),
    *("change", "tested", "fitted", "learning_error", "interest", "typical", "regret"),
)
"""Signals whose values an outline keeps for every iteration, to choose ranges from."""

_FILES: Final = ("files", "views")
"""Keys under which sources list their files, each as a table."""

_WHOLE: Final = "sha256"
_HASHES: Final = {_WHOLE, "sample_sha256"}
_KNOWN: Final = {*_HASHES, "bytes"}
"""What may be stated of a file, before all of it was read or after."""


class Run:
    """A run on disk, of which is read what is asked for.

    Args:
        path: the run's folder, or its log.

    Raises:
        UsageError: there is no such run, or it is of another version of the signals.
        LogDamagedError: its log cannot be read, here or in any later access.
    """

    def __init__(self, path: str | Path) -> None:
        self.log = run_log(Path(path))
        self.header: RunHeader = read_header(self.log)
        self.signals: Mapping[str, NDArray[Any]] = _Signals(self.log, self.header)

    @property
    def streams(self) -> tuple[str, ...]:
        """Names of the streams."""
        return self.header.spec.streams

    @cached_property
    def result(self) -> Mapping[str, Any] | None:
        """The document of `learn --json`; None where the run was broken off."""
        return read_run_json(self.log.parent).get("result")

    @cached_property
    def modules(self) -> tuple[Module, ...]:
        """Its modules, in order.

        Raises:
            LogDamagedError: the modules are of other streams, or cannot be read.
        """
        found = load_modules(self.log.parent)
        names = self.streams
        if any(module.stream_index >= len(names) for module in found):
            raise LogDamagedError(f"{self.log.parent} holds modules of streams it does not have")
        shape = self.header.spec.frame_shape
        return tuple(
            replace(
                module,
                stream=names[module.stream_index],
                frame_shape=shape,
                recipe=module.recipe or self.recipe(module.stream_index),
            )
            for module in found
        )

    def recipe(self, stream: int = 0) -> Recipe:
        """What became of the raw pictures of a stream."""
        stated = self.header.manifest.get("source")
        shape = self.header.spec.frame_shape
        return Recipe.of(stated if isinstance(stated, Mapping) else {}, shape, stream)


class _Signals(Mapping[str, "NDArray[Any]"]):
    """A run's signals by name, (iterations, *dims) each; NaN for modules not yet there."""

    def __init__(self, log: Path, header: RunHeader) -> None:
        self._log = log
        self._header = header
        self._read: dict[str, NDArray[Any]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in SIGNALS:
            raise KeyError(name)
        if name not in self._read:
            self._read |= whole_signals(read_columns(self._log, self._header), [name])
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(SIGNALS)

    def __len__(self) -> int:
        return len(SIGNALS)


@dataclass(frozen=True, slots=True)
class Save:
    """Signals of the iteration at whose end a module was saved, by their names."""

    module: int
    stream: int
    iteration: int
    t: int
    policy: tuple[int, ...]
    eta: tuple[float, ...]
    eta_dot: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Phase:
    """The blocks in which one abstraction was learned.

    Attributes:
        novel: how many of them the gate let through.
        novel_of: (S,) how many of these were of each stream.
    """

    module: int
    blocks: int
    novel: int
    novel_of: IntArray


@dataclass(frozen=True, slots=True)
class Outline:
    """A run in short.

    Attributes:
        iterations: number of records; `frames` those watched.
        blocks: of all records.
        end: the frame after the last one; there may be more before it than were watched.
        tau: frames of a block.
        outputs: of an abstraction.
        modules: most frozen modules in any iteration.
        visits: (S,) frames each stream was watched.
        saved: the saves, in order.
        last: the phase since the last save.
        lines: for each name of `LINES` its values, (n,) or flattened.
        told: names of the signals that have a value anywhere in the run.
        states: (S,) what became of each stream, by codes as in the signal `state`.
    """

    header: RunHeader
    iterations: int
    frames: int
    blocks: Blocks
    end: int
    tau: int
    outputs: int
    modules: int
    visits: IntArray
    saved: tuple[Save, ...]
    last: Phase | None
    lines: dict[str, FloatArray]
    told: frozenset[str]
    states: tuple[int, ...]

    def streams(self, most: int) -> list[int]:
        """The most watched streams, at most so many, in their own order."""
        ranked = np.argsort(-self.visits, kind="stable")[:most]
        return sorted(int(s) for s in ranked)

    def names(self) -> tuple[str, ...]:
        """Names of the streams."""
        return self.header.spec.streams


class Tally:
    """Makes an outline of a run's records, as they come."""

    def __init__(self, header: RunHeader) -> None:
        self.header = header
        self._blocks: list[Blocks] = []
        self._lines: dict[str, list[FloatArray]] = {name: [] for name in LINES}
        self._phase: dict[str, list[NDArray[Any]]] = {"module": [], "novel": []}
        self._saved: list[Save] = []
        self._modules = self._tau = self._outputs = 0
        self._told: set[str] = set()
        self._states: tuple[int, ...] = (NO_STATE,) * len(header.spec.streams)

    def add(self, columns: SignalColumns) -> None:
        """Take the next records in."""
        _, self._tau, self._outputs = columns["y"].shape
        self._blocks.append(Blocks.of(columns))
        for name, parts in self._lines.items():
            parts.append(columns[name].reshape(-1))
        for name, parts in self._phase.items():
            parts.append(columns[name].copy())
        self._modules = max(self._modules, columns["y_frozen"].shape[1])
        self._saved += [_save(columns, i) for i in np.flatnonzero(columns["saved"]).tolist()]
        unsure = SIGNALS.keys() - self._told
        self._told |= {name for name in unsure if has_values(name, columns[name])}
        self._states = tuple(columns["state"][-1].tolist())

    def outline(self) -> Outline:
        """The outline of all records so far."""
        blocks, streams = Blocks.concatenated(self._blocks), len(self._states)
        visits = self._tau * np.bincount(blocks.streams, minlength=streams)
        last = None
        if len(blocks.starts):
            module, novel = (np.concatenate(parts) for parts in self._phase.values())
            own = module == module[-1]
            through = own & novel.astype(bool)
            novel_of = np.bincount(blocks.streams[through], minlength=streams)
            last = Phase(int(module[-1]), int(own.sum()), int(through.sum()), novel_of)
        return Outline(
            header=self.header,
            iterations=len(blocks.starts),
            frames=int(visits.sum()),
            blocks=blocks,
            end=int(blocks.starts[-1]) + self._tau if len(blocks.starts) else 0,
            tau=self._tau,
            outputs=self._outputs,
            modules=self._modules,
            visits=visits,
            saved=tuple(self._saved),
            last=last,
            lines={
                name: np.concatenate([np.empty(0), *parts]) for name, parts in self._lines.items()
            },
            told=frozenset(self._told),
            states=self._states,
        )


def _save(columns: SignalColumns, row: int) -> Save:
    found = ((field.name, columns[field.name][row].tolist()) for field in fields(Save))
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in found}
    return Save(**values)


def read_outline(path: Path) -> Outline:
    """Read a run through once; see `read_batches`."""
    tally = Tally(read_header(path))
    for columns in read_columns(path, tally.header):
        tally.add(columns)
    return tally.outline()


def final_record(
    folder: Path, document: Mapping[str, Any], signals: str, *, view: bool
) -> dict[str, str]:
    """The closing record of a run: hashes of signals and files, of a folder with its modules.

    Args:
        folder: of the run.
        document: what its run.json states.
        signals: the SHA-256 of its signals.
        view: whether it has a view, too.
    """
    return {
        "signals_sha256": signals,
        "modules_sha256": file_sha256(folder / MODULES_FILE),
        "facts_sha256": facts_sha256(document),
        "view": json.dumps(view),
    }


def facts_sha256(document: Mapping[str, Any]) -> str:
    """SHA-256 of a run.json, but for where the run lies and the command."""
    facts = {key: value for key, value in document.items() if key != "command"}
    if isinstance(result := facts.get("result"), Mapping):
        facts["result"] = {key: value for key, value in result.items() if key != "run"}
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def stated_source(log: Path) -> Any:
    """The source of a run as its log states it, with hashes of large files from run.json.

    Args:
        log: of the run.

    Raises:
        UsageError: it is no run's log.
        LogDamagedError: it cannot be read.
    """

    def ended(file: Mapping[str, Any], at_end: Mapping[str, Any]) -> Mapping[str, Any]:
        large = "sample_sha256" in file and _WHOLE in at_end
        return {**file, _WHOLE: at_end[_WHOLE]} if large else file

    stated = read_header(log).manifest.get("source")
    return _of_each(stated, read_run_json(log.parent).get("source"), ended)


def states_whole(source: Any) -> bool:
    """Whether a source states the SHA-256 of all of a file."""
    return any(_WHOLE in file for key in _FILES for file in _tables(source, key))


def known_to_both(one: Any, other: Any) -> tuple[Any, Any]:
    """Two sources without what only one of them states of a file."""

    def known(file: Mapping[str, Any], to: Mapping[str, Any]) -> Mapping[str, Any]:
        shared = file.keys() & to.keys()
        left_out = _KNOWN - shared if shared & _HASHES else set()
        return {key: value for key, value in file.items() if key not in left_out}

    return _of_each(one, other, known), _of_each(other, one, known)


def other_files(one: Any, another: Any) -> list[str]:
    """Names of the files of a source that are not those of another, by what both know of them.

    Where another has more or fewer, of those that it lacks.
    """
    found: list[str] = []
    for key in _FILES:
        own, others = _tables(one, key), _tables(another, key)
        if len(own) == len(others):
            found += [
                str(file.get("file"))
                for file, like in zip(own, others, strict=True)
                if any(file[known] != like[known] for known in _HASHES & file.keys() & like.keys())
            ]
        elif others:
            there = {file.get("file") for file in others}
            found += [str(file.get("file")) for file in own if file.get("file") not in there]
    return found


def _of_each(
    one: Any,
    other: Any,
    change: Callable[[Mapping[str, Any], Mapping[str, Any]], Mapping[str, Any]],
) -> Any:
    """A source, with each of its files changed by what another says of the same one."""
    found = one
    for key in _FILES:
        own, others = _tables(one, key), _tables(other, key)
        if own and len(own) == len(others):
            changed = [change(file, like) for file, like in zip(own, others, strict=True)]
            found = {**found, key: changed}
    return found


def _tables(source: Any, key: str) -> list[Mapping[str, Any]]:
    files = source.get(key) if isinstance(source, Mapping) else None
    if isinstance(files, list) and all(isinstance(file, Mapping) for file in files):
        return files
    return []
