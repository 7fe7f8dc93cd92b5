"""`Run`: a run on disk as its user sees it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import SIGNALS
from replay.runs.columns import joined
from replay.runs.folders import read_run_json, run_log
from replay.runs.log import RunHeader, read_header
from replay.runs.modules import load_modules
from replay.runs.stretches import read_columns


class Run:
    """What a run left behind, read where it is needed and only then.

    Args:
        path: the run's folder, or its log.

    Raises:
        UsageError: there is no such run, or it is of a later version of this software.
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
        """What `learn --json` said at its end, None where the run was broken off."""
        return read_run_json(self.log.parent).get("result")

    @cached_property
    def modules(self) -> tuple[Module, ...]:
        """What it learned, in order.

        Raises:
            LogDamagedError: the modules are of other streams, or cannot be read.
        """
        found = load_modules(self.log.parent)
        names = self.streams
        if any(module.stream_index >= len(names) for module in found):
            raise LogDamagedError(f"{self.log.parent} holds modules of streams it does not have")
        return tuple(replace(module, stream=names[module.stream_index]) for module in found)


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
            self._read |= joined(read_columns(self._log, self._header), [name])
        return self._read[name]

    def __iter__(self) -> Iterator[str]:
        return iter(SIGNALS)

    def __len__(self) -> int:
        return len(SIGNALS)
